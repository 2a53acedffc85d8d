/* SPDX-License-Identifier: MIT
 *
 * Functions of stages as tapes: operations on slots, carried out one after the other for several stages side by side.
 *
 * An interpreter mostly finds out which operation is the next. Here it does so once for LANES stages, whose numbers
 * stand beside each other in a slot. Operations round as those of CasADi's virtual machine do, so that results are the same to
 * the last bit.
 */
#include "kpirl_mpc_tapes.h"

#include <math.h>
#include <string.h>

enum { LANES = 16 };

int kpirl_mpc_lanes(void) { return LANES; }

/* In the order of `KINDS` in tapes.py. */
enum {
  CONSTANT, INPUT, OUTPUT,
  ADD, SUB, MUL, DIV, POW, CONSTPOW, FMOD, REMAINDER, ATAN2, HYPOT, COPYSIGN, FMIN, FMAX,
  LT, LE, EQ, NE, AND, OR, IF_ELSE_ZERO,
  NEG, INV, SQ, TWICE, SQRT, NOT, SIGN, FABS, FLOOR, CEIL,
  EXP, EXPM1, LOG, LOG1P, ERF, SIN, COS, TAN, ASIN, ACOS, ATAN, SINH, COSH, TANH, ASINH, ACOSH, ATANH
};

/* Operands `from` of an INPUT, which is entry `other` of it, and `to` of an OUTPUT, of which it is entry `other`. */
enum { STATES, ACTIONS, PSI, CONTEXT, SCHEDULE, COSTATES, Z, NU, INPUTS };
enum { COST, SUCCESSOR, PATH, EQUALITY, COST_GRADIENT, GRADIENT, JACOBIAN_F, JACOBIAN_G, JACOBIAN_E, HESSIAN, OUTPUTS };

/* Arrays of all stages, and how far it is from one stage to the next. */
typedef struct arrays {
  const real *from[INPUTS];
  real *to[OUTPUTS];
  int from_step[INPUTS], to_step[OUTPUTS];
} arrays;

/* y may be the place of an operand. Lanes beyond `count` hold stage t once more: there, what takes long is not calculated again. */
#define OF_ONE(lanes, value)                          \
  for (i = 0; i < lanes; ++i) {                       \
    const real a = slots[o->from * LANES + i];        \
    y[i] = (value);                                   \
  }                                                   \
  for (; i < LANES; ++i) y[i] = y[0];                 \
  memcpy(slots + o->to * LANES, y, sizeof y);         \
  break

#define OF_TWO(lanes, value)                          \
  for (i = 0; i < lanes; ++i) {                       \
    const real a = slots[o->from * LANES + i];        \
    const real b = slots[o->other * LANES + i];       \
    y[i] = (value);                                   \
  }                                                   \
  for (; i < LANES; ++i) y[i] = y[0];                 \
  memcpy(slots + o->to * LANES, y, sizeof y);         \
  break

/* Stages t to t + count. */
static void play(const kpirl_mpc_tape *tape, const arrays *of, int t, int count, real *slots) {
  const kpirl_mpc_operation *o = tape->operations, *const end = o + tape->n_operations;
  real y[LANES];
  int i;
  for (; o < end; ++o) switch (o->kind) {
      case CONSTANT:
        for (i = 0; i < LANES; ++i) slots[o->to * LANES + i] = tape->constants[o->from];
        break;
      case INPUT:
        for (i = 0; i < LANES; ++i)
          slots[o->to * LANES + i] = of->from[o->from][(t + (i < count ? i : 0)) * of->from_step[o->from] + o->other];
        break;
      case OUTPUT:
        for (i = 0; i < count; ++i) of->to[o->to][(t + i) * of->to_step[o->to] + o->other] = slots[o->from * LANES + i];
        break;
      case ADD: OF_TWO(LANES, a + b);
      case SUB: OF_TWO(LANES, a - b);
      case MUL: OF_TWO(LANES, a * b);
      case DIV: OF_TWO(LANES, a / b);
      case POW:
      case CONSTPOW: OF_TWO(count, pow(a, b));
      case FMOD: OF_TWO(count, fmod(a, b));
      case REMAINDER: OF_TWO(count, remainder(a, b));
      case ATAN2: OF_TWO(count, atan2(a, b));
      case HYPOT: OF_TWO(count, hypot(a, b));
      case COPYSIGN: OF_TWO(LANES, copysign(a, b));
      case FMIN: OF_TWO(LANES, fmin(a, b));
      case FMAX: OF_TWO(LANES, fmax(a, b));
      case LT: OF_TWO(LANES, a < b);
      case LE: OF_TWO(LANES, a <= b);
      case EQ: OF_TWO(LANES, a == b);
      case NE: OF_TWO(LANES, a != b);
      case AND: OF_TWO(LANES, a != 0 && b != 0);
      case OR: OF_TWO(LANES, a != 0 || b != 0);
      case IF_ELSE_ZERO: OF_TWO(LANES, a == 0 ? 0 : b);
      case NEG: OF_ONE(LANES, -a);
      case INV: OF_ONE(LANES, 1 / a);
      case SQ: OF_ONE(LANES, a * a);
      case TWICE: OF_ONE(LANES, 2 * a);
      case SQRT: OF_ONE(LANES, sqrt(a));
      case NOT: OF_ONE(LANES, a == 0);
      case SIGN: OF_ONE(LANES, a < 0 ? -1 : a > 0 ? 1 : a);
      case FABS: OF_ONE(LANES, fabs(a));
      case FLOOR: OF_ONE(LANES, floor(a));
      case CEIL: OF_ONE(LANES, ceil(a));
      case EXP: OF_ONE(count, exp(a));
      case EXPM1: OF_ONE(count, expm1(a));
      case LOG: OF_ONE(count, log(a));
      case LOG1P: OF_ONE(count, log1p(a));
      case ERF: OF_ONE(count, erf(a));
      case SIN: OF_ONE(count, sin(a));
      case COS: OF_ONE(count, cos(a));
      case TAN: OF_ONE(count, tan(a));
      case ASIN: OF_ONE(count, asin(a));
      case ACOS: OF_ONE(count, acos(a));
      case ATAN: OF_ONE(count, atan(a));
      case SINH: OF_ONE(count, sinh(a));
      case COSH: OF_ONE(count, cosh(a));
      case TANH: OF_ONE(count, tanh(a));
      case ASINH: OF_ONE(count, asinh(a));
      case ACOSH: OF_ONE(count, acosh(a));
      case ATANH: OF_ONE(count, atanh(a));
    }
}

int kpirl_mpc_evaluate_tapes(void *self, const kpirl_mpc_horizon_arguments *arguments, const kpirl_mpc_horizon_results *results) {
  const kpirl_mpc_tapes *tapes = (const kpirl_mpc_tapes *)self;
  const kpirl_mpc_dimensions *n = &tapes->dimensions;
  const int T = n->horizon, n_s = n->n_states, n_x = n_s + n->n_actions;
  const arrays stages = {
      {arguments->states, arguments->actions, arguments->psi, arguments->context, tapes->schedule, arguments->costates,
       arguments->z, arguments->nu},
      {tapes->costs, results->successor, results->path, results->equality, results->cost_gradient, results->gradient, results->F,
       results->G, results->E, results->H},
      {n_s, n->n_actions, 0, 0, n->n_schedule, n_s, n->n_path, n->n_equality},
      {1, n_s, n->n_path, n->n_equality, n_x, n_x, n_s * n_x, n_x * n->n_path, n_x * n->n_equality, n_x * n_x}};
  const arrays end = {
      {arguments->states + T * n_s, NULL, arguments->psi, arguments->context, tapes->schedule + T * n->n_schedule, NULL,
       arguments->z_last, arguments->nu_last},
      {tapes->costs + T, NULL, results->path_last, results->equality_last, results->cost_gradient_last, results->gradient_last,
       NULL, results->G_last, results->E_last, results->H_last},
      {0},
      {0}};
  int t;
  for (t = 0; t < T; t += LANES) play(&tapes->stage, &stages, t, T - t < LANES ? T - t : LANES, tapes->slots);
  play(&tapes->last, &end, 0, 1, tapes->slots);
  *results->cost = 0;
  for (t = 0; t <= T; ++t) *results->cost += tapes->costs[t];
  return 0;
}

static void read_vector(const kpirl_mpc_members *members, kpirl_mpc_vector vector, int *first_and_last) {
  const int some = vector.begin != vector.end;
  first_and_last[0] = some ? (int)vector.begin[0] : 0;
  first_and_last[1] = some ? (int)vector.end[-1] : 0;
  members->release(vector.begin);
}

void kpirl_mpc_read_operations(const kpirl_mpc_members *members, const void *function, int count, int constant, int *rows,
                               real *constants) {
  int k;
  for (k = 0; k < count; ++k, rows += 5) {
    rows[0] = (int)members->kind(function, k);
    read_vector(members, members->output(function, k), rows + 1);
    read_vector(members, members->input(function, k), rows + 3);
    if (rows[0] == constant) *constants++ = members->constant(function, k);
  }
}
