/* z += x y, or z += x' y with tr, dense and by columns. Column by column of z, four columns of x at a time: the inner loop
   runs along consecutive numbers, so that compilers turn it into vector instructions. */
static void casadi_mtimes_dense(const casadi_real* restrict x, casadi_int nrow_x, casadi_int ncol_x,
    const casadi_real* restrict y, casadi_int ncol_y, casadi_real* restrict z, casadi_int tr) {
  casadi_int i, j, k;
  for (i = 0; i < ncol_y && !tr; ++i, y += ncol_x, z += nrow_x) {
    const casadi_real *x0 = x;
    for (k = 0; k + 4 <= ncol_x; k += 4, x0 += 4 * nrow_x) {
      const casadi_real *x1 = x0 + nrow_x, *x2 = x1 + nrow_x, *x3 = x2 + nrow_x;
      const casadi_real y0 = y[k], y1 = y[k + 1], y2 = y[k + 2], y3 = y[k + 3];
      for (j = 0; j < nrow_x; ++j) z[j] += y0 * x0[j] + y1 * x1[j] + y2 * x2[j] + y3 * x3[j];
    }
    for (; k < ncol_x; ++k, x0 += nrow_x)
      for (j = 0; j < nrow_x; ++j) z[j] += y[k] * x0[j];
  }
  for (i = 0; i < ncol_y && tr; ++i)
    for (j = 0; j < ncol_x; ++j)
      for (k = 0; k < nrow_x; ++k) z[j + i * ncol_x] += x[k + j * nrow_x] * y[k + i * nrow_x];
}
