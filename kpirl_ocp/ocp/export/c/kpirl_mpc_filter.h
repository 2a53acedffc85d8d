/* SPDX-License-Identifier: MIT
 *
 * A filter line search: a step must reduce the objective or the violation of the constraints, and never cycle
 * (Waechter and Biegler, 2006, section 2.3).
 */
#ifndef KPIRL_MPC_FILTER_H
#define KPIRL_MPC_FILTER_H

#include "kpirl_mpc_riccati.h"

typedef struct kpirl_mpc_merit {
  kpirl_mpc_real theta, phi; /* sum of the violations of all constraints, and J - tau sum log y */
} kpirl_mpc_merit;

/* For a first iterate with violation theta. */
void kpirl_mpc_start_filter(kpirl_mpc_filter *filter, kpirl_mpc_real theta);

/* Is a step of `length` from `before`, with directional derivative `slope` of phi, to `trial` good enough? Adds the
 * point it leaves to the filter, unless the objective alone decided. */
int kpirl_mpc_accepts(kpirl_mpc_filter *filter, kpirl_mpc_merit before, kpirl_mpc_real slope, kpirl_mpc_real length,
                      kpirl_mpc_merit trial);

#endif
