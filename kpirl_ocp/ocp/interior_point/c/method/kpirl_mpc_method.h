/* SPDX-License-Identifier: MIT
 *
 * The parts of the interior-point method: where it begins, its steps (method), how far they go (globalisation), and where it ends.
 */
#ifndef KPIRL_MPC_METHOD_H
#define KPIRL_MPC_METHOD_H

#include "kpirl_mpc_core.h"

/* start */
void kpirl_mpc_cold_start(kpirl_mpc_core *core, const real *x);
void kpirl_mpc_estimate_costates(kpirl_mpc_core *core);
void kpirl_mpc_begin_here(kpirl_mpc_core *core, real tau);
void kpirl_mpc_begin_lightly(kpirl_mpc_core *core, real tau);
void kpirl_mpc_warm_start(kpirl_mpc_core *core, const kpirl_mpc_start *start, real tau);

/* newton */
/* delta: of equalities, see kpirl_mpc_newton.c. Its inverse is added to numbers of size one, so that it has to leave some digits
 * of them. */
#ifdef KPIRL_MPC_FLOAT
#define KPIRL_MPC_PROXIMAL ((real)1e-4)
#else
#define KPIRL_MPC_PROXIMAL ((real)1e-9)
#endif
#define KPIRL_MPC_BOUNDARY ((real)0.99) /* the smallest fraction to the boundary */
/* The factors of the condensed Hessian; returns whether it is positive along the dynamics. */
int kpirl_mpc_factorise(kpirl_mpc_core *core, real regularisation);
void kpirl_mpc_newton_step(kpirl_mpc_core *core, real regularisation);
/* The step for these factors and core->target, what y z is to become; then its lengths, with the fraction to the boundary. */
void kpirl_mpc_step_to_target(kpirl_mpc_core *core, kpirl_mpc_iterate *change);
real kpirl_mpc_longest(const real *value, const real *change, int count, real share);
void kpirl_mpc_limit_lengths(kpirl_mpc_core *core);

/* corrector: `least` is the tau to stop at */
void kpirl_mpc_corrected_step(kpirl_mpc_core *core, real least);
void kpirl_mpc_correct_newton_step(kpirl_mpc_core *core);

/* Are steps lifted, where steps along the dynamics are the other way; and off the dynamics so far? */
int kpirl_mpc_lifts(const kpirl_mpc_core *core);
int kpirl_mpc_off_dynamics(const kpirl_mpc_core *core);

/* violation: sizes of states and actions at core->at, without F before it is known; |states| in these sizes, summed over stages;
 * the price of a unit with these costates */
void kpirl_mpc_measure(kpirl_mpc_core *core, const real *F);
int kpirl_mpc_outgrown(const kpirl_mpc_core *core);
real kpirl_mpc_norm_in_sizes(const kpirl_mpc_core *core, const real *states, int stages);
real kpirl_mpc_price(const kpirl_mpc_core *core, const real *costates);
real kpirl_mpc_slack_violation(const kpirl_mpc_core *core, const real *g, const real *y);
real kpirl_mpc_equality_violation(const kpirl_mpc_core *core, const real *c);
real kpirl_mpc_violation(const kpirl_mpc_core *core);
real kpirl_mpc_violation_rounding(const kpirl_mpc_core *core);

/* trial */
/* What remains of g + y where a constraint has no interior, because no decision moves it (a bound on which a system at rest begins)
 * or it leaves one point: a slack of the tolerance at g = 0. If it vanished, its multiplier would grow without bound. */
static inline real kpirl_mpc_room(const kpirl_mpc_core *core, real g, real y) {
  const real tolerance = (real)core->options.tolerance;
  return y >= tolerance / 2 && y <= 2 * tolerance && kpirl_mpc_abs(g) <= y / 2 ? g + y : 0;
}
/* g + y, but for what remains of it. */
static inline real kpirl_mpc_slack_residual(const kpirl_mpc_core *core, real g, real y) {
  return g + y - kpirl_mpc_room(core, g, y);
}
/* The point at a length of the step, lifted or along the dynamics, into core->trial, with its violation and barrier function. */
void kpirl_mpc_trial_point(kpirl_mpc_core *core, real length, int lifted, kpirl_mpc_merit *merit);
real kpirl_mpc_shortened(const kpirl_mpc_core *core, real length);
void kpirl_mpc_centre(kpirl_mpc_core *core);
real kpirl_mpc_hard_log_sum(const kpirl_mpc_core *core, const real *y);

/* termination: the tau to stop at; the largest residual; do the conditions hold, or as far as rounding lets them; is there no
 * progress any more? */
real kpirl_mpc_final_tau(const kpirl_mpc_core *core);
real kpirl_mpc_worst(const kpirl_mpc_residuals *r);
int kpirl_mpc_solved(const kpirl_mpc_core *core);
int kpirl_mpc_acceptable(const kpirl_mpc_core *core);
int kpirl_mpc_idle(kpirl_mpc_core *core);

/* curvature */
int kpirl_mpc_escape(kpirl_mpc_core *core, real shortest);
real kpirl_mpc_largest_curvature(const kpirl_mpc_core *core);

/* regularisation: is there a step? A weight for shorter ones; the unit of weights */
int kpirl_mpc_find_positive_step(kpirl_mpc_core *core, real regularisation, int indefinite);
real kpirl_mpc_stronger(const kpirl_mpc_core *core);
real kpirl_mpc_unit_weight(const kpirl_mpc_core *core);

/* line search: the derivative of the barrier function along the step; `least` is the tau to stop at. The others return whether
 * they moved. */
real kpirl_mpc_slope(const kpirl_mpc_core *core);
int kpirl_mpc_newton_iterate(kpirl_mpc_core *core, int indefinite);
int kpirl_mpc_iterate_once(kpirl_mpc_core *core, real least);
/* Go to the trial point; `level` says how much to find out about it. */
void kpirl_mpc_accept_trial(kpirl_mpc_core *core, int level);

/* elastic: can an inequality be replaced by its penalty, and is it? The penalty at values of g and c; its slopes and curvatures at the
 * iterate; what the step does to it; the end of it. */
int kpirl_mpc_can_be_elastic(const kpirl_mpc_core *core, int row);
static inline int kpirl_mpc_is_elastic(const kpirl_mpc_core *core, int row) {
  return core->penalty > 0 && kpirl_mpc_can_be_elastic(core, row);
}
int kpirl_mpc_has_elastic(const kpirl_mpc_core *core); /* is there one that could be? */
void kpirl_mpc_measure_rows(kpirl_mpc_core *core); /* before elastic mode begins */
int kpirl_mpc_too_heavy(kpirl_mpc_core *core, const real *multipliers, int first, int count); /* of rows from the first on */
real kpirl_mpc_penalty(const kpirl_mpc_core *core, const real *g, const real *c);
void kpirl_mpc_penalty_slopes(const kpirl_mpc_core *core, real *z, real *nu);
void kpirl_mpc_weigh_elastic(kpirl_mpc_core *core);
real kpirl_mpc_elastic_complementarity(const kpirl_mpc_core *core);
void kpirl_mpc_elastic_step(kpirl_mpc_core *core);
void kpirl_mpc_harden(kpirl_mpc_core *core);

/* restoration: is most of the violation gone, so that the method proper can go on from these slacks? Shown infeasible: stationary
 * for the violation */
typedef enum { KPIRL_MPC_NOT_RESTORED, KPIRL_MPC_RESTORED, KPIRL_MPC_SHOWN_INFEASIBLE } kpirl_mpc_restoration;
kpirl_mpc_restoration kpirl_mpc_restore(kpirl_mpc_core *core);

/* attempts: one after the other, until one is not stuck */
kpirl_mpc_status kpirl_mpc_attempt(kpirl_mpc_core *core, const kpirl_mpc_start *start);

/* one attempt: until the conditions hold or the method is stuck, or so many fixed steps; the tau to start from here; is the time over?
 * A line of the log */
kpirl_mpc_status kpirl_mpc_converge(kpirl_mpc_core *core);
kpirl_mpc_status kpirl_mpc_advance(kpirl_mpc_core *core);
real kpirl_mpc_start_tau(const kpirl_mpc_core *core);
int kpirl_mpc_core_out_of_time(const kpirl_mpc_core *core);
void kpirl_mpc_log_iteration(const kpirl_mpc_core *core);

/* filter */
void kpirl_mpc_start_filter(kpirl_mpc_core *core);
void kpirl_mpc_shift_filter(kpirl_mpc_filter *filter, real from, real to);
/* Price: of violation, where it is rounding. */
int kpirl_mpc_filter_accepts(kpirl_mpc_filter *filter, kpirl_mpc_merit before, real slope, real length, real price, kpirl_mpc_merit trial);

#endif
