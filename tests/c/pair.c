/* Two exported controllers in one program. */
#include <stdio.h>

#include "kpirl_mpc.h"
#include "other.h"

int main(void) {
  kpirl_mpc *a = kpirl_mpc_create();
  other *b = other_create();
  kpirl_mpc_solution plan_a;
  other_solution plan_b;
  static const double zeros[64] = {0};
  kpirl_mpc_input input_a = {.state = zeros, .context = zeros};
  other_input input_b = {.state = zeros, .context = zeros};
  if (!a || !b || kpirl_mpc_solve(a, &input_a, NULL, &plan_a) < 0 || other_solve(b, &input_b, NULL, &plan_b) < 0) return 1;
  printf("%d %d\n", KPIRL_MPC_N_STATES, OTHER_N_STATES);
  kpirl_mpc_destroy(a);
  other_destroy(b);
  return 0;
}
