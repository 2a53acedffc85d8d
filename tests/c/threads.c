/* Two controllers in two threads give what one gives alone. */
#include <pthread.h>
#include <stdio.h>
#include <string.h>

#include "kpirl_mpc_memory.h"
#include "test/records.h"

enum { ROUNDS = 50 };

static kpirl_mpc memory[3];
static kpirl_mpc_solution plans[3][ROUNDS];

static void *work(void *number) {
  const int which = *(int *)number;
  kpirl_mpc *mpc = NULL;
  kpirl_mpc_guess guess;
  int round, i;
  kpirl_mpc_init(&mpc, &memory[which], sizeof memory[which]);
  for (round = 0; round < ROUNDS; ++round) {
    kpirl_mpc_real state[KPIRL_MPC_N_STATES];
    kpirl_mpc_input input = {.state = state, .context = kpirl_mpc_record_context[0]};
    for (i = 0; i < KPIRL_MPC_N_STATES; ++i) state[i] = kpirl_mpc_record_state[0][i] + (kpirl_mpc_real)(0.001 * round);
    if (round) guess = kpirl_mpc_resume(&plans[which][round - 1]);
    kpirl_mpc_solve(mpc, &input, round ? &guess : NULL, &plans[which][round]);
  }
  return NULL;
}

int main(void) {
  int numbers[3] = {0, 1, 2};
  pthread_t threads[2];
  work(&numbers[2]);
  pthread_create(&threads[0], NULL, work, &numbers[0]);
  pthread_create(&threads[1], NULL, work, &numbers[1]);
  pthread_join(threads[0], NULL);
  pthread_join(threads[1], NULL);
  if (memcmp(plans[0], plans[2], sizeof plans[0]) || memcmp(plans[1], plans[2], sizeof plans[1])) return 1;
  printf("the same in all threads\n");
  return plans[2][0].status != KPIRL_MPC_CONVERGED;
}
