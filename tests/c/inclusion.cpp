// The C++ class plans and continues without exceptions or the heap; errors of the caller are statuses.
#include <cstdio>

#include "kpirl_mpc.hpp"
extern "C" {
#include "test/records.h"
}

int main() {
  static kpirl_mpc_cpp::Controller controller;
  static kpirl_mpc_solution plan;
  kpirl_mpc_input input = kpirl_mpc_input();
  input.state = kpirl_mpc_record_state[0];
  input.context = kpirl_mpc_record_context[0];
  if (!kpirl_mpc_ok(controller.solve(input, plan))) return 1;
  if (controller.shift(input, plan) != KPIRL_MPC_CONVERGED) return 1;
  if (!kpirl_mpc_ok(controller.solve(input, plan, &plan))) return 1;
  input.state = nullptr;
  const kpirl_mpc_status status = controller.solve(input, plan);
  std::puts(kpirl_mpc_message(status));
  return status != KPIRL_MPC_ERROR_NULL;
}
