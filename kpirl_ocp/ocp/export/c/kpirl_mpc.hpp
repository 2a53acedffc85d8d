// SPDX-License-Identifier: MIT
//
// The controller as a C++ class: its memory is in the object, so that it needs neither the heap nor exceptions. Every call
// returns a status, see kpirl_mpc.h. The object is large: make it static, or with new.
#ifndef KPIRL_MPC_HPP
#define KPIRL_MPC_HPP

#include "kpirl_mpc_memory.h"

namespace kpirl_mpc_cpp {

class Controller {
 public:
  Controller() { (void)kpirl_mpc_init(&mpc_, &memory_, sizeof memory_); }  // cannot fail: size and alignment are right
  Controller(const Controller &) = delete;  // a controller must not be moved in memory
  Controller &operator=(const Controller &) = delete;

  kpirl_mpc *get() { return mpc_; }

  kpirl_mpc_status set(const kpirl_mpc_settings &settings) { return kpirl_mpc_set_settings(mpc_, &settings); }
  kpirl_mpc_settings settings() const {
    kpirl_mpc_settings found;
    (void)kpirl_mpc_get_settings(mpc_, &found);
    return found;
  }
  kpirl_mpc_status set_bounds(const kpirl_mpc_real *state_lower, const kpirl_mpc_real *state_upper,
                              const kpirl_mpc_real *action_lower, const kpirl_mpc_real *action_upper) {
    return kpirl_mpc_set_bounds(mpc_, state_lower, state_upper, action_lower, action_upper);
  }
  kpirl_mpc_status set_parameters(const kpirl_mpc_real *psi) { return kpirl_mpc_set_parameters(mpc_, psi); }
  kpirl_mpc_status reset() { return kpirl_mpc_reset(mpc_); }

  // Plan; with `last`, which may be `solution` itself, as a warm start from there. kpirl_mpc_ok says if the status is good.
  kpirl_mpc_status solve(const kpirl_mpc_input &input, kpirl_mpc_solution &solution,
                         const kpirl_mpc_solution *last = nullptr) {
    kpirl_mpc_guess guess = kpirl_mpc_guess();
    if (last) guess = kpirl_mpc_resume(last);
    return kpirl_mpc_solve(mpc_, &input, last ? &guess : nullptr, &solution);
  }
  kpirl_mpc_status shift(const kpirl_mpc_input &input, kpirl_mpc_solution &solution) {
    return kpirl_mpc_shift(mpc_, &input, &solution);
  }
  kpirl_mpc_status predict(const kpirl_mpc_input &input, const kpirl_mpc_real *action, kpirl_mpc_real *next) {
    return kpirl_mpc_predict(mpc_, &input, action, next);
  }
  kpirl_mpc_status gradient(const kpirl_mpc_input &input, const kpirl_mpc_guess *guess, const kpirl_mpc_solution &solution,
                            const kpirl_mpc_real *by_states, const kpirl_mpc_real *by_actions,
                            kpirl_mpc_gradients &gradients) {
    return kpirl_mpc_gradient(mpc_, &input, guess, &solution, by_states, by_actions, &gradients);
  }

 private:
  kpirl_mpc memory_;
  kpirl_mpc *mpc_ = nullptr;
};

}  // namespace kpirl_mpc_cpp
#endif
