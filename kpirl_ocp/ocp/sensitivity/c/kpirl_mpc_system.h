/* SPDX-License-Identifier: MIT
 *
 * The linearised KKT conditions at a point, with an active set, and what is to be known of them.
 *
 *     (H + C' sigma C) x + A' lambda + C' mu = r,    A x = d,    C_active x = c,    given entries of s_0
 *
 * H is the Hessian of the Lagrangian, A x = F_t x_t - s_{t+1}, and the rows C are those of bounds (one entry of x and a sign),
 * of h and h_T, then of e and e_T. Active rows enter the recursion as a stiff quadratic, H + C' (sigma + S) C with
 * S = scale / (delta length^2): the system with -1/S in the place of its zero block. Refinement with the residuals of the true
 * system (the method of multipliers) removes the difference, by a factor of about delta each time. By Finsler's lemma the
 * stiff Hessian is positive definite along the dynamics when the Hessian is on the null space of the active rows. Bounds of
 * decisions have a delta of the size of rounding: each is a number on the diagonal at a pivot, which takes the decision out.
 *
 * Nothing here depends on units: decisions (actions, free entries of s_0) are measured by the root of a curvature of their own
 * (`roots`), all of x by its size (`sizes`), and a row by its length as a function of the decisions so measured.
 */
#ifndef KPIRL_MPC_SYSTEM_H
#define KPIRL_MPC_SYSTEM_H

#include "kpirl_mpc_recursion.h"

typedef struct kpirl_mpc_system {
  int horizon, n_states, n_actions;
  int n_path, n_equality, n_terminal, n_terminal_equality; /* rows of h and e per stage, of h_T and e_T */
  int n_free, n_bounds, n_decisions;
  const int *free;      /* (n_free) entries of s_0 */
  const int *entries;   /* (n_bounds) of x */
  const int *decisions; /* (n_decisions) entries of x: free ones of s_0, then actions */
  const real *signs;    /* (n_bounds) */
  const real *F;        /* (n_s, n_x) of every stage */
  const real *G, *E;    /* transposed: (n_x, n_h) and (n_x, n_e), of s_T behind them */
  const real *H;        /* (n_x, n_x), of s_T (n_s, n_s) behind; symmetric */
  real *sigma;          /* (m) */
  real *active;         /* (m) 0 or 1 */
  real *sizes;          /* (n_w) of the entries of x */
  real *roots;          /* (n_decisions) */
  real *lengths;        /* (m), 1 for rows that no decision moves */
  real *moved;          /* (KPIRL_MPC_FEW, n_decisions) kpirl_mpc_moved_by_decisions of active rows that are no bounds of decisions,
                           where there are no more */
  real *stiffness;      /* (m) S, zero where not active */
  kpirl_mpc_factors factors;
  real *scratch; /* kpirl_mpc_system_scratch numbers */
  real scale;    /* the largest |eigenvalue| of the reduced Hessian, its first digits; zero where there are no rows to compare with */
} kpirl_mpc_system;

/* x (n_w), costates (T n_s), forces (m); or a right-hand side r, d, c, with the given entries of s_0 in `start` (n_s). */
typedef struct kpirl_mpc_triple {
  real *x, *costates, *forces, *start;
} kpirl_mpc_triple;

static inline int kpirl_mpc_system_n_point(const kpirl_mpc_system *s) {
  return s->horizon * (s->n_states + s->n_actions) + s->n_states;
}

static inline int kpirl_mpc_system_n_rows(const kpirl_mpc_system *s) {
  return s->n_bounds + s->horizon * (s->n_path + s->n_equality) + s->n_terminal + s->n_terminal_equality;
}

enum { KPIRL_MPC_FEW = 32 };

int kpirl_mpc_system_n_triple(const kpirl_mpc_system *system);
int kpirl_mpc_system_scratch(const kpirl_mpc_system *system);

/* A triple in memory of kpirl_mpc_system_n_triple numbers; returns the end of it. */
real *kpirl_mpc_place_triple(const kpirl_mpc_system *system, real *memory, kpirl_mpc_triple *triple);

/* Products: values (m) = C x; product (n_w) += C' forces. */
void kpirl_mpc_rows_times(const kpirl_mpc_system *system, const real *x, real *values);
void kpirl_mpc_rows_transposed_times(const kpirl_mpc_system *system, const real *forces, real *product);

/* product (n_w) = H x; product (n_w) += A' lambda; defects (T n_s) = A x */
void kpirl_mpc_hessian_times(const kpirl_mpc_system *system, const real *x, real *product);
void kpirl_mpc_defects_transposed_times(const kpirl_mpc_system *system, const real *costates, real *product);
void kpirl_mpc_defects_times(const kpirl_mpc_system *system, const real *x, real *defects);

/* balance (n_w) = (H + C' sigma C) x + A' lambda + C' mu, all entries of s_0 included; values (m) = C x. */
void kpirl_mpc_system_balance(const kpirl_mpc_system *system, const kpirl_mpc_triple *point, real *balance, real *values);

/* The curvature (n_w) that each entry of x has within its own stage and the next one, an upper bound. */
void kpirl_mpc_system_curvature(const kpirl_mpc_system *system, real *curvature);

/* Row by row: |C| sizes (m), which slacks are compared with; and the largest |entry| over the other forces on the same entry of
 * x (m), by which a force is compared with those: |F|' |lambda|, |lambda|, curvature times size; or a share of the largest. */
void kpirl_mpc_row_sizes(const kpirl_mpc_system *system, real *row_sizes);
void kpirl_mpc_force_shares(const kpirl_mpc_system *system, const real *costates, const real *curvature, real *shares);

/* Lengths of the rows, scale, stiffness and factors. start: (n_decisions) random numbers. Returns whether there is an active row
 * that no decision moves. */
int kpirl_mpc_system_factor(kpirl_mpc_system *system, const real *start);

/* Solve for right-hand sides into point, by at most `most` steps of refinement until the relative residual is below `enough`
 * or meets the rounding; returns it. */
real kpirl_mpc_system_solve(const kpirl_mpc_system *system, const kpirl_mpc_triple *right, real enough, int most,
                            kpirl_mpc_triple *point);

/* The same by one substitution: exact to rounding where all active rows are bounds of decisions. */
void kpirl_mpc_system_solve_once(const kpirl_mpc_system *system, const kpirl_mpc_triple *right, kpirl_mpc_triple *point);

/* The relative change of the x that solves (r, 0, 0) when the system becomes `nearby`; infinite if these factors do not
 * find it. point holds the solution here, and becomes the one nearby. */
real kpirl_mpc_system_change(const kpirl_mpc_system *system, const kpirl_mpc_system *nearby, const kpirl_mpc_triple *right,
                             kpirl_mpc_triple *point);

/* That change to first order, by one substitution, from the residual that point has in the system nearby, which is overwritten. */
real kpirl_mpc_system_first_change(const kpirl_mpc_system *system, kpirl_mpc_triple *residual, const kpirl_mpc_triple *point);
real kpirl_mpc_system_follow(const kpirl_mpc_system *system, kpirl_mpc_triple *residual, kpirl_mpc_triple *point); /* point changes */

/* The length over x, in units of its sizes, of the solution for a right-hand side, which is overwritten, by one substitution. */
real kpirl_mpc_system_reach(const kpirl_mpc_system *system, kpirl_mpc_triple *right);
real kpirl_mpc_point_norm(const kpirl_mpc_system *system, const real *x);

/* The highest (lowest if `negative`) eigenvalue of the inverse of the reduced Hessian, in the decisions by their roots, with its
 * vector of length one as x (n_w): the lowest mode of the reduced Hessian. */
real kpirl_mpc_system_lowest_mode(const kpirl_mpc_system *system, int negative, const real *start, real *direction);

/* The smallest singular value of the active rows, scaled to length one. start: (m) random numbers. Overwrites the factors. The
 * same without factors, where at most KPIRL_MPC_FEW active rows are no bounds of decisions; and how many are not. Of rows by their
 * lengths, and by `moved`, from where the factors were made. */
real kpirl_mpc_system_qualification(kpirl_mpc_system *system, const real *start);
real kpirl_mpc_system_few_rows(const kpirl_mpc_system *system, const real *start);
int kpirl_mpc_system_other_rows(const kpirl_mpc_system *system);

/* ---- parts ---- */

/* The number of the decision that a row bounds; -1 of other rows. How decisions (n_decisions), in their units, move a row: it times
 * Z R^{-1}. work: n_w + m numbers. */
int kpirl_mpc_decision_of(const kpirl_mpc_system *system, int row);
void kpirl_mpc_moved_by_decisions(const kpirl_mpc_system *system, int row, real *work, real *by);

/* Lengths of the active rows, and `moved`; returns whether there is one that no decision moves, whose length becomes 1. */
int kpirl_mpc_find_lengths(kpirl_mpc_system *system);

int kpirl_mpc_system_inner_scratch(const kpirl_mpc_system *system); /* that products and factors take, at the front */
/* A value relative to a size that may be zero; the larger of two, infinite if one is NaN. */
real kpirl_mpc_over(real value, real size);
real kpirl_mpc_worse(real a, real b);
void kpirl_mpc_copy_triple(const kpirl_mpc_system *system, const kpirl_mpc_triple *from, kpirl_mpc_triple *to);
real kpirl_mpc_decision_norm(const kpirl_mpc_system *system, const real *x);
/* Factors of H + C' weights C, of an effort |decisions by their roots|^2 instead of H where that is NULL. */
void kpirl_mpc_factor_weighted(kpirl_mpc_system *system, const real *H, const real *weights);
/* As kpirl_mpc_substitute. */
void kpirl_mpc_system_substitute(const kpirl_mpc_system *system, const real *q, const real *d, const real *start, real *x,
                                 real *costates);

/* A symmetric operator: product (n) of v (n). */
typedef void kpirl_mpc_operator(const void *self, const real *v, real *product);
enum { KPIRL_MPC_LOWEST = -1, KPIRL_MPC_LARGEST = 0, KPIRL_MPC_HIGHEST = 1, KPIRL_MPC_PRODUCTS = 5 };
/* The outermost Ritz value (of KPIRL_MPC_LARGEST the largest absolute value) after some products, at most
 * KPIRL_MPC_PRODUCTS, and at most how far it is from an eigenvalue. vector: to start with, then the Ritz vector of length one.
 * basis: (KPIRL_MPC_PRODUCTS + 1) n numbers, of which the last n become the product with that vector. */
real kpirl_mpc_lanczos(kpirl_mpc_operator *product, const void *self, int n, int products, int which, real *vector,
                       real *basis, real *error);
/* The same, started again with what it found until the first digits are known. */
real kpirl_mpc_eigenvalue(kpirl_mpc_operator *product, const void *self, int n, int which, real *vector, real *basis);

#endif
