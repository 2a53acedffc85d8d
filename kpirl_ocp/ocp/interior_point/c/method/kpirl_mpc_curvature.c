/* SPDX-License-Identifier: MIT
 *
 * Directions of negative curvature, and along them off a point that is no minimum.
 */
#include "kpirl_mpc_method.h"

#include <string.h>

static const real SHORTENED = (real)0.25; /* from one length to the next */
static const real SURE = (real)0.5;       /* of the curvature -1 that a negative pivot stands for */
static const real FLAT = (real)1e-8;      /* curvature, relative to the largest, that counts as none */

real kpirl_mpc_largest_curvature(const kpirl_mpc_core *core) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  return kpirl_mpc_norm_inf(core->d.H, T * n_x * n_x + n_s * n_s);
}

/* A direction along which the Hessian of the last factors is negative, from the most negative pivot: the step becomes
 *     u_t = W' e_j,  s = 0 before,  u = K s after it,    with curvature -1.
 * Returns whether there is one. */
static int find_negative_curvature(kpirl_mpc_core *core) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_u = DIM(core, n_actions), n_x = n_s + n_u;
  const int m = kpirl_mpc_n_inequalities(core);
  const kpirl_mpc_factors *factors = &core->factors;
  kpirl_mpc_iterate *change = &core->step.change;
  int i, t, worst = -1, stage;
  for (i = 0; i < T * n_u; ++i)
    if (factors->pivots[i] < (worst < 0 ? 0 : factors->pivots[worst])) worst = i;
  if (worst < 0) return 0;
  stage = worst / n_u;
  memset(change->x, 0, (size_t)kpirl_mpc_n_point(core) * sizeof(real));
  memset(change->costates, 0, (size_t)(T * n_s) * sizeof(real));
  memset(change->nu, 0, (size_t)kpirl_mpc_n_equalities(core) * sizeof(real));
  memset(change->z, 0, (size_t)m * sizeof(real));
  for (i = 0; i < n_u; ++i)
    change->x[stage * n_x + n_s + i] = factors->W[stage * n_u * n_u + worst % n_u + i * n_u];
  for (t = stage; t < T; ++t) {
    real *x = change->x + t * n_x;
    if (t > stage) kpirl_mpc_feedback(n_s, n_u, factors, t, x, core->scratch, x + n_s);
    kpirl_mpc_times_vector(core->d.F + t * n_s * n_x, n_s, n_x, x, x + n_x);
  }
  kpirl_mpc_inequalities_times(core, change->x, change->y);
  for (i = 0; i < m; ++i) change->y[i] = -change->y[i];
  return kpirl_mpc_all_finite(change->x, kpirl_mpc_n_point(core));
}

/* The curvature along the step, term by term. With stiff rows rounding may have made a pivot negative. */
static real curvature_along(kpirl_mpc_core *core) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  const int m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core);
  const kpirl_mpc_iterate *change = &core->step.change;
  real *work = core->right, *fixing = core->trial.nu, sum = 0;
  int i, t;
  memset(work, 0, (size_t)kpirl_mpc_n_point(core) * sizeof(real));
  for (t = 0; t <= T; ++t)
    kpirl_mpc_symmetric_times_vector(core->d.H + t * n_x * n_x, t < T ? n_x : n_s, change->x + t * n_x, work + t * n_x);
  sum = kpirl_mpc_dot(change->x, work, kpirl_mpc_n_point(core));
  for (i = 0; i < m; ++i) sum += core->weights[i] * change->y[i] * change->y[i];
  memset(fixing, 0, (size_t)n_c * sizeof(real));
  for (i = 0; i < core->n_fixed; ++i) fixing[i] = change->x[core->fixed[i]];
  kpirl_mpc_equality_times(core, change->x, fixing + core->n_fixed);
  for (i = 0; i < n_c; ++i) sum += core->stiffness[i] * fixing[i] * fixing[i];
  return sum;
}

static void turn(kpirl_mpc_core *core) {
  const int n_w = kpirl_mpc_n_point(core), m = kpirl_mpc_n_inequalities(core);
  int i;
  for (i = 0; i < n_w; ++i) core->step.change.x[i] = -core->step.change.x[i];
  for (i = 0; i < m; ++i) core->step.change.y[i] = -core->step.change.y[i];
}

/* Move along the step, of curvature -1, to where the barrier function is lower. */
static int move_off(kpirl_mpc_core *core, real shortest) {
  const real phi = core->d.objective - core->tau * kpirl_mpc_log_sum(core->at.y, kpirl_mpc_n_inequalities(core));
  kpirl_mpc_merit trial;
  real length;
  for (length = 1; length >= shortest; length *= SHORTENED) {
    ++core->trials;
    kpirl_mpc_trial_point(core, length, 0, &trial);
    if (trial.theta <= core->filter.small && trial.phi < phi - (real)0.1 * length * length) {
      core->step.primal_length = length;
      kpirl_mpc_accept_trial(core, KPIRL_MPC_SECOND);
      return 1;
    }
  }
  return 0;
}

/* At a point that meets the first-order conditions: 0 where it is a minimum, a flat one too, or rounding hides what it is; 1 where it is
 * none and was left, -1 where it is none and no way led down from it, be it as short as `shortest` times the direction. */
int kpirl_mpc_escape(kpirl_mpc_core *core, real shortest) {
  kpirl_mpc_step *step = &core->step;
  core->trials = 0;
  if (kpirl_mpc_factorise(core, 0) || kpirl_mpc_factorise(core, FLAT * kpirl_mpc_largest_curvature(core))) return 0;
  if (!find_negative_curvature(core)) return -1;
  if (curvature_along(core) > -SURE) return 0;
  step->tau = core->tau;
  step->share = KPIRL_MPC_BOUNDARY;
  step->dual_length = 0;
  if (kpirl_mpc_slope(core) > 0) turn(core);
  if (move_off(core, shortest)) return 1;
  turn(core);
  return move_off(core, shortest) ? 1 : -1;
}
