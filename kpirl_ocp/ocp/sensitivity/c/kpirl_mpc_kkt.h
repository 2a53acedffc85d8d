/* SPDX-License-Identifier: MIT
 *
 * The KKT conditions linearised at a solution, the gradients that follow from them, and the evidence for these gradients.
 */
#ifndef KPIRL_MPC_KKT_H
#define KPIRL_MPC_KKT_H

#include "kpirl_mpc_core.h"
#include "kpirl_mpc_system.h"

/* The m constraints of a problem but its dynamics: finite lower bounds, finite upper bounds, h and h_T, e and e_T. */
typedef struct kpirl_mpc_rows {
  int n_free, n_bounds, n_decisions;
  int quadratic;                         /* are second derivatives by x, and those of constraints, the same at every x? */
  const int *free, *entries, *decisions; /* as in kpirl_mpc_system */
  const int *inequality, *equality;      /* (m) 1 for rows that may be active or not, and for those that always are */
  const int *other;                      /* (n_bounds) the row of the other side, or the row itself where that is not bounded */
  const real *signs, *limits;            /* (n_bounds) slack = sign (limit - x) */
  const real *largest_bound;             /* (n_w) of each entry of x, zero where there is none */
  const real *normal, *uniform, *spread; /* random numbers, always the same: (n_w or m) normal; (the longest array) in [1/2, 1),
                                            and (n_w) of either sign */
} kpirl_mpc_rows;

/* Functions of the parameters. phi is the sum of weights dx, dcostates, dz, dnu times the gradient of the Lagrangian, the
 * defects, path constraints and equalities. */
typedef struct kpirl_mpc_weighted_arguments {
  const real *x, *psi, *context, *costates, *z, *nu, *dx, *dcostates, *dz, *dnu;
} kpirl_mpc_weighted_arguments;

typedef struct kpirl_mpc_weighted_results {
  real *by_psi, *by_context; /* of phi */
} kpirl_mpc_weighted_results;

typedef struct kpirl_mpc_weighted {
  int (*evaluate)(void *self, const kpirl_mpc_weighted_arguments *arguments, const kpirl_mpc_weighted_results *results);
  void *self;
} kpirl_mpc_weighted;

/* A loss of the trajectory: S (T+1, n_s) and U (T, n_u) -> value and slopes. */
typedef struct kpirl_mpc_loss_arguments {
  const real *states, *actions, *data;
} kpirl_mpc_loss_arguments;

typedef struct kpirl_mpc_loss_results {
  real *value, *by_states, *by_actions;
} kpirl_mpc_loss_results;

typedef struct kpirl_mpc_loss {
  int (*evaluate)(void *self, const kpirl_mpc_loss_arguments *arguments, const kpirl_mpc_loss_results *results);
  void *self;
} kpirl_mpc_loss;

/* A point of the program and the conditions there. The matrices of the system may be of other memory than this structure's. */
typedef struct kpirl_mpc_kkt {
  kpirl_mpc_system system;
  const kpirl_mpc_rows *rows;
  kpirl_mpc_dimensions dimensions;
  kpirl_mpc_numbers numbers;
  kpirl_mpc_triple point;   /* x, costates and multipliers of the rows; start is not used */
  kpirl_mpc_triple adjoint; /* of a function; start: error of the rows of s_0 of their product with it where matrices are stale */
  kpirl_mpc_triple move;    /* the Newton step */
  real barrier, objective;
  real *gradient, *defects; /* of the Lagrangian without bounds (n_w); f - s_next */
  real *slack;              /* (m) of inequalities; of equalities minus their value */
  real *pushing;            /* (m) multipliers of active rows; tau / slack of smoothed ones; zero */
  real *curvature;          /* (n_w) kpirl_mpc_system_curvature */
  real *row_sizes;          /* (m) */
  real *lowest_mode;            /* (n_w) direction of the smallest eigenvalue of the reduced Hessian */
  kpirl_mpc_factors row_factors; /* of the products of the active rows, for `qualification` */
  real *origin;               /* (n_w) x before it was polished */
  real *slope;                /* (n_w) of the function that kpirl_mpc_certify differentiates */
  real *shares;               /* (m) kpirl_mpc_force_shares */
  real *tangent;              /* (n_w) change of x as parameters move in kpirl_mpc_kink_in_parameters; zero until it is known */
  real *derivatives, *work;
  real lowest, qualification; /* that eigenvalue; the smallest singular value of the active rows */
  real step, margin;          /* kpirl_mpc_kkt_step, kpirl_mpc_kkt_reach */
  real distance;              /* kpirl_mpc_kkt_polish */
  int evaluated, factored, immovable, conditioned, stepped, reached; /* what is known; immovable: does no decision move some active row? */
  int borrowed; /* are the factors those of a point close by? */
  int stale;    /* are the matrices? */
} kpirl_mpc_kkt;

/* Measurements, as in Python's SensitivityCertificate. */
typedef struct kpirl_mpc_evidence {
  real curvature, qualification, distance, step, margin, change, kink, linear_residual;
} kpirl_mpc_evidence;

/* Gradients by psi, s_0 and the context. */
typedef struct kpirl_mpc_by_parameters {
  real *psi, *s0, *context;
} kpirl_mpc_by_parameters;

/* The roots of the decisions: of the curvature of each by itself, the largest over the horizon. */
void kpirl_mpc_find_roots(kpirl_mpc_kkt *kkt);

/* Forces (m) over the others on one of the entries of x that they act on, into `relative`; and one slack over the sizes of what it is
 * made of. */
void kpirl_mpc_relative_forces(const kpirl_mpc_kkt *kkt, const real *forces, real *relative);
static inline real kpirl_mpc_relative_slack(const kpirl_mpc_kkt *kkt, const real *slack, int row) {
  const real size = kkt->row_sizes[row];
  return size > 0 ? slack[row] / size : slack[row] > 0 ? (real)INFINITY : slack[row];
}

/* Lay out memory for a problem; returns how many numbers it takes. memory NULL: count only. */
size_t kpirl_mpc_kkt_init(kpirl_mpc_kkt *kkt, const kpirl_mpc_dimensions *dimensions, const kpirl_mpc_rows *rows, real *memory);

/* A solution as kkt->point: S (T+1, n_s), U (T, n_u), and the multipliers of the dynamics (T, n_s), of the bounds of S and U, positive
 * at an upper and negative at a lower one, of h, h_T, e and e_T, row by row; then psi and the context, one array after the other.
 * They must stay: kkt->numbers begin to show these, but for the schedule. Of the two sides of a bound, the force is on the one that
 * pushes; with a barrier, `pushing` has those of both. */
void kpirl_mpc_kkt_set_solution(kpirl_mpc_kkt *kkt, const real *solution);

/* Derivatives at kkt->point: evaluated by a core; or set to a row of kpirl_mpc_put_derivatives, which must stay. */
void kpirl_mpc_kkt_evaluate(kpirl_mpc_kkt *kkt, kpirl_mpc_core *core);
void kpirl_mpc_kkt_set_derivatives(kpirl_mpc_kkt *kkt, const real *derivatives);

/* The gradient of the Lagrangian and values alone at kkt->point: the matrices stay those of a point close by. And matrices at
 * kkt->point, where they are stale. */
void kpirl_mpc_kkt_update(kpirl_mpc_kkt *kkt, kpirl_mpc_core *core);
void kpirl_mpc_kkt_renew(kpirl_mpc_kkt *kkt, kpirl_mpc_core *core);

/* x (n_w) of S (T+1, n_s) and U (T, n_u). */
void kpirl_mpc_by_stage(const kpirl_mpc_dimensions *dimensions, const real *states, const real *actions, real *x);

/* A point as a core takes it. */
kpirl_mpc_start kpirl_mpc_start_at(const kpirl_mpc_system *system, const kpirl_mpc_triple *point);

/* Sizes, stiffness of smoothed rows, active rows (where `active` is NULL those that the point suggests), forces and roots. Returns
 * whether all is finite. */
int kpirl_mpc_kkt_select(kpirl_mpc_kkt *kkt, const real *active);

/* All of these for a solution, polished where all is finite; derivatives NULL: they are evaluated. */
int kpirl_mpc_kkt_linearise(kpirl_mpc_kkt *kkt, kpirl_mpc_core *core, const real *solution, const real *derivatives);

/* The same where the point has moved so little that sizes, active rows and roots stay. */
int kpirl_mpc_kkt_select_again(kpirl_mpc_kkt *kkt);

/* Sizes, stiffness and active rows as elsewhere: enough for kpirl_mpc_kkt_change. */
void kpirl_mpc_kkt_select_nearby(kpirl_mpc_kkt *kkt, const real *active);

/* Factors; and lowest, lowest_mode and qualification; unless they are known. */
void kpirl_mpc_kkt_factor(kpirl_mpc_kkt *kkt);
void kpirl_mpc_kkt_condition(kpirl_mpc_kkt *kkt);

/* Solve by refinement until the relative residual is `enough` or meets the rounding; returns it. Factors that are those of a point
 * close by are renewed where they leave more than what is `needed`. */
real kpirl_mpc_kkt_refine(kpirl_mpc_kkt *kkt, const kpirl_mpc_triple *right, real enough, real needed, kpirl_mpc_triple *point);

/* Solve to what is `needed`: by one substitution where that is exact to rounding, else by refinement. */
void kpirl_mpc_kkt_solve_directly(kpirl_mpc_kkt *kkt, const kpirl_mpc_triple *right, real needed, kpirl_mpc_triple *point);

/* The Newton step on the conditions with this active set, kkt->move, and its length in the decisions, relative to their sizes,
 * kkt->step; unless they are known. */
void kpirl_mpc_kkt_step(kpirl_mpc_kkt *kkt);

/* Newton steps from the point until one is short, as long as each is much shorter than the one before; none where the first is long.
 * Solvers have tolerances in units of the cost, so that a small cost leaves solutions far from exact. kkt->distance: how far the
 * point has moved, measured as the step. */
void kpirl_mpc_kkt_polish(kpirl_mpc_kkt *kkt, kpirl_mpc_core *core);

/* Where the step leads, and a little further along the lowest mode, into nearby->point; and the smallest multiplier of an
 * active and slack of an inactive inequality after it, relative, into kkt->margin. */
void kpirl_mpc_kkt_reach(kpirl_mpc_kkt *kkt, kpirl_mpc_kkt *nearby);

/* Relative change of the adjoint (r, 0, 0) -> point when the system becomes one nearby; point becomes the adjoint there. */
real kpirl_mpc_kkt_change(const kpirl_mpc_kkt *kkt, kpirl_mpc_kkt *nearby, const real *r, kpirl_mpc_triple *point);

/* Gradient of the Lagrangian, defects, path constraints and equalities at a point; NaN where a function failed; and the same at
 * kkt->point, from what is known there. They return the Lagrangian with the forces of kkt->point. */
int kpirl_mpc_n_conditions(const kpirl_mpc_system *system);
real kpirl_mpc_conditions(const kpirl_mpc_kkt *kkt, kpirl_mpc_core *core, const kpirl_mpc_numbers *numbers,
                          const kpirl_mpc_triple *point, real *values);
real kpirl_mpc_known_conditions(const kpirl_mpc_kkt *kkt, real *values);

/* The conditions where s_0 alone differs from kkt->point, where they are known: those of stage 0 are evaluated. For a model by stage. */
void kpirl_mpc_start_conditions(const kpirl_mpc_kkt *kkt, kpirl_mpc_core *core, const kpirl_mpc_numbers *numbers,
                                const kpirl_mpc_triple *point, real *values);

/* Relative disagreement of the conditions, differenced to either side along x (n_w), with their derivatives. */
real kpirl_mpc_kink_along(const kpirl_mpc_kkt *kkt, kpirl_mpc_core *core, const real *direction);
static const real KPIRL_MPC_DIFFERENCE = (real)1e-6; /* step of a difference quotient, relative: truncation 1e-12, rounding 1e-10 */
static const real KPIRL_MPC_CLOSER = (real)0.1;      /* of two steps the shorter one; jumps do not shrink with it */
static const real KPIRL_MPC_FLOOR = (real)1e-9;      /* share of a whole gradient below which one of its entries may be rounding */
static const real KPIRL_MPC_NO_KINK = (real)1e-3;    /* disagreement above which a shorter move is tried, too */

/* The same along an adjoint, its multipliers included, at the point nearby, and by differences the residual that the adjoint has in
 * the system there. Without a barrier. */
real kpirl_mpc_kink_nearby(const kpirl_mpc_kkt *kkt, const kpirl_mpc_kkt *nearby, kpirl_mpc_core *core,
                           const kpirl_mpc_triple *adjoint, kpirl_mpc_triple *residual);

/* The same along psi, s_0 (where `by_start` is given) and the context, and the relative jump of derivatives by them, for
 * conditions that are weighted. by: the derivatives of the weighted conditions. */
real kpirl_mpc_kink_in_parameters(const kpirl_mpc_kkt *kkt, kpirl_mpc_core *core, const kpirl_mpc_weighted *function,
                                  const kpirl_mpc_triple *weights, const kpirl_mpc_by_parameters *by);

/* The sum of weights times conditions, and that of their absolute values, `sizes`, where that is not NULL; and the former where psi, s_0
 * and the context have moved by `length` times `moves`, with the conditions there, `values`. */
real kpirl_mpc_weighted_sum(const kpirl_mpc_system *system, const kpirl_mpc_triple *weights, const real *values, real *sizes);
real kpirl_mpc_moved_weighted_sum(const kpirl_mpc_kkt *kkt, kpirl_mpc_core *core, const kpirl_mpc_triple *weights, const real *moves,
                                  real length, real *values, real *work);

/* Along the plan that derivatives predict where the parameters move, slopes of the weighted conditions are zero to both sides if the
 * problem is smooth: returns what they are, relative to `total`, without what is proportional to the step (curvature). Where the
 * plan does not move as predicted, returns by which share of its move. left, at, right: conditions where parameters alone have
 * moved, by -1e-6, 0 and 1e-6 of moves. here: the weighted sum. */
real kpirl_mpc_kink_along_plan(const kpirl_mpc_kkt *kkt, kpirl_mpc_core *core, const kpirl_mpc_triple *weights, const real *moves,
                               const real *left, const real *at, const real *right, real here, real total, real *work);

/* Derivatives of the weighted conditions by psi and the context at others than those of the point. Returns 0 when all went well. */
int kpirl_mpc_weigh(const kpirl_mpc_kkt *kkt, const kpirl_mpc_weighted *function, const kpirl_mpc_triple *weights,
                    const real *psi, const real *context, real *by_psi, real *by_context);

/* x, lambda and mu for a right-hand side; returns the relative residual. A singular reduced Hessian divides by zero: infinities
 * and NaN come out, and kkt->lowest says why. */
real kpirl_mpc_kkt_solve(kpirl_mpc_kkt *kkt, const kpirl_mpc_triple *right, kpirl_mpc_triple *point);

/* The solution for (slope, 0, 0), kkt->adjoint; returns its relative residual. */
real kpirl_mpc_kkt_adjoint(kpirl_mpc_kkt *kkt, const real *slope);

/* Derivatives by the parameters of the conditions weighted by an adjoint, and these weights: of smoothed rows the change of their
 * forces is added. The gradients of the function that kkt->adjoint belongs to are minus these. */
void kpirl_mpc_kkt_pull(const kpirl_mpc_kkt *kkt, const kpirl_mpc_weighted *function, kpirl_mpc_triple *adjoint,
                        const kpirl_mpc_by_parameters *by);

/* Gradients of a function with slopes by S (T+1, n_s), then U (T, n_u): by psi, s_0 and the context, and behind them the evidence: the
 * adjoint has to be stable, and the problem smooth along the adjoint, or along `direction` (n_w) where that is given. Returns whether
 * the slopes are finite. */
int kpirl_mpc_certify(kpirl_mpc_kkt *kkt, kpirl_mpc_kkt *nearby, kpirl_mpc_core *core, const kpirl_mpc_weighted *function,
                      const real *slopes, const real *direction, real *answer);

/* Solutions, and the slopes of functions whose gradients are wanted. Arrays hold one row for each, as in kpirl_mpc_kkt_set_solution and
 * kpirl_mpc_certify. */
typedef struct kpirl_mpc_questions {
  const real *solutions, *slopes, *barriers;
} kpirl_mpc_questions;

/* Answers of kpirl_mpc_certify, the active rows (m), and whether all derivatives and the slope are finite: else there is no answer.
 * One row for each. */
typedef struct kpirl_mpc_answers {
  real *answers, *active;
  int *finite;
} kpirl_mpc_answers;

/* Linearise at solutions of a problem and certify, one after the other. */
void kpirl_mpc_certify_each(kpirl_mpc_kkt *kkt, kpirl_mpc_kkt *nearby, kpirl_mpc_core *core, const kpirl_mpc_weighted *function,
                            int count, const kpirl_mpc_questions *questions, const kpirl_mpc_answers *answers);

/* Sizes (n_w) of the entries of x: the largest absolute value over the horizon, finite bounds included. */
void kpirl_mpc_point_sizes(const kpirl_mpc_dimensions *dimensions, const kpirl_mpc_rows *rows, const real *x, real *sizes);

/* Value and slopes of a loss at x, by S, then U; and the relative jump of the slopes, or disagreement of differences with them, along `along`
 * (n_w), or, where that is NULL, a random direction in which given entries of s_0 stay. work: 8 n_w numbers. */
real kpirl_mpc_kink_of_loss(const kpirl_mpc_dimensions *dimensions, const kpirl_mpc_rows *rows, const kpirl_mpc_loss *loss,
                            const real *data, const real *x, const real *along, real *value, real *slopes, real *work);

#endif
