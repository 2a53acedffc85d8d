/* SPDX-License-Identifier: MIT */
#include "kpirl_mpc_library.h"

#include <string.h>

int kpirl_mpc_evaluate_buffered(void *self, const real *const *arguments, real *const *results) {
  const kpirl_mpc_buffered *function = (const kpirl_mpc_buffered *)self;
  int i;
  for (i = 0; i < function->n_in; ++i)
    if (function->size_in[i]) memcpy(function->in[i], arguments[i], (size_t)function->size_in[i] * sizeof(real));
  function->evaluate(function->buffer);
  for (i = 0; i < function->n_out; ++i)
    if (results[i] && function->size_out[i])
      memcpy(results[i], function->out[i], (size_t)function->size_out[i] * sizeof(real));
  return function->status(function->buffer);
}

int kpirl_mpc_evaluate_compiled(void *self, const real *const *arguments, real *const *results) {
  const kpirl_mpc_compiled *function = (const kpirl_mpc_compiled *)self;
  memcpy(function->arguments, arguments, (size_t)function->n_in * sizeof *arguments);
  memcpy(function->results, results, (size_t)function->n_out * sizeof *results);
  return function->evaluate(function->arguments, function->results, function->integers, function->reals, 0);
}
