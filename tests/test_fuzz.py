"""Whatever problems and solvers are handed, they answer with a status, or an exception of the package in a line."""

import random

import casadi as ca
import numpy as np
import pytest
from statements import CASES, PLAIN, P, S, U, state

from kpirl_ocp import OCP, SQP, Fatrop, GradientDescent, Ipopt, Riccati, Soft, Trajectory
from kpirl_ocp.errors import KpirlError

NUMBERS = [0, 1, -1, 1.5, np.nan, np.inf, -np.inf, 1e300, 10**30, True, 1j, np.float32(2)]
WORDS = ["", "a", b"x", None, {}, {"a": 1}, object(), int, len, range(3)]
LISTS = [[], [[]], [1, 2], [[1], [1, 2]], (1, 2), (1, 2, 3), (1, 0), (0, 0), ("a", "b"), ([0, 0], [1, 1])]
ARRAYS = [np.zeros(3), np.zeros((2, 2)), np.zeros((0, 2)), np.array(["a"]), np.array([None]), ca.DM([1, 2])]
SYMBOLS = [ca.MX.sym("x"), ca.SX.sym("y", 2), S, U, S[0], S.T, ca.SX(3), ca.MX(3), ca.MX(2, 2), (S, U), (U, P), (P, P)]
RECORDS = [Soft(S[0], 1.0), Soft(P, P), Trajectory(np.zeros((13, 2)), np.zeros((12, 1))), Trajectory("a", None)]
RECORDS += [ca.Function("f", [S], [S])]
ANYTHING = NUMBERS + WORDS + LISTS + ARRAYS + SYMBOLS + RECORDS
FIELDS = ["state", "action", "dynamics", "stage_cost", "terminal_cost", "horizon", "parameters", "context", "stage"]
FIELDS += ["path_constraint", "path_equality", "terminal_constraint", "terminal_equality", "observation", "schedule"]
FIELDS += ["action_bounds", "state_bounds", "initial_bounds", "static", "static_bounds", "soft"]
SOLVERS = [Riccati(max_iterations=5), Ipopt(max_iterations=5), SQP(max_iterations=3), GradientDescent(2)]
SOLVERS += [Fatrop(max_iterations=5, time_limit=10.0)]


def refused(call):
    """True if the call raises an exception of the package, in one line; no other exception is let through."""
    message = ""
    try:
        call()
    except KpirlError as error:
        message = str(error)
    assert "\n" not in message or "CasADi says" in message
    return bool(message)


@pytest.mark.parametrize("seed", range(10))
def test_statements_of_anything(seed):
    draw, count = random.Random(seed), 0
    for _ in range(30):
        changes = {name: draw.choice(ANYTHING) for name in draw.sample(FIELDS, draw.choice([1, 2]))}
        count += refused(lambda changes=changes: OCP.from_expressions(**(PLAIN | changes)))
    assert count > 5


@pytest.mark.parametrize("seed", range(10))
def test_arguments_of_anything(seed):
    draw, count = random.Random(seed), 0
    problems = [state(), *(CASES[name]().problem for name in ("bounds of parameters", "soft constraints"))]
    for _ in range(8):
        problem = draw.choice(problems)
        arguments = {"s0": [0, 0], "psi": [0.05, 0.3][: problem.n_parameters], "context": [], "guess": None}
        changes = {name: draw.choice(ANYTHING) for name in draw.sample(list(arguments), draw.choice([1, 2]))}
        for solver in SOLVERS:
            count += refused(lambda s=solver, p=problem, a=arguments | changes: s.solve(p, **a))
        count += refused(lambda p=problem, c=changes: p.simulate([0, 0], next(iter(c.values())), [0.3]))
    assert count > 5
