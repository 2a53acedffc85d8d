/* SPDX-License-Identifier: MIT */
#include "kpirl_mpc_library.h"

#include "kpirl_mpc_kkt.h"
#include "kpirl_mpc_tapes.h"

#include <string.h>

int kpirl_mpc_evaluate_buffered(void *self, const void *arguments, const void *results) {
  const kpirl_mpc_buffered *function = (const kpirl_mpc_buffered *)self;
  const real *const *from = (const real *const *)arguments;
  real *const *to = (real *const *)results;
  int i;
  for (i = 0; i < function->n_in; ++i)
    if (function->size_in[i])
      memcpy(function->arguments[i], from[function->in[i]], (size_t)function->size_in[i] * sizeof(real));
  function->evaluate(function->buffer);
  for (i = 0; i < function->n_out; ++i)
    if (to[function->out[i]] && function->size_out[i])
      memcpy(to[function->out[i]], function->results[i], (size_t)function->size_out[i] * sizeof(real));
  return function->status(function->buffer);
}

int kpirl_mpc_evaluate_compiled(void *self, const void *arguments, const void *results) {
  const kpirl_mpc_compiled *function = (const kpirl_mpc_compiled *)self;
  const real *const *from = (const real *const *)arguments;
  real *const *to = (real *const *)results;
  int i;
  for (i = 0; i < function->n_in; ++i) function->arguments[i] = from[function->in[i]];
  for (i = 0; i < function->n_out; ++i) function->results[i] = to[function->out[i]];
  return function->evaluate(function->arguments, function->results, function->integers, function->reals, 0);
}

static real *put(real *to, const real *from, int count) {
  if (count) memcpy(to, from, (size_t)count * sizeof(real));
  return to + count;
}

/* What belongs to states, then what belongs to actions, of an array in the order of x. */
static real *put_by_kind(const kpirl_mpc_core *core, real *to, const real *x) {
  const int T = core->dimensions.horizon, n_s = core->dimensions.n_states, n_u = core->dimensions.n_actions;
  int t;
  for (t = 0; t <= T; ++t) to = put(to, x + t * (n_s + n_u), n_s);
  for (t = 0; t < T; ++t) to = put(to, x + t * (n_s + n_u) + n_s, n_u);
  return to;
}

/* The solution as a row; returns where the next one begins. */
static real *put_solution(kpirl_mpc_core *core, real *to) {
  const int bounds = kpirl_mpc_n_bounds(core);
  real *net = core->trial.x;
  kpirl_mpc_bound_multipliers(core, net);
  to = put_by_kind(core, to, core->at.x);
  to = put(to, core->at.costates, core->dimensions.horizon * core->dimensions.n_states);
  to = put_by_kind(core, to, net);
  to = put(to, core->at.z + bounds, kpirl_mpc_n_inequalities(core) - bounds);
  return put(to, core->at.nu + core->n_fixed, kpirl_mpc_n_equalities(core) - core->n_fixed);
}

void kpirl_mpc_solve_each(kpirl_mpc_core *core, int count, const kpirl_mpc_numbers *numbers, const kpirl_mpc_options *options,
                          const kpirl_mpc_start *starts, real *solutions, kpirl_mpc_result *results) {
  static const kpirl_mpc_start from_no_action = {0};
  kpirl_mpc_numbers of = *numbers;
  int i;
  for (i = 0; i < count; ++i) {
    kpirl_mpc_result *result = results + i;
    result->status = kpirl_mpc_core_solve(core, &of, options, starts ? starts + i : &from_no_action, &result->residuals);
    result->objective = core->d.objective;
    result->iterations = core->iterations;
    solutions = put_solution(core, solutions);
    of.s0 += core->dimensions.n_states;
    of.psi += core->dimensions.n_parameters;
    of.context += core->dimensions.n_context;
  }
}

int kpirl_mpc_layout(void) {
  static const size_t sizes[] = {
      sizeof(kpirl_mpc_dimensions), sizeof(kpirl_mpc_model), sizeof(kpirl_mpc_bounds), sizeof(kpirl_mpc_numbers),
      sizeof(kpirl_mpc_options), sizeof(kpirl_mpc_start), sizeof(kpirl_mpc_residuals),
      sizeof(kpirl_mpc_iteration), sizeof(kpirl_mpc_buffered), sizeof(kpirl_mpc_compiled), sizeof(kpirl_mpc_tapes),
      sizeof(kpirl_mpc_members), sizeof(kpirl_mpc_system), sizeof(kpirl_mpc_triple), sizeof(kpirl_mpc_rows),
      sizeof(kpirl_mpc_kkt), sizeof(kpirl_mpc_evidence), sizeof(kpirl_mpc_by_parameters), sizeof(kpirl_mpc_result),
      sizeof(kpirl_mpc_questions), sizeof(kpirl_mpc_answers)};
  size_t sum = 0, i;
  for (i = 0; i < sizeof sizes / sizeof *sizes; ++i) sum += (i + 1) * sizes[i];
  return (int)sum;
}
