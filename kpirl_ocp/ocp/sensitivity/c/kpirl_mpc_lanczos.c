/* SPDX-License-Identifier: MIT
 *
 * The Lanczos method: the outer eigenvalues of a symmetric operator from a few products.
 */
#include "kpirl_mpc_system.h"

#include <string.h>

enum { MOST = KPIRL_MPC_PRODUCTS, SWEEPS = 8, STARTS = 4 };
static const real DIGITS = (real)0.1;  /* relative distance from some eigenvalue at which to stop */

static real length_of(const real *v, int n) { return kpirl_mpc_root(kpirl_mpc_dot(v, v, n)); }

/* A rotation that turns A[p][q] to zero, A -> J' A J, V -> V J. */
static void rotate(int n, real A[MOST][MOST], real V[MOST][MOST], int p, int q) {
  real ratio, t, c, s;
  int k;
  if (A[p][q] == 0) return;
  ratio = (A[q][q] - A[p][p]) / (2 * A[p][q]);
  t = (ratio < 0 ? -1 : 1) / (kpirl_mpc_abs(ratio) + kpirl_mpc_root(1 + ratio * ratio));
  c = 1 / kpirl_mpc_root(1 + t * t);
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

real kpirl_mpc_lanczos(kpirl_mpc_operator *product, const void *self, int n, int products, int which, real *vector,
                       real *basis, real *error) {
  real A[MOST][MOST], V[MOST][MOST] = {{0}}, largest = 0, after = 0, length = length_of(vector, n);
  real *next = basis + (size_t)MOST * n;
  int i, j, k, best = 0, count = products < n ? products : n;
  memset(A, 0, sizeof A);
  for (i = 0; i < n; ++i) basis[i] = vector[i] / length;
  for (k = 0; k < count; ++k) {
    const real *v = basis + (size_t)k * n;
    product(self, v, next);
    A[k][k] = kpirl_mpc_dot(v, next, n);
    largest = kpirl_mpc_larger(largest, kpirl_mpc_abs(A[k][k]));
    for (i = 0; i < 2; ++i) /* twice, so that no eigenvalue appears as a ghost */
      for (j = 0; j <= k; ++j)
        kpirl_mpc_axpy(-kpirl_mpc_dot(basis + (size_t)j * n, next, n), basis + (size_t)j * n, n, next);
    after = length_of(next, n);
    if (k + 1 == count || !(after > (real)1e-12 * largest)) { /* an invariant subspace ends the process */
      count = k + 1;
      break;
    }
    A[k][k + 1] = A[k + 1][k] = after;
    for (i = 0; i < n; ++i) basis[(size_t)(k + 1) * n + i] = next[i] / after;
  }
  diagonalise(count, A, V);
  for (k = 1; k < count; ++k)
    if (rank(A[k][k], which) > rank(A[best][best], which)) best = k;
  *error = after * kpirl_mpc_abs(V[count - 1][best]);
  memset(vector, 0, (size_t)n * sizeof(real));
  for (k = 0; k < count; ++k) kpirl_mpc_axpy(V[k][best], basis + (size_t)k * n, n, vector);
  for (k = 0; k < count; ++k)
    if (isnan(A[k][k])) return A[k][k];
  return A[best][best];
}

real kpirl_mpc_eigenvalue(kpirl_mpc_operator *product, const void *self, int n, int which, real *vector, real *basis) {
  real value = 0, error;
  int k;
  for (k = 0; k < STARTS; ++k) {
    value = kpirl_mpc_lanczos(product, self, n, KPIRL_MPC_PRODUCTS, which, vector, basis, &error);
    if (!isfinite(value) || (value * which > 0 && error <= DIGITS * kpirl_mpc_abs(value))) break;
  }
  return value;
}
