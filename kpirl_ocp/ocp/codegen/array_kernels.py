"""Copies, extremes and tanh of arrays, in C that a compiler turns into vector instructions; used by `kernels`."""

from __future__ import annotations

COPY = r"""#include <string.h>
static inline void casadi_copy(const casadi_real* x, casadi_int n, casadi_real* y) {
  if (!y) return;
  if (x) memmove(y, x, n * sizeof(casadi_real)); else memset(y, 0, n * sizeof(casadi_real));
}
"""

TANH = r"""#include <math.h>
#include <string.h>
typedef double wide __attribute__((vector_size(32)));
typedef long long wide_bits __attribute__((vector_size(32)));

/* tanh x = e / (e + 2) with e = exp(2 |x|) - 1 = 2^n (exp(r) - 1) + (2^n - 1), |r| <= log(2) / 2, by Taylor's series in
   pairs of terms, which wait for each other less than in Horner's scheme; beyond 22 it is 1 to the last place.
   Comparisons with NaN are false, so that NaN stays. */
static inline wide kernel_tanh4(wide x) {
  const wide zero = {0}, round = zero + 0x1.8p52;
  const wide_bits sign = (wide_bits) x & ((wide_bits) {0} + (-0x7fffffffffffffffLL - 1));
  wide a = (wide) ((wide_bits) x ^ sign), n, r, square, fourth, p, q, power, e;
  const wide_bits far = a > 22.0;
  a = 2 * (wide) ((far & (wide_bits) (zero + 22.0)) | (~far & (wide_bits) a));
  n = a * 0x1.71547652b82fep+0 + round;
  power = (wide) (((wide_bits) n + 1023) << 52);
  n -= round;
  r = a - n * 6.93147180369123816490e-01 - n * 1.90821492927058770002e-10; /* the first product is exact */
  square = r * r;
  fourth = square * square;
  p = (r * (1 / 6.0) + 0.5) + square * (r * (1 / 120.0) + 1 / 24.0);
  q = (r * (1 / 5040.0) + 1 / 720.0) + square * (r * (1 / 362880.0) + 1 / 40320.0);
  q += fourth * ((r * (1 / 39916800.0) + 1 / 3628800.0) + square * (r * (1 / 6227020800.0) + 1 / 479001600.0));
  p = (p + fourth * q) * square + r;
  e = power * p + (power - 1);
  return (wide) ((wide_bits) (e / (e + 2)) | sign);
}

static void kernel_tanh(const casadi_real* x, casadi_int n, casadi_real* y) {
  wide some;
  for (; n >= 4; n -= 4, x += 4, y += 4) {
    memcpy(&some, x, 32);
    some = kernel_tanh4(some);
    memcpy(y, &some, 32);
  }
  if (n > 0) {
    some = (wide) {0};
    memcpy(&some, x, n * sizeof(casadi_real));
    some = kernel_tanh4(some);
    memcpy(y, &some, n * sizeof(casadi_real));
  }
}

"""

# The smaller and the larger of two, as fmin and fmax of the mathematical library, which are no vector instructions.
_PAIR = r"""static inline casadi_real casadi_f@name@(casadi_real x, casadi_real y) {
  return x @than@= y || y != y ? x : y;
}
"""

# The least and the largest of an array; as with fmin and fmax, NaN does not count.
_EXTREME = r"""static casadi_real casadi_vf@name@(const casadi_real* x, casadi_int n, casadi_real r) {
  casadi_real some[32];
  casadi_int i = 0;
  int j, half;
  for (j = 0; j < 32; ++j) some[j] = r;
  for (; i + 32 <= n; i += 32)
    for (j = 0; j < 32; ++j) some[j] = x[i + j] @than@ some[j] ? x[i + j] : some[j];
  for (half = 16; half > 0; half /= 2)
    for (j = 0; j < half; ++j) some[j] = some[j + half] @than@ some[j] ? some[j + half] : some[j];
  for (r = some[0]; i < n; ++i) r = x[i] @than@ r ? x[i] : r;
  return r;
}
"""
LEAST, LARGEST, SMALLER, LARGER = (
    text.replace("@name@", name).replace("@than@", than)
    for text in (_EXTREME, _PAIR)
    for name, than in (("min", "<"), ("max", ">"))
)
