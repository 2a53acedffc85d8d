/* SPDX-License-Identifier: MIT */
#include "kpirl_mpc_real.h"

enum { LANES = 8, MANY = 32 }; /* independent partial results, which compilers keep in vectors; MANY, in a loop of several */

int kpirl_mpc_all_finite(const real *values, int count) {
  real zero[MANY] = {0}, sum = 0; /* x - x is NaN unless x is finite */
  int i = 0, k;
  for (; i + MANY <= count; i += MANY)
    for (k = 0; k < MANY; ++k) zero[k] += values[i + k] - values[i + k];
  for (k = 0; i > 0 && k < MANY; ++k) sum += zero[k];
  for (; i + 4 <= count; i += 4) /* what is left, in shorter vectors */
    for (k = 0; k < 4; ++k) zero[k] += values[i + k] - values[i + k];
  for (; i < count; ++i) sum += values[i] - values[i];
  for (k = 0; k < 4; ++k) sum += zero[k];
  return sum == 0;
}

real kpirl_mpc_norm_inf(const real *values, int count) {
  real most[LANES] = {0}, result = 0;
  int i = 0, k;
  for (; i + LANES <= count; i += LANES)
    for (k = 0; k < LANES; ++k) /* written so that compilers take a vector's maximum */
      most[k] = most[k] < kpirl_mpc_abs(values[i + k]) ? kpirl_mpc_abs(values[i + k]) : most[k];
  for (k = 0; i > 0 && k < LANES; ++k) result = kpirl_mpc_max(most[k], result);
  for (; i < count; ++i) result = kpirl_mpc_max(kpirl_mpc_abs(values[i]), result);
  if (kpirl_mpc_all_finite(values, count)) return result;
  for (i = 0; i < count; ++i)
    if (isnan(values[i])) return values[i];
  return result;
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

real kpirl_mpc_largest_fall(const real *value, const real *change, int count, real least) {
  real most[MANY] = {0};
  int i = 0, k;
  for (; i + MANY <= count; i += MANY)
    for (k = 0; k < MANY; ++k) most[k] = kpirl_mpc_max(-change[i + k] / value[i + k], most[k]);
  for (k = 0; i > 0 && k < MANY; ++k) least = kpirl_mpc_max(most[k], least);
  for (; i < count; ++i) least = kpirl_mpc_max(-change[i] / value[i], least);
  return least;
}

static const real SMALL = (real)1e-15, LARGE = (real)1e15; /* numbers whose products are still normal in single precision */

/* value without its power of two, which is added to the exponents, where it is far from one */
static real near_one(real value, long *exponents) {
  int exponent;
  if (value > SMALL && value < LARGE) return value;
  value = KPIRL_MPC_MATH(frexp)(value, &exponent);
  *exponents += exponent;
  return value;
}

/* Of the product and the sum of the exponents that were taken out of it: one logarithm for all. */
real kpirl_mpc_log_sum(const real *values, int count) {
  real product = 1;
  long exponents = 0;
  int i;
  for (i = 0; i < count; ++i) {
    if (!(values[i] > 0) || values[i] > KPIRL_MPC_LARGEST_NUMBER) return KPIRL_MPC_MATH(log)(values[i]);
    product = near_one(product * near_one(values[i], &exponents), &exponents);
  }
  return KPIRL_MPC_MATH(log)(product) + (real)exponents * (real)0.69314718055994530942;
}
