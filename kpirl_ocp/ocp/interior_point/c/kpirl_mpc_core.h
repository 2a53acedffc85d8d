/* SPDX-License-Identifier: MIT
 *
 * What the interior-point method works on: its memory, and the problem at an iterate. See kpirl_mpc_method.h for its parts.
 *
 * The unknowns x = (x_0, .., x_{T-1}, s_T), x_t = (s_t, u_t), are one array. Inequalities g(x) <= 0 are the finite lower
 * bounds, the finite upper bounds, then h and h_T, with slacks y > 0 and multipliers z > 0. Equalities are entries of x whose
 * bounds coincide, then e and e_T, with multipliers nu. The Lagrangian is
 *
 *     J + lambda . (f - s_next) + z . g + nu . equalities.
 */
#ifndef KPIRL_MPC_CORE_H
#define KPIRL_MPC_CORE_H

#include <stddef.h>

#include "kpirl_mpc_model.h"
#include "kpirl_mpc_recursion.h"
#include "kpirl_mpc_status.h"

/* Lower and upper bounds of x, which may be infinite; of s_0 those of its free entries are read. */
typedef struct kpirl_mpc_bounds {
  const real *lower, *upper;
  const int *free_entries; /* (n_free) of s_0 that are decisions */
  int n_free;
} kpirl_mpc_bounds;

typedef struct kpirl_mpc_iterate {
  real *x, *costates, *y, *z, *nu;
} kpirl_mpc_iterate;

/* What is known at an iterate. Matrices are by columns, one stage after the other. */
typedef struct kpirl_mpc_derivatives {
  real objective, violation, scale;
  real *defects;               /* f - s_next (T n_s) */
  real *gap;                   /* given entries of s_0 minus those of the iterate (n_s); zero for free ones */
  real *path, *equality;       /* h and h_T; e and e_T */
  real *g, *c;                 /* all inequalities, all equalities */
  real *cost_gradient;         /* of J by x */
  real *gradient;              /* of the Lagrangian by x; zero at given entries of s_0 */
  real *start_gradient;        /* of the Lagrangian by s_0, given entries included: the derivative of the optimal value */
  real *unconstrained_gradient; /* of the Lagrangian of cost and dynamics alone */
  real *F;                     /* (n_s, n_x) */
  real *G, *E;                 /* transposed: (n_x, n_h) and (n_x, n_e), of s_T (n_s, .) */
  real *H;                     /* (n_x, n_x), of s_T (n_s, n_s); the lower triangle */
  int matrices;                /* are they of this iterate? */
} kpirl_mpc_derivatives;

/* A Newton step towards tau, and the longest lengths that keep y and z positive. */
typedef struct kpirl_mpc_step {
  kpirl_mpc_iterate change;
  real tau, share, primal_length, dual_length, regularisation, slope; /* share: fraction to the boundary of slacks */
  real penalty_slope; /* of elastic constraints; slope: of phi along the last step that was taken */
  int positive; /* is the Hessian along the dynamics? */
} kpirl_mpc_step;

/* Violation and barrier function phi = J - tau sum log y at a point. */
typedef struct kpirl_mpc_merit {
  real theta, phi, log_sum;
} kpirl_mpc_merit;

/* Pairs (theta, phi) that no later iterate may be worse than in both. */
enum { KPIRL_MPC_FILTER_SIZE = 64 };
typedef struct kpirl_mpc_filter {
  real largest, small, feasible; /* theta above which nothing is accepted, below which the objective decides, and rounding */
  kpirl_mpc_merit pairs[KPIRL_MPC_FILTER_SIZE];
  int count;
} kpirl_mpc_filter;

/* A line of the log. */
typedef struct kpirl_mpc_iteration {
  int iteration, trials, restoring; /* restoring: is this feasibility restoration? */
  real objective, infeasibility, dual_infeasibility, complementarity, tau, step, regularisation, primal_length, dual_length;
} kpirl_mpc_iteration;

typedef struct kpirl_mpc_options {
  int max_iterations;
  int steps;                 /* 0: iterate until the conditions hold; else that many full Newton steps */
  double tolerance, barrier;
  double time_limit;         /* [s] from the start of the solve; 0: none */
  double (*now)(void *);     /* a clock [s], with what it is called with; NULL: none */
  void *clock;
  void (*log)(void *, const kpirl_mpc_iteration *); /* called after every iteration; NULL: none */
  void *log_to;
} kpirl_mpc_options;

typedef struct kpirl_mpc_residuals {
  real stationarity, feasibility, complementarity, scale;
} kpirl_mpc_residuals;

typedef struct kpirl_mpc_core {
  kpirl_mpc_dimensions dimensions;
  kpirl_mpc_model model;
  kpirl_mpc_bounds bounds;
  kpirl_mpc_numbers numbers;
  kpirl_mpc_options options;

  int n_lower, n_upper, n_fixed; /* entries of x */
  int *lower, *upper, *fixed;
  kpirl_mpc_iterate at, trial;
  kpirl_mpc_derivatives d;
  kpirl_mpc_step step, first;
  kpirl_mpc_factors factors;
  kpirl_mpc_filter filter;
  real *M;              /* the condensed Hessian of a stage (n_x, n_x) */
  real *weights, *force; /* of inequalities */
  real *stiffness;      /* of equalities */
  real *sizes, *units;  /* of states and actions (n_x), of inequalities (m); see kpirl_mpc_violation.c */
  real *row_sizes;      /* of the gradients of inequalities, then equalities (m + n_c), for elastic mode */
  real *target;         /* of y z (m) */
  real *right, *start;  /* right-hand side (n_w), and of s_0 (n_s) */
  real *scratch;
  real *nonzeros;       /* of a function's result */
  real *states, *actions; /* gathered for functions of the whole horizon */
  real penalty; /* rho of elastic mode, see kpirl_mpc_elastic.c; 0 otherwise */
  real tau, indefinite_tau, escaped_tau; /* tau to go back to where the Hessian is not positive; at which a saddle was left */
  real first_violation;        /* sum over all constraints, as they were stated, where the first attempt began */
  real start_tau, most_violation, most_gradient; /* tau at the beginning; the largest violation and gradient since */
  real tolerance, regularisation, best[3]; /* best: the smallest residuals so far */
  double started;
  int iterations, trials, idle, creeping; /* idle: iterations since one of `best` was halved; creeping: since a step was long */
  int rises;                   /* of tau in this attempt */
  int lifted, held;            /* are steps lifted, or along the dynamics? was tau held where the Hessian was not positive? */
  int indefinite;              /* was a Hessian not positive since this attempt or restoration began? */
  int no_costates;             /* are they zero because nothing is known about them? */
  int failed;                  /* has a function reported an error? */
  int factored, settled;       /* are the factors those of this iterate, without regularisation? the matrices those of any? */
} kpirl_mpc_core;

/* n_w, the number of bounds, m and the number of equalities. */
int kpirl_mpc_n_point(const kpirl_mpc_core *core);
int kpirl_mpc_n_bounds(const kpirl_mpc_core *core);
int kpirl_mpc_n_inequalities(const kpirl_mpc_core *core);
int kpirl_mpc_n_equalities(const kpirl_mpc_core *core);

/* How many numbers the memory of a core holds, in how many arrays behind `head` bytes; for memory of a constant size. */
typedef struct kpirl_mpc_core_count {
  size_t head, reals, integers, arrays;
} kpirl_mpc_core_count;

void kpirl_mpc_count_core(const kpirl_mpc_dimensions *dimensions, const kpirl_mpc_bounds *bounds,
                          const kpirl_mpc_model *model, kpirl_mpc_core_count *count);

/* Bytes for a problem, and the core in that memory, aligned as from malloc; what the pointers of the arguments show is not
 * copied and must stay. */
size_t kpirl_mpc_core_size(const kpirl_mpc_dimensions *dimensions, const kpirl_mpc_bounds *bounds,
                           const kpirl_mpc_model *model);
kpirl_mpc_core *kpirl_mpc_core_init(const kpirl_mpc_dimensions *dimensions, const kpirl_mpc_bounds *bounds,
                                    const kpirl_mpc_model *model, void *memory);

/* Other functions for the same problem, of the same patterns; other numbers. */
void kpirl_mpc_core_set_model(kpirl_mpc_core *core, const kpirl_mpc_model *model);
void kpirl_mpc_set_numbers(kpirl_mpc_core *core, const kpirl_mpc_numbers *numbers);

/* A trajectory to start from, x and, for a warm start, costates, net multipliers of the bounds of x (positive at an upper
 * bound), of h and h_T, and of e and e_T; costates NULL: a cold start. x NULL: from no action. */
typedef struct kpirl_mpc_start {
  const real *x, *costates, *bounds, *path, *equality;
} kpirl_mpc_start;

/* Solve from a start. The solution is core->at, with residuals; multipliers of bounds by kpirl_mpc_bound_multipliers. */
kpirl_mpc_status kpirl_mpc_core_solve(kpirl_mpc_core *core, const kpirl_mpc_numbers *numbers,
                                      const kpirl_mpc_options *options, const kpirl_mpc_start *start,
                                      kpirl_mpc_residuals *residuals);

/* Net multipliers (n_w) of the bounds of x, fixed entries included; of a given s_0 the derivative of the optimal value. */
void kpirl_mpc_bound_multipliers(const kpirl_mpc_core *core, real *net);

/* Where the core keeps what it knows; the addresses may change with every solve. See the structures above. */
typedef struct kpirl_mpc_view {
  const real *x, *costates, *path_multipliers, *equality_multipliers; /* of h and h_T; of e and e_T */
  const real *defects, *path, *equality, *gradient, *F, *G, *E, *H;
  real objective, tau;
  int iterations, matrices;
} kpirl_mpc_view;

void kpirl_mpc_core_view(const kpirl_mpc_core *core, kpirl_mpc_view *view);

/* The gradient r (n_w) by x of the Lagrangian of cost, dynamics and constraints but bounds, at core->at. */
void kpirl_mpc_core_gradient(const kpirl_mpc_core *core, real *r);

/* What was evaluated last as a row: objective, defects, h and h_T, e and e_T, F, G, E, and of H both triangles, behind a gradient of
 * the Lagrangian (n_w) whose place is left to the caller. Returns how many numbers; 0 without second derivatives. row NULL: count
 * only. */
int kpirl_mpc_put_derivatives(const kpirl_mpc_core *core, real *row);

/* Values and derivatives of a level at a point: x, costates, and the multipliers of constraints; those of bounds are not read.
 * They are core->d, but for what depends on bounds; core->d.gradient is that of kpirl_mpc_core_gradient. Returns 0, or 1 when a
 * function reported an error. */
int kpirl_mpc_core_evaluate_at(kpirl_mpc_core *core, const kpirl_mpc_numbers *numbers, const kpirl_mpc_start *point, int level);

/* The same of stage 0 alone, for a model by stage; what belongs to the other stages, and to all together, is left as it is. */
int kpirl_mpc_core_evaluate_start(kpirl_mpc_core *core, const kpirl_mpc_numbers *numbers, const kpirl_mpc_start *point, int level);

/* ---- parts ---- */

/* model: evaluate at core->at into core->d. */
void kpirl_mpc_evaluate(kpirl_mpc_core *core, int level);
void kpirl_mpc_evaluate_stage_0(kpirl_mpc_core *core, int level);
/* The states in x become those that its actions lead to from its s_0. */
void kpirl_mpc_roll_out(kpirl_mpc_core *core, real *x);
/* Objective, path, equality and defects at x; `path` and the others are arrays as in kpirl_mpc_derivatives. */
void kpirl_mpc_evaluate_values(kpirl_mpc_core *core, const real *x, real *objective, real *defects, real *path,
                               real *equality);
/* The values of a trajectory that follows the dynamics, with the feedback of the last factors, see kpirl_mpc_evaluation.c. */
void kpirl_mpc_feedback_rollout(kpirl_mpc_core *core, real length, real *objective, real *path, real *equality);

/* constraints */
void kpirl_mpc_inequalities(const kpirl_mpc_core *core, const real *x, const real *path, real *g);
void kpirl_mpc_equalities(const kpirl_mpc_core *core, const real *x, const real *equality, real *c);
void kpirl_mpc_gap(const kpirl_mpc_core *core, const real *x, real *gap);
/* The entry of x that a row among the bounds is of. */
int kpirl_mpc_bounded_entry(const kpirl_mpc_core *core, int row);
/* values (m) = the Jacobian of all inequalities times x */
void kpirl_mpc_inequalities_times(const kpirl_mpc_core *core, const real *x, real *values);
/* Of h and h_T, and of e and e_T: values += G x, values += E x, product += G' z, product += E' nu; and of the bounds, to which
 * the multipliers at the front of z and nu belong. */
void kpirl_mpc_path_times(const kpirl_mpc_core *core, const real *x, real *values);
void kpirl_mpc_path_transposed_times(const kpirl_mpc_core *core, const real *z, real *product);
void kpirl_mpc_equality_times(const kpirl_mpc_core *core, const real *x, real *values);
void kpirl_mpc_equality_transposed_times(const kpirl_mpc_core *core, const real *nu, real *product);
void kpirl_mpc_bounds_transposed_times(const kpirl_mpc_core *core, const real *z, const real *nu, real *product);

/* derivatives */
void kpirl_mpc_differentiate(kpirl_mpc_core *core, int level);
void kpirl_mpc_find_residuals(const kpirl_mpc_core *core, real tau, kpirl_mpc_residuals *residuals);
/* of all constraints, elastic ones too */
real kpirl_mpc_largest_violation(const kpirl_mpc_core *core);
int kpirl_mpc_subproblem_solved(const kpirl_mpc_core *core); /* for core->tau, as far as tau is to fall */

#endif
