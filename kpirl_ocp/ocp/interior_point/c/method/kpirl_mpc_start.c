/* SPDX-License-Identifier: MIT
 *
 * Where the method starts: inside the bounds, with slacks and multipliers.
 */
#include "kpirl_mpc_method.h"

#include <string.h>

static const real LARGEST = (real)1e3; /* costates, relative to the gradient */
static const real START = (real)0.1;   /* tau of a cold start, see kpirl_mpc_start_tau */
static const int DOUBLED = 9;          /* how often multipliers of bounds of a cold start are, until the Hessian is positive */
static const real USELESS = (real)0.01; /* length of a first step with light multipliers */
static const real PUSH = (real)0.4; /* how far a cold start is moved inside its bounds, relative to size and distance */

/* x inside its bounds (Waechter and Biegler, 2006, section 3.6), by less where all of a state or action is small; and onto them
 * where they coincide. */
static void move_inside(kpirl_mpc_core *core, real *x) {
  const int n_x = DIM(core, n_states) + DIM(core, n_actions);
  const real *lower = core->bounds.lower, *upper = core->bounds.upper;
  int side, i;
  for (side = 0; side < 2; ++side)
    for (i = 0; i < (side ? core->n_upper : core->n_lower); ++i) {
      const int entry = side ? core->upper[i] : core->lower[i];
      const real size = kpirl_mpc_min(core->sizes[entry % n_x], kpirl_mpc_max(1, kpirl_mpc_abs(side ? upper[entry] : lower[entry])));
      const real margin = PUSH * kpirl_mpc_min(size, upper[entry] - lower[entry]);
      x[entry] = side ? kpirl_mpc_min(x[entry], upper[entry] - margin) : kpirl_mpc_max(x[entry], lower[entry] + margin);
    }
  for (i = 0; i < core->n_fixed; ++i) x[core->fixed[i]] = lower[core->fixed[i]];
}

/* g at core->at.x, into core->d.g. */
static void evaluate_inequalities(kpirl_mpc_core *core) {
  real objective;
  kpirl_mpc_evaluate_values(core, core->at.x, &objective, core->d.defects, core->d.path, core->d.equality);
  kpirl_mpc_inequalities(core, core->at.x, core->d.path, core->d.g);
}

/* The size of an entry of h or h_T: the largest that this row of h has at any stage; 1 where it is zero everywhere. */
static real size_of_row(const kpirl_mpc_core *core, int entry) {
  const int n_h = DIM(core, n_path), all = DIM(core, horizon) * n_h, stride = n_h > 0 ? n_h : 1;
  real size = 0;
  int i;
  for (i = entry < all ? entry % n_h : entry; i < (entry < all ? all : entry + 1); i += stride)
    size = kpirl_mpc_max(kpirl_mpc_abs(core->d.path[i]), size);
  return size > 0 ? size : 1;
}

void kpirl_mpc_cold_start(kpirl_mpc_core *core, const real *x) {
  kpirl_mpc_iterate *at = &core->at;
  const int n_w = kpirl_mpc_n_point(core), n_s = DIM(core, n_states), m = kpirl_mpc_n_inequalities(core);
  const int bounds = kpirl_mpc_n_bounds(core);
  int i;
  if (x) {
    memmove(at->x, x, (size_t)n_w * sizeof(real));
  } else {
    memset(at->x, 0, (size_t)n_w * sizeof(real));
    memcpy(at->x, core->numbers.s0, (size_t)n_s * sizeof(real));
    kpirl_mpc_roll_out(core, at->x);
  }
  kpirl_mpc_measure(core, NULL);
  move_inside(core, at->x);
  memset(at->costates, 0, (size_t)(DIM(core, horizon) * n_s) * sizeof(real));
  memset(at->nu, 0, (size_t)kpirl_mpc_n_equalities(core) * sizeof(real));
  memset(at->z, 0, (size_t)m * sizeof(real));
  evaluate_inequalities(core);
  for (i = 0; i < bounds; ++i) at->y[i] = -core->d.g[i];
  for (i = 0; i < m - bounds; ++i) at->y[bounds + i] = kpirl_mpc_max(-core->d.path[i], PUSH * size_of_row(core, i));
}

/* Costates for which the Lagrangian is stationary by s_1 .. s_T, by the adjoint recursion from those of zero; unless they would
 * be too large to be of use (Waechter and Biegler, 2006, section 3.6). */
void kpirl_mpc_estimate_costates(kpirl_mpc_core *core) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  const real *gradient = core->d.gradient;
  real *costates = core->at.costates;
  int t;
  for (t = T; t > 0; --t) {
    real *costate = costates + (t - 1) * n_s;
    memcpy(costate, gradient + t * n_x, (size_t)n_s * sizeof(real));
    if (t < T) kpirl_mpc_transposed_times_vector(core->d.F + t * n_s * n_x, n_s, n_s, costate + n_s, costate);
  }
  if (!(kpirl_mpc_norm_inf(costates, T * n_s) <= LARGEST * kpirl_mpc_norm_inf(gradient, kpirl_mpc_n_point(core))))
    memset(costates, 0, (size_t)(T * n_s) * sizeof(real));
}

void kpirl_mpc_warm_start(kpirl_mpc_core *core, const kpirl_mpc_start *start, real tau) {
  kpirl_mpc_iterate *at = &core->at;
  const int T = DIM(core, horizon), m = kpirl_mpc_n_inequalities(core), bounds = kpirl_mpc_n_bounds(core);
  int i;
  memmove(at->x, start->x, (size_t)kpirl_mpc_n_point(core) * sizeof(real));
  memmove(at->costates, start->costates, (size_t)(T * DIM(core, n_states)) * sizeof(real));
  for (i = 0; i < core->n_fixed; ++i) at->nu[i] = start->bounds[core->fixed[i]];
  memmove(at->nu + core->n_fixed, start->equality, (size_t)(kpirl_mpc_n_equalities(core) - core->n_fixed) * sizeof(real));
  for (i = 0; i < core->n_lower; ++i) at->z[i] = kpirl_mpc_max(-start->bounds[core->lower[i]], 0);
  for (i = 0; i < core->n_upper; ++i) at->z[core->n_lower + i] = kpirl_mpc_max(start->bounds[core->upper[i]], 0);
  for (i = bounds; i < m; ++i) at->z[i] = kpirl_mpc_max(start->path[i - bounds], 0);
  evaluate_inequalities(core);
  for (i = 0; i < m; ++i) {
    const real g = core->d.g[i], root = kpirl_mpc_sqrt(tau);
    const real least = at->z[i] > 0 ? kpirl_mpc_min(tau / at->z[i], root) : root;
    at->y[i] = isnan(g) ? g : kpirl_mpc_max(-g, least);
    at->z[i] = kpirl_mpc_max(at->z[i], tau / at->y[i]);
  }
}

/* Does entry i of the state stay what it is in a stage's linearised dynamics? */
static int stays(const real *F, int n_s, int n_x, int i) {
  int j;
  for (j = 0; j < n_x; ++j)
    if (F[i + j * n_s] != (j == i)) return 0;
  return 1;
}

/* The slope of the objective by an entry of the state that never changes: the sum over the stages; 0 of any other. */
static real slope_by_static(const kpirl_mpc_core *core, int i) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  real slope = core->d.cost_gradient[T * n_x + i];
  int t;
  for (t = 0; t < T; ++t) {
    if (!stays(core->d.F + t * n_s * n_x, n_s, n_x, i)) return 0;
    slope += core->d.cost_gradient[t * n_x + i];
  }
  return slope;
}

/* The largest slope of the objective by a state, an action, or a static decision, which is free at the start and then stays. */
static real largest_slope(const kpirl_mpc_core *core) {
  const int n_s = DIM(core, n_states);
  real largest = kpirl_mpc_norm_inf(core->d.cost_gradient + n_s, kpirl_mpc_n_point(core) - n_s);
  int i;
  for (i = 0; i < core->bounds.n_free; ++i)
    largest = kpirl_mpc_max(largest, kpirl_mpc_abs(slope_by_static(core, core->bounds.free_entries[i])));
  return largest;
}

/* Where the barrier weighs as a share of the objective: its gradient times the harmonic mean of the slacks. */
real kpirl_mpc_start_tau(const kpirl_mpc_core *core) {
  const int m = kpirl_mpc_n_inequalities(core);
  const real gradient = largest_slope(core);
  real inverse = 0;
  int i;
  for (i = 0; i < m; ++i) inverse += 1 / core->at.y[i];
  return START * (gradient > 0 ? gradient : 1) * (m > 0 ? (real)m / inverse : 1);
}

/* Begin from core->at and its slacks: tau, derivatives, and a new filter. */
static void begin_with(kpirl_mpc_core *core, real tau) {
  int i;
  core->tau = core->start_tau = core->indefinite_tau = tau;
  core->most_violation = core->most_gradient = 0;
  core->held = core->indefinite = core->rises = 0;
  core->escaped_tau = (real)INFINITY;
  core->regularisation = core->step.regularisation = 0;
  core->step.positive = 0; /* there was no step yet */
  core->step.primal_length = 1;
  for (i = 0; i < 3; ++i) core->best[i] = (real)INFINITY;
  core->idle = core->creeping = 0;
  kpirl_mpc_differentiate(core, KPIRL_MPC_SECOND);
  kpirl_mpc_start_filter(core);
}

/* With multipliers of at least tau / y. */
void kpirl_mpc_begin_here(kpirl_mpc_core *core, real tau) {
  const int m = kpirl_mpc_n_inequalities(core);
  int i;
  for (i = 0; i < m; ++i) core->at.z[i] = kpirl_mpc_max(core->at.z[i], tau / core->at.y[i]);
  begin_with(core, tau);
}

/* A bound's multiplier times the average slack of its variable is the same for all bounds, in units of the objective: the average
 * of |gradient of the objective| times the size of the variable, which is this slack, or |x| where there are no bounds. */
static void guess_light_multipliers(kpirl_mpc_core *core) {
  const int n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions), n_w = kpirl_mpc_n_point(core);
  const int bounds = kpirl_mpc_n_bounds(core);
  real *slack = core->scratch, *count = slack + n_x, work = 0; /* slacks of every state and action, over the stages */
  int i;
  memset(slack, 0, (size_t)(2 * n_x) * sizeof(real));
  for (i = 0; i < bounds; ++i) {
    slack[kpirl_mpc_bounded_entry(core, i) % n_x] += core->at.y[i];
    count[kpirl_mpc_bounded_entry(core, i) % n_x] += 1;
  }
  for (i = 0; i < n_x; ++i)
    if (count[i] > 0) slack[i] /= count[i];
  for (i = n_s; i < n_w; ++i)
    work += kpirl_mpc_abs(core->d.cost_gradient[i] * (count[i % n_x] > 0 ? slack[i % n_x] : core->at.x[i]));
  for (i = 0; i < bounds; ++i) core->at.z[i] = work / ((real)(n_w - n_s) * slack[kpirl_mpc_bounded_entry(core, i) % n_x]);
}

/* Can a first step towards tau = 0 be taken, but for a useless part of it? Else multipliers leave a linear cost without curvature. */
static int leaves_room(kpirl_mpc_core *core) {
  const int m = kpirl_mpc_n_inequalities(core);
  memset(core->target, 0, (size_t)m * sizeof(real));
  kpirl_mpc_step_to_target(core, &core->step.change);
  return kpirl_mpc_longest(core->at.y, core->step.change.y, m, 1) >= USELESS;
}

/* The light multipliers of bounds, or as much larger ones as make the Hessian positive; returns whether some of them do, and
 * leave room for a step. */
static int find_light_multipliers(kpirl_mpc_core *core) {
  const int bounds = kpirl_mpc_n_bounds(core);
  int i, doubled;
  guess_light_multipliers(core);
  for (doubled = 0; core->at.z[0] > 0 && doubled <= DOUBLED; ++doubled) {
    if (kpirl_mpc_factorise(core, 0)) return leaves_room(core);
    for (i = 0; i < bounds; ++i) core->at.z[i] *= 2;
  }
  return 0;
}

/* Begin cold, with multipliers of bounds that do not outweigh the objective, as tau / y does, where there are some. */
void kpirl_mpc_begin_lightly(kpirl_mpc_core *core, real tau) {
  const int m = kpirl_mpc_n_inequalities(core), bounds = kpirl_mpc_n_bounds(core);
  real *z = core->at.z;
  int i;
  for (i = 0; i < m; ++i) z[i] = i < bounds ? 0 : tau / core->at.y[i];
  begin_with(core, tau);
  core->factored = bounds > 0 && find_light_multipliers(core);
  for (i = 0; !core->factored && i < bounds; ++i) z[i] = tau / core->at.y[i];
  kpirl_mpc_bounds_transposed_times(core, z, core->at.nu, core->d.gradient);
}
