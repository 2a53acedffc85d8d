/* SPDX-License-Identifier: MIT
 *
 * Products of small dense matrices, by columns. None may overlap its result.
 */
#ifndef KPIRL_MPC_KERNELS_H
#define KPIRL_MPC_KERNELS_H

#include "kpirl_mpc_real.h"

/* z (rows, columns) += x (rows, inner) y (inner, columns) */
void kpirl_mpc_times(const real *x, int rows, int inner, const real *y, int columns, real *z);

/* The same for a square z of which the lower triangle is wanted; the other one is left undefined. */
void kpirl_mpc_times_lower(const real *x, int rows, int inner, const real *y, real *z);

void kpirl_mpc_times_vector(const real *a, int rows, int columns, const real *x, real *y);            /* y += A x */
void kpirl_mpc_transposed_times_vector(const real *a, int rows, int columns, const real *x, real *y); /* y += A' x */
void kpirl_mpc_symmetric_times_vector(const real *a, int n, const real *x, real *y); /* y += A x, A by its lower triangle */

/* M (n, n), its lower triangle, += sum_r weight_r a_r a_r' for the columns a_r of `columns` (n, rows). */
void kpirl_mpc_add_rows(const real *columns, int n, int rows, const real *weights, real *M);

void kpirl_mpc_transpose(const real *a, int rows, int columns, real *transposed);
void kpirl_mpc_mirror(real *a, int n); /* the lower triangle onto the upper one */

#endif
