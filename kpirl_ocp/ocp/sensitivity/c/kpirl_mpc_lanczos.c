/* SPDX-License-Identifier: MIT
 *
 * The Lanczos method: the outer eigenvalues of a symmetric operator from a few products.
 */
#include "kpirl_mpc_system.h"

#include <string.h>

enum {
  MOST = KPIRL_MPC_PRODUCTS,
  FEW = 3,    /* products before it is worth looking */
  SWEEPS = 8, /* of Jacobi's method, which converges quadratically: a matrix of MOST rows is diagonal to rounding after fewer */
  STARTS = 4  /* of the method, each with the vector that the one before found */
};
static const real DIGITS = (real)0.1; /* relative distance from some eigenvalue at which to stop */

/* A rotation that turns A[p][q] to zero, A -> J' A J, V -> V J. */
static void rotate(int n, real A[MOST][MOST], real V[MOST][MOST], int p, int q) {
  real ratio, t, c, s;
  int k;
  if (A[p][q] == 0) return;
  ratio = (A[q][q] - A[p][p]) / (2 * A[p][q]);
  t = (ratio < 0 ? -1 : 1) / (kpirl_mpc_abs(ratio) + kpirl_mpc_sqrt(1 + ratio * ratio));
  c = 1 / kpirl_mpc_sqrt(1 + t * t);
  s = t * c;
  for (k = 0; k < n; ++k) {
    const real a = A[k][p], b = A[k][q];
    A[k][p] = c * a - s * b;
    A[k][q] = s * a + c * b;
  }
  for (k = 0; k < n; ++k) {
    const real a = A[p][k], b = A[q][k], v = V[k][p], w = V[k][q];
    A[p][k] = c * a - s * b;
    A[q][k] = s * a + c * b;
    V[k][p] = c * v - s * w;
    V[k][q] = s * v + c * w;
  }
}

/* Eigenvalues on the diagonal of A and vectors in the columns of V, by Jacobi's method. */
static void diagonalise(int n, real A[MOST][MOST], real V[MOST][MOST]) {
  int i, j, sweep;
  for (i = 0; i < n; ++i)
    for (j = 0; j < n; ++j) V[i][j] = i == j;
  for (sweep = 0; sweep < SWEEPS; ++sweep)
    for (i = 0; i < n; ++i)
      for (j = i + 1; j < n; ++j) rotate(n, A, V, i, j);
}

static real rank(real value, int which) { return which == KPIRL_MPC_LARGEST ? kpirl_mpc_abs(value) : which * value; }

/* The outermost Ritz value of the first `count` products, the Ritz vector's coordinates, and its distance from an eigenvalue. */
static real ritz(int count, real A[MOST][MOST], real after, int which, real *coordinates, real *error) {
  real own[MOST][MOST], V[MOST][MOST];
  int best = 0, k;
  memcpy(own, A, sizeof own);
  diagonalise(count, own, V);
  for (k = 1; k < count; ++k)
    if (rank(own[k][k], which) > rank(own[best][best], which)) best = k;
  for (k = 0; k < count; ++k) coordinates[k] = V[k][best];
  *error = after * kpirl_mpc_abs(V[count - 1][best]);
  for (k = 0; k < count; ++k)
    if (isnan(own[k][k])) return own[k][k];
  return own[best][best];
}

/* Is the value known to DIGITS, with the sign that is asked for? What is not finite gets no better. */
static int known(real value, real error, int which) {
  return !isfinite(value) || (value * which > 0 && error <= DIGITS * kpirl_mpc_abs(value));
}

real kpirl_mpc_lanczos(kpirl_mpc_operator *product, const void *self, int n, int products, int which, real *vector,
                       real *basis, real *error) {
  real A[MOST][MOST] = {{0}}, coordinates[MOST], largest = 0, value = 0, length = kpirl_mpc_norm_2(vector, n);
  real *next = basis + (size_t)MOST * n;
  const int count = products < n ? products : n;
  int i, j, k;
  for (i = 0; i < n; ++i) basis[i] = vector[i] / length;
  for (k = 0; k < count; ++k) {
    const real *v = basis + (size_t)k * n;
    real after;
    int done;
    product(self, v, next);
    A[k][k] = kpirl_mpc_dot(v, next, n);
    largest = kpirl_mpc_max(largest, kpirl_mpc_abs(A[k][k]));
    for (i = 0; i < 2; ++i) /* twice, so that no eigenvalue appears as a ghost */
      for (j = 0; j <= k; ++j)
        kpirl_mpc_axpy(-kpirl_mpc_dot(basis + (size_t)j * n, next, n), basis + (size_t)j * n, n, next);
    after = kpirl_mpc_norm_2(next, n);
    done = k + 1 == count || !(after > (real)1e-12 * largest); /* an invariant subspace ends the process */
    if (done || k + 1 >= FEW) value = ritz(k + 1, A, after, which, coordinates, error);
    if (done || (k + 1 >= FEW && known(value, *error, which))) break;
    A[k][k + 1] = A[k + 1][k] = after;
    for (i = 0; i < n; ++i) basis[(size_t)(k + 1) * n + i] = next[i] / after;
  }
  memset(vector, 0, (size_t)n * sizeof(real));
  for (j = 0; j <= k; ++j) kpirl_mpc_axpy(coordinates[j], basis + (size_t)j * n, n, vector);
  for (i = 0; i < n; ++i) next[i] = value * vector[i] + coordinates[k] * next[i]; /* A V c = V T c + c_last next, T c = value c */
  return value;
}

real kpirl_mpc_eigenvalue(kpirl_mpc_operator *product, const void *self, int n, int which, real *vector, real *basis) {
  real value = 0, error;
  int k;
  for (k = 0; k < STARTS; ++k) {
    value = kpirl_mpc_lanczos(product, self, n, KPIRL_MPC_PRODUCTS, which, vector, basis, &error);
    if (known(value, error, which)) break;
  }
  return value;
}
