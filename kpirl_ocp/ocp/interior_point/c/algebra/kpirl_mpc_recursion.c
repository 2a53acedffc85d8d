/* SPDX-License-Identifier: MIT */
#include "kpirl_mpc_recursion.h"

#include <string.h>

static real sign(real a) { return (real)((a > 0) - (a < 0)); }

void kpirl_mpc_inverse_root(real *A, int n, real *W, real *pivots) {
  int i, j, k;
  for (j = 0; j < n; ++j) { /* A = L D L', L below the diagonal of A */
    real pivot = A[j + j * n];
    for (k = 0; k < j; ++k) pivot -= A[j + k * n] * A[j + k * n] * pivots[k];
    pivots[j] = pivot;
    for (i = j + 1; i < n; ++i) {
      real entry = A[i + j * n];
      for (k = 0; k < j; ++k) entry -= A[i + k * n] * A[j + k * n] * pivots[k];
      A[i + j * n] = entry / pivot;
    }
  }
  memset(W, 0, (size_t)n * n * sizeof(real));
  for (i = 0; i < n; ++i) { /* L^{-1} */
    W[i + i * n] = 1;
    for (j = 0; j < i; ++j) {
      real entry = 0;
      for (k = j; k < i; ++k) entry -= A[i + k * n] * W[k + j * n];
      W[i + j * n] = entry;
    }
  }
  for (i = 0; i < n; ++i) {
    const real scale = 1 / kpirl_mpc_sqrt(kpirl_mpc_abs(pivots[i]));
    for (j = 0; j <= i; ++j) W[i + j * n] *= scale;
  }
}

int kpirl_mpc_stage_scratch(int n_s, int n_u) {
  const int n_x = n_s + n_u;
  return 2 * n_s * n_x + 2 * n_u * (n_u + n_s);
}

void kpirl_mpc_factor_stage(int n_s, int n_u, const real *P_next, const real *F, real *M, real *scratch, real *P, real *W,
                            real *Y, real *pivots) {
  const int n_x = n_s + n_u;
  real *PF = scratch, *Ft = PF + n_s * n_x, *M_uu = Ft + n_s * n_x, *Wt = M_uu + n_u * n_u, *M_su = Wt + n_u * n_u,
       *JYt = M_su + n_u * n_s;
  int i, j;
  memset(PF, 0, (size_t)n_s * n_x * sizeof(real));
  kpirl_mpc_times(P_next, n_s, n_s, F, n_x, PF);
  kpirl_mpc_transpose(F, n_s, n_x, Ft);
  kpirl_mpc_times_lower(Ft, n_x, n_s, PF, M);
  for (j = 0; j < n_s; ++j) memcpy(P + j * n_s + j, M + j * n_x + j, (size_t)(n_s - j) * sizeof(real));
  if (n_u > 0) {
    for (j = 0; j < n_u; ++j)
      for (i = j; i < n_u; ++i) M_uu[i + j * n_u] = M[(n_s + i) + (n_s + j) * n_x];
    for (i = 0; i < n_u; ++i)
      for (j = 0; j < n_s; ++j) M_su[j + i * n_s] = M[(n_s + i) + j * n_x];
    kpirl_mpc_inverse_root(M_uu, n_u, W, pivots);
    kpirl_mpc_transpose(W, n_u, n_u, Wt);
    memset(Y, 0, (size_t)n_u * n_s * sizeof(real));
    kpirl_mpc_times(M_su, n_s, n_u, Wt, n_u, Y);
    for (i = 0; i < n_u; ++i)
      for (j = 0; j < n_s; ++j) JYt[i + j * n_u] = -sign(pivots[i]) * Y[j + i * n_s];
    kpirl_mpc_times_lower(Y, n_s, n_u, JYt, P);
  }
  kpirl_mpc_mirror(P, n_s);
}

void kpirl_mpc_factor_start(int n_s, int n_free, const int *free, const real *P_0, real *scratch,
                            kpirl_mpc_factors *factors) {
  int i, j;
  for (j = 0; j < n_free; ++j)
    for (i = 0; i < n_free; ++i) scratch[i + j * n_free] = P_0[free[i] + free[j] * n_s];
  kpirl_mpc_inverse_root(scratch, n_free, factors->free_W, factors->free_pivots);
}

/* y (n) += -W' J v. work: n numbers. */
static void apply_root(const real *W, const real *pivots, int n, const real *v, real *work, real *y) {
  int i;
  for (i = 0; i < n; ++i) work[i] = -sign(pivots[i]) * v[i];
  kpirl_mpc_transposed_times_vector(W, n, n, work, y);
}

int kpirl_mpc_substitute_scratch(int horizon, int n_s, int n_u) {
  return horizon * (n_s + 2 * n_u) + n_s + 3 * (n_s + n_u);
}

/* The entries of s_0 that are not given: the minimum of 1/2 s' P_0 s + p_0' s in them. */
static void start_free(int n_s, int n_free, const int *free, const kpirl_mpc_factors *factors, const real *p, real *work,
                       real *s) {
  real *slope = work, *root = slope + n_free, *change = root + n_free;
  int i, j;
  for (i = 0; i < n_free; ++i) s[free[i]] = 0;
  for (i = 0; i < n_free; ++i) {
    slope[i] = p[free[i]];
    for (j = 0; j < n_s; ++j) slope[i] += factors->P[free[i] + j * n_s] * s[j];
  }
  memset(root, 0, (size_t)(2 * n_free) * sizeof(real));
  kpirl_mpc_times_vector(factors->free_W, n_free, n_free, slope, root);
  apply_root(factors->free_W, factors->free_pivots, n_free, root, slope, change);
  for (i = 0; i < n_free; ++i) s[free[i]] = change[i];
}

void kpirl_mpc_substitute(int horizon, int n_s, int n_u, int n_free, const int *free, const real *F,
                          const kpirl_mpc_factors *factors, const real *q, const real *d, const real *start, real *scratch,
                          real *x, real *costates) {
  const int n_x = n_s + n_u;
  const size_t square = (size_t)n_s * n_s, n_w = (size_t)horizon * n_x + n_s, of_states = (size_t)n_s * sizeof(real);
  real *m = scratch, *v = m + n_w, *work = v + horizon * n_u; /* m_s becomes p */
  int i, t;
  memcpy(m, q, n_w * sizeof(real));
  memset(v, 0, (size_t)(horizon * n_u) * sizeof(real));
  for (t = horizon - 1; t >= 0; --t) {
    const real *pivots = factors->pivots + t * n_u, *p = m + (t + 1) * n_x;
    real *m_t = m + t * n_x, *v_t = v + t * n_u;
    if (d) {
      memcpy(work, p, of_states);
      kpirl_mpc_times_vector(factors->P + (t + 1) * square, n_s, n_s, d + t * n_s, work);
      p = work;
    }
    kpirl_mpc_transposed_times_vector(F + (size_t)t * n_s * n_x, n_s, n_x, p, m_t);
    kpirl_mpc_times_vector(factors->W + (size_t)t * n_u * n_u, n_u, n_u, m_t + n_s, v_t);
    for (i = 0; i < n_u; ++i) work[i] = -sign(pivots[i]) * v_t[i];
    kpirl_mpc_times_vector(factors->Y + (size_t)t * n_u * n_s, n_s, n_u, work, m_t);
  }
  memset(x, 0, n_w * sizeof(real));
  memcpy(x, start, of_states);
  if (n_free > 0) start_free(n_s, n_free, free, factors, m, work, x);
  for (t = 0; t < horizon; ++t) {
    real *x_t = x + t * n_x, *next = x_t + n_x, *v_t = v + t * n_u;
    kpirl_mpc_transposed_times_vector(factors->Y + (size_t)t * n_u * n_s, n_s, n_u, x_t, v_t);
    apply_root(factors->W + (size_t)t * n_u * n_u, factors->pivots + t * n_u, n_u, v_t, work, x_t + n_s);
    if (d) memcpy(next, d + t * n_s, of_states);
    kpirl_mpc_times_vector(F + (size_t)t * n_s * n_x, n_s, n_x, x_t, next);
    if (!costates) continue;
    memcpy(costates + t * n_s, m + (t + 1) * n_x, of_states);
    kpirl_mpc_times_vector(factors->P + (t + 1) * square, n_s, n_s, next, costates + t * n_s);
  }
}

void kpirl_mpc_feedback(int n_s, int n_u, const kpirl_mpc_factors *factors, int t, const real *s, real *scratch, real *u) {
  real *root = scratch, *work = root + n_u;
  memset(root, 0, (size_t)n_u * sizeof(real));
  kpirl_mpc_transposed_times_vector(factors->Y + (size_t)t * n_u * n_s, n_s, n_u, s, root);
  apply_root(factors->W + (size_t)t * n_u * n_u, factors->pivots + t * n_u, n_u, root, work, u);
}
