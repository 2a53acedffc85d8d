// SPDX-License-Identifier: MIT
//
// The controller as a C++ class: memory from the heap, released with the object; errors of the caller are exceptions.
#ifndef KPIRL_MPC_HPP
#define KPIRL_MPC_HPP

#include <stdexcept>
#include <vector>

#include "kpirl_mpc.h"

namespace kpirl_mpc_cpp {

class Controller {
 public:
  Controller() : memory_(kpirl_mpc_size()) { check(kpirl_mpc_init(&mpc_, memory_.data(), memory_.size())); }
  Controller(const Controller &) = delete;  // a controller must not be moved in memory
  Controller &operator=(const Controller &) = delete;

  kpirl_mpc *get() { return mpc_; }

  void set_settings(const kpirl_mpc_settings &settings) { check(kpirl_mpc_set_settings(mpc_, &settings)); }
  kpirl_mpc_settings settings() const {
    kpirl_mpc_settings found;
    check(kpirl_mpc_get_settings(mpc_, &found));
    return found;
  }
  void set_bounds(const kpirl_mpc_real *state_lower, const kpirl_mpc_real *state_upper, const kpirl_mpc_real *action_lower,
                  const kpirl_mpc_real *action_upper) {
    check(kpirl_mpc_set_bounds(mpc_, state_lower, state_upper, action_lower, action_upper));
  }
  void set_parameters(const std::vector<kpirl_mpc_real> &psi) {
    if (psi.size() != KPIRL_MPC_N_PARAMETERS) throw std::invalid_argument("psi has the wrong length.");
    check(kpirl_mpc_set_parameters(mpc_, psi.data()));
  }
  void reset() { check(kpirl_mpc_reset(mpc_)); }

  // The result's status says how it ended; kpirl_mpc_ok says if that is good. A warm start continues from `last`.
  kpirl_mpc_solution solve(const kpirl_mpc_input &input, const kpirl_mpc_solution *last = nullptr) {
    kpirl_mpc_solution solution;
    kpirl_mpc_guess guess = {};
    if (last) guess = kpirl_mpc_resume(last);
    check(kpirl_mpc_solve(mpc_, &input, last ? &guess : nullptr, &solution));
    return solution;
  }
  void shift(kpirl_mpc_solution &solution) { check(kpirl_mpc_shift(mpc_, nullptr, &solution)); }

 private:
  static void check(kpirl_mpc_status status) {
    if (status < 0) throw std::invalid_argument(kpirl_mpc_message(status));
  }
  std::vector<unsigned char> memory_;  // from operator new: aligned for every fundamental type
  kpirl_mpc *mpc_ = nullptr;
};

}  // namespace kpirl_mpc_cpp
#endif
