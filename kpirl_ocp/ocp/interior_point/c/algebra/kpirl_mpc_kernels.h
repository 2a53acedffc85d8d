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

/* Rows that belong to stages: their gradients, by columns, are (n_x, rows) of each of the stages 0 .. T-1, then (n_s, last_rows)
 * of the end. values (T rows + last_rows) += rows x, for x (T n_x + n_s), and product (T n_x + n_s) += rows' values. */
void kpirl_mpc_stage_rows_times(int T, int n_s, int n_x, const real *gradients, int rows, int last_rows, const real *x,
                                real *values);
void kpirl_mpc_stage_rows_transposed_times(int T, int n_s, int n_x, const real *gradients, int rows, int last_rows,
                                           const real *values, real *product);

void kpirl_mpc_transpose(const real *a, int rows, int columns, real *transposed);
void kpirl_mpc_mirror(real *a, int n); /* the lower triangle onto the upper one */
void kpirl_mpc_mirror_stages(int T, int n_s, int n_x, real *H); /* of (n_x, n_x) of the stages 0 .. T-1, then (n_s, n_s) of the end */

#endif
