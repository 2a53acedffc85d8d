/* SPDX-License-Identifier: MIT */
#include "kpirl_mpc_real.h"

enum { LANES = 8, SEVERAL = 16, MANY = 32 }; /* independent partial results, which compilers keep in vectors; more hide latency */

int kpirl_mpc_all_finite(const real *values, int count) {
  real zero[MANY] = {0}, sum = 0; /* x - x is NaN unless x is finite */
  int i = 0, k;
  for (; i + MANY <= count; i += MANY)
    for (k = 0; k < MANY; ++k) zero[k] += values[i + k] - values[i + k];
  for (; i < count; ++i) sum += values[i] - values[i];
  for (k = 0; k < MANY; ++k) sum += zero[k];
  return sum == 0;
}

real kpirl_mpc_norm_inf(const real *values, int count) {
  real most[SEVERAL] = {0}, zero[SEVERAL] = {0}, result = 0, invalid = 0;
  int i = 0, k;
  for (; i + SEVERAL <= count; i += SEVERAL)
    for (k = 0; k < SEVERAL; ++k) {
      const real size = kpirl_mpc_abs(values[i + k]);
      most[k] = size > most[k] ? size : most[k];
      zero[k] += values[i + k] * 0;
    }
  for (; i < count; ++i) {
    result = kpirl_mpc_max(kpirl_mpc_abs(values[i]), result);
    if (isnan(values[i])) invalid = values[i];
  }
  for (k = 0; count >= SEVERAL && k < SEVERAL; ++k) {
    result = kpirl_mpc_max(most[k], result);
    if (isnan(zero[k]) && result < (real)INFINITY) invalid = zero[k]; /* infinity times zero is NaN, too */
  }
  return isnan(invalid) ? invalid : result;
}

real kpirl_mpc_norm_1(const real *values, int count) {
  real part[LANES] = {0}, sum = 0;
  int i = 0, k;
  for (; i + LANES <= count; i += LANES)
    for (k = 0; k < LANES; ++k) part[k] += kpirl_mpc_abs(values[i + k]);
  for (; i < count; ++i) sum += kpirl_mpc_abs(values[i]);
  for (k = 0; k < LANES; ++k) sum += part[k];
  return sum;
}

real kpirl_mpc_dot(const real *a, const real *b, int count) {
  real part[LANES] = {0}, sum = 0;
  int i = 0, k;
  for (; i + LANES <= count; i += LANES)
    for (k = 0; k < LANES; ++k) part[k] += a[i + k] * b[i + k];
  for (; i < count; ++i) sum += a[i] * b[i];
  for (k = 0; k < LANES; ++k) sum += part[k];
  return sum;
}

real kpirl_mpc_absolute_dot(const real *a, const real *b, int count) {
  real part[LANES] = {0}, sum = 0;
  int i = 0, k;
  for (; i + LANES <= count; i += LANES)
    for (k = 0; k < LANES; ++k) part[k] += kpirl_mpc_abs(a[i + k] * b[i + k]);
  for (; i < count; ++i) sum += kpirl_mpc_abs(a[i] * b[i]);
  for (k = 0; k < LANES; ++k) sum += part[k];
  return sum;
}

real kpirl_mpc_norm_2(const real *values, int count) { return kpirl_mpc_sqrt(kpirl_mpc_dot(values, values, count)); }

void kpirl_mpc_axpy(real factor, const real *restrict x, int count, real *restrict y) {
  int i;
  for (i = 0; i < count; ++i) y[i] += factor * x[i];
}

/* Of the mantissas' product and the sum of the exponents: one logarithm for all. */
real kpirl_mpc_log_sum(const real *values, int count) {
  real product = 1;
  long exponents = 0;
  int i, exponent;
  for (i = 0; i < count; ++i) {
    if (!(values[i] > 0) || values[i] > KPIRL_MPC_LARGEST_NUMBER) return KPIRL_MPC_MATH(log)(values[i]);
    product *= KPIRL_MPC_MATH(frexp)(values[i], &exponent);
    exponents += exponent;
    if (product < (real)1e-20) {
      product = KPIRL_MPC_MATH(frexp)(product, &exponent);
      exponents += exponent;
    }
  }
  return KPIRL_MPC_MATH(log)(product) + (real)exponents * (real)0.69314718055994530942;
}
