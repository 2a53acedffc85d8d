/* SPDX-License-Identifier: MIT
 *
 * Small mathematics on numbers and arrays. A maximum here is NaN when a number is.
 */
#ifndef KPIRL_MPC_REAL_H
#define KPIRL_MPC_REAL_H

#include <float.h>
#include <math.h>

#include "kpirl_mpc_number.h"

#ifdef KPIRL_MPC_FLOAT
#define KPIRL_MPC_EPSILON FLT_EPSILON
#define KPIRL_MPC_LARGEST_NUMBER FLT_MAX
#define KPIRL_MPC_SMALLEST_NUMBER FLT_MIN
#define KPIRL_MPC_MATH(name) name##f
#else
#define KPIRL_MPC_EPSILON DBL_EPSILON
#define KPIRL_MPC_LARGEST_NUMBER DBL_MAX
#define KPIRL_MPC_SMALLEST_NUMBER DBL_MIN
#define KPIRL_MPC_MATH(name) name
#endif

typedef kpirl_mpc_real real;

static inline real kpirl_mpc_max(real a, real b) { return a > b ? a : b; }
static inline real kpirl_mpc_min(real a, real b) { return a < b ? a : b; }
static inline real kpirl_mpc_abs(real a) { return KPIRL_MPC_MATH(fabs)(a); }
static inline real kpirl_mpc_sqrt(real a) { return KPIRL_MPC_MATH(sqrt)(a); }
static inline real kpirl_mpc_pow(real a, real b) { return KPIRL_MPC_MATH(pow)(a, b); }

int kpirl_mpc_all_finite(const real *values, int count);
real kpirl_mpc_norm_inf(const real *values, int count); /* of the absolute values; 0 for none */
real kpirl_mpc_norm_1(const real *values, int count);
real kpirl_mpc_dot(const real *a, const real *b, int count);
real kpirl_mpc_absolute_dot(const real *a, const real *b, int count); /* of absolute values */
real kpirl_mpc_norm_2(const real *values, int count);                 /* Euclidean */
void kpirl_mpc_axpy(real factor, const real *x, int count, real *y); /* y += factor x */
real kpirl_mpc_log_sum(const real *values, int count);               /* of logarithms */
/* The largest -change / value, or `least` where that is larger; those that are NaN do not count. */
real kpirl_mpc_largest_fall(const real *value, const real *change, int count, real least);

#endif
