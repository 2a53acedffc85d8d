"""Problems of every kind that can be stated, each beside an independent statement of it in CasADi's Opti.

A case is a problem, arguments of solve, and a function of `statements_opti.py` that states the same.
"""

from typing import NamedTuple

import casadi as ca
import numpy as np
import statements_opti as opti
from statements_opti import CAP, DT, FORCE, GRID, MEASURED, PHASE, SPEED, T, cost, last_cost, pendulum

from kpirl_ocp import OCP, Soft, discretise

S, U = ca.MX.sym("s", 2), ca.MX.sym("u")
P, C, Q = ca.MX.sym("p"), ca.MX.sym("c"), ca.MX.sym("q")
PSI = ca.MX.sym("psi", 2)  # the weight of the action in all costs, and a number of the case's own
EFFORT, OWN = PSI[0], PSI[1]
D, E = ca.MX.sym("d"), ca.MX.sym("d", 2)
STEP = Q / T
TWO = ca.MX.sym("q", 2)


class Case(NamedTuple):
    problem: OCP
    arguments: tuple
    opti: object


PLAIN = {"state": S, "action": U, "dynamics": pendulum(S, U), "stage_cost": cost(S, U), "terminal_cost": last_cost(S)}
PLAIN |= {"horizon": T}
NUMBERS = [0.05, 0.4]  # psi
REST = ([0.0, 0.0], NUMBERS)


def state(**changes):
    return OCP.from_expressions(**(PLAIN | changes))


def learned(**changes):
    return OCP.from_expressions(**(PLAIN | {"parameters": PSI, "stage_cost": cost(S, U, EFFORT)} | changes))


CASES = {
    "terminal equality": lambda: Case(
        learned(terminal_equality=S - ca.vertcat(1.5 * OWN, 0)), REST, opti.terminal_equality
    ),
    "path equality": lambda: Case(
        learned(path_equality=U + 2 * OWN * S[1] - 0.3 * ca.cos(S[0])), REST, opti.path_equality
    ),
    "terminal inequality": lambda: Case(
        learned(terminal_constraint=ca.sumsqr(S) - OWN), REST, opti.terminal_inequality
    ),
    "states alone": lambda: Case(learned(path_constraint=ca.sumsqr(S) - 1.25 * OWN), REST, opti.disc),
    "context and schedule in the dynamics": lambda: Case(
        learned(
            context=C,
            stage=D,
            dynamics=pendulum(S, U, D, C),
            stage_cost=D * cost(S, U, EFFORT),
            schedule=GRID,
        ),
        (*REST, [1.7]),
        opti.context_and_schedule,
    ),
    "bounds per stage": lambda: Case(
        learned(action_bounds=(-1, FORCE), state_bounds=(-np.inf, SPEED)), REST, opti.bounds_per_stage
    ),
    "bounds of parameters": lambda: Case(
        learned(action_bounds=(-2 * OWN, 4 * OWN), state_bounds=(-np.inf, ca.vertcat(2, OWN))),
        ([0.0, 0.35], [0.05, 0.3]),
        opti.bounds_of_parameters,
    ),
    "free start": lambda: Case(learned(initial_bounds=([-0.5, -0.2], [-0.1, 0.3])), REST, opti.free_start),
    "partly free start": lambda: Case(
        learned(initial_bounds=([0, -1], [0, 1]), state_bounds=(-np.inf, [np.inf, 0.4])),
        ([0.1, 0.0], NUMBERS),
        opti.partly_free_start,
    ),
    "free final time": lambda: Case(
        learned(
            static=Q,
            static_bounds=(0.1, 10),
            dynamics=ca.vertcat(S[0] + STEP * S[1] + STEP**2 / 2 * U, S[1] + STEP * U),
            stage_cost=EFFORT * U**2,
            terminal_cost=Q,
            terminal_equality=S - ca.vertcat(2.5 * OWN, 0),
            action_bounds=(-1, 1),
        ),
        REST,
        opti.final_time,
    ),
    "bounds of context, stage and static": lambda: Case(
        learned(
            context=C,
            stage=D,
            static=Q,
            static_bounds=(0.1, 3),
            dynamics=pendulum(S, U + Q),
            terminal_cost=last_cost(S) + OWN * (Q - 1) ** 2,
            action_bounds=(-C * Q, D * Q),
            state_bounds=(-np.inf, ca.vertcat(2, C * D)),
            schedule=CAP,
        ),
        (*REST, [0.6]),
        opti.trim,
    ),
    "soft constraints": lambda: Case(
        learned(
            soft=Soft(ca.vertcat(S[0] - 0.5, U - 1.5), linear=ca.vertcat(OWN, 0.02), quadratic=ca.vertcat(0.7, 1.0)),
        ),
        REST,
        opti.soft,
    ),
    "periodic": lambda: Case(
        learned(
            static=TWO,
            stage=E,
            stage_cost=(S[0] - ca.sin(E[0])) ** 2 + EFFORT * U**2,
            terminal_cost=0.0,
            initial_bounds=(-np.inf, np.inf),
            path_equality=E[1] * (S - TWO),
            terminal_equality=S - TWO,
            schedule=np.column_stack([PHASE, np.arange(T + 1) == 0]),
        ),
        REST,
        opti.periodic,
    ),
    "identification without actions": lambda: Case(
        learned(
            action=None,
            static=Q,
            static_bounds=(0.1, 5),
            stage=D,
            dynamics=discretise(ca.vertcat(S[1], -Q * S[0]), S, step=DT),
            stage_cost=(S[0] - D) ** 2,
            terminal_cost=(S[0] - D) ** 2 + OWN * (Q - 1) ** 2,
            initial_bounds=([1, -1], [1, 1]),
            schedule=MEASURED,
        ),
        ([1.0, 0.0], NUMBERS),
        opti.identification,
    ),
    "no cost of states": lambda: Case(
        learned(stage_cost=U**2, terminal_cost=0.0, terminal_equality=S[0] - 2.5 * OWN), REST, opti.no_state_cost
    ),
}
