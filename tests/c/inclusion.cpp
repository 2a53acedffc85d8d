// The C++ class plans, continues, and turns errors of the caller into exceptions.
#include <cmath>
#include <iostream>

#include "kpirl_mpc.hpp"
extern "C" {
#include "test/records.h"
}

int main() {
  kpirl_mpc_cpp::Controller controller;
  kpirl_mpc_input input = {kpirl_mpc_record_state[0], kpirl_mpc_record_context[0], nullptr};
  kpirl_mpc_solution plan = controller.solve(input);
  controller.shift(plan);
  plan = controller.solve(input, &plan);
  if (!kpirl_mpc_ok(plan.status)) return 1;
  input.state = nullptr;
  try {
    controller.solve(input);
  } catch (const std::invalid_argument &error) {
    std::cout << error.what() << "\n";
    return 0;
  }
  return 1;
}
