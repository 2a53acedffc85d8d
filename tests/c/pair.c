/* Two exported controllers in one program. */
#include <stdio.h>

#include "left.h"
#include "right.h"

int main(void) {
  left *a = left_create();
  right *b = right_create();
  left_solution plan_a;
  right_solution plan_b;
  static const double zeros[64] = {0};
  left_input input_a = {.state = zeros, .context = zeros};
  right_input input_b = {.state = zeros, .context = zeros};
  if (!a || !b || left_solve(a, &input_a, NULL, &plan_a) < 0 || right_solve(b, &input_b, NULL, &plan_b) < 0) return 1;
  printf("%d %d\n", LEFT_N_STATES, RIGHT_N_STATES);
  left_destroy(a);
  right_destroy(b);
  return 0;
}
