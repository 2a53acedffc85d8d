/* SPDX-License-Identifier: MIT
 *
 * The Riccati recursion: solve a linear-quadratic problem over T stages in O(T) time and memory (Rao, Wright and Rawlings,
 * 1998; HPIPM, Frison and Diehl, 2020).
 *
 *     minimise  sum_t  1/2 x_t' H_t x_t + q_t' x_t  +  1/2 s_T' H_T s_T + q_T' s_T,      x_t = (s_t, u_t)
 *     subject to  s_{t+1} = F_t x_t + d_t,   given entries of s_0
 *
 * With the value function 1/2 s' P_t s + p_t' s of the stages from t on, backwards from P_T = H_T, p_T = q_T:
 *
 *     M = H_t + F_t' P_{t+1} F_t,    m = q_t + F_t' (P_{t+1} d_t + p_{t+1})
 *     M_uu = L D L',   W = |D|^{-1/2} L^{-1},   Y = M_su W',   v = W m_u,   J = sign(D)
 *     P_t = M_ss - Y J Y',   p_t = m_s - Y J v
 *
 * and forwards u_t = -W' J (Y' s_t + v), with the costate lambda_t = P_{t+1} s_{t+1} + p_{t+1} of s_{t+1} = ... .
 * There are as many negative pivots in all D as the Hessian along the dynamics has negative eigenvalues: it has a
 * minimum exactly when all are positive. Entries of s_0 that are not given are eliminated last, in the same way.
 *
 * Matrices are by columns, one stage after the other; vectors of stages are x_0, x_1, .., x_{T-1}, s_T.
 */
#ifndef KPIRL_MPC_RECURSION_H
#define KPIRL_MPC_RECURSION_H

#include "kpirl_mpc_kernels.h"

typedef struct kpirl_mpc_factors {
  real *P;           /* (n_s, n_s) of stages 0 .. T */
  real *W, *Y;       /* (n_u, n_u) and (n_s, n_u) of stages 0 .. T-1 */
  real *pivots;      /* (n_u) of stages 0 .. T-1 */
  real *free_W;      /* (n_free, n_free), of the block of P_0 that belongs to free entries of s_0 */
  real *free_pivots; /* (n_free) */
} kpirl_mpc_factors;

/* One stage backwards: M (n_x, n_x), its lower triangle, holds H_t and is overwritten. P_next: of stage t+1.
 * scratch: kpirl_mpc_stage_scratch numbers. P, W, Y, pivots: of stage t. A pivot of zero leaves infinities and NaN. */
void kpirl_mpc_factor_stage(int n_s, int n_u, const real *P_next, const real *F, real *M, real *scratch, real *P, real *W,
                            real *Y, real *pivots);
int kpirl_mpc_stage_scratch(int n_s, int n_u);

/* W = |D|^{-1/2} L^{-1} and the pivots D of a symmetric matrix (n, n) given by its lower triangle; A is overwritten. */
void kpirl_mpc_inverse_root(real *A, int n, real *W, real *pivots);

/* The block of P_0 of free entries of s_0. free: (n_free) their indices. scratch: n_free^2 numbers. */
void kpirl_mpc_factor_start(int n_s, int n_free, const int *free, const real *P_0, real *scratch, kpirl_mpc_factors *factors);

/* Solve for q (T n_x + n_s), d (T n_s) and the given entries of x_0 (n_s): x (T n_x + n_s) and costates (T n_s).
 * d NULL: zeros. costates NULL: they are not wanted. scratch: kpirl_mpc_substitute_scratch numbers. */
void kpirl_mpc_substitute(int horizon, int n_s, int n_u, int n_free, const int *free, const real *F,
                          const kpirl_mpc_factors *factors, const real *q, const real *d, const real *start, real *scratch,
                          real *x, real *costates);
int kpirl_mpc_substitute_scratch(int horizon, int n_s, int n_u);

/* u (n_u) += K s of stage t, with the feedback K = -W' J Y'. scratch: 2 n_u numbers. */
void kpirl_mpc_feedback(int n_s, int n_u, const kpirl_mpc_factors *factors, int t, const real *s, real *scratch, real *u);

#endif
