"""Whatever problems and solvers are handed, they answer with a status, or an exception of the package in a line."""

import random

import casadi as ca
import numpy as np
import pytest
from statements import CASES, PLAIN, P, S, U, state
from test_identifiability import Q, R, one_step, planned

from kpirl_ocp import OCP, SQP, Fatrop, GradientDescent, Implicit, Ipopt, Riccati, Soft, Trajectory
from kpirl_ocp.errors import KpirlError
from kpirl_ocp.irl.identifiability.identify import identify
from kpirl_ocp.ocp.problem.statement.continuous import discretise
from kpirl_ocp.types import Demonstration

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
def test_a_statement_of_anything_is_a_problem_or_refused_in_one_line(seed):
    draw, count = random.Random(seed), 0
    for _ in range(30):
        changes = {name: draw.choice(ANYTHING) for name in draw.sample(FIELDS, draw.choice([1, 2]))}
        count += refused(lambda changes=changes: OCP.from_expressions(**(PLAIN | changes)))
    assert count > 5


@pytest.mark.parametrize("seed", range(10))
def test_a_solve_with_any_arguments_ends_in_a_status_or_is_refused_in_one_line(seed):
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


@pytest.mark.parametrize("seed", range(10))
def test_an_identification_of_anything_has_an_answer_or_is_refused_in_one_line(seed):
    draw, count, seen = random.Random(seed), 0, planned()
    anything = [*ANYTHING, state(), seen, [seen, None], [Demonstration([0], [], [[0]])]]
    arguments = {"problem": one_step(), "demonstrations": [seen], "psi": [Q, R], "spread": 1.0, "noise": 1.0}
    arguments["method"] = Implicit(policy="flag")
    found = identify(**arguments)
    for _ in range(30):
        name, value = draw.choice(list(arguments)), draw.choice(anything)
        name = "noise" if value is len else name  # as a function T -> problem it raises an error of its own
        count += refused(lambda n=name, v=value: identify(**(arguments | {n: v})))
        ask = draw.choice([found.known, found.determined, found.intervals, found.credible_intervals])
        count += refused(lambda a=ask, v=value: a(v))
        count += refused(lambda v=value: found.intervals(0.9, v))
    assert count > 40


@pytest.mark.parametrize("seed", range(10))
def test_a_discretisation_of_anything_is_an_expression_or_refused_in_one_line(seed):
    draw, count, s, u = random.Random(seed), 0, ca.MX.sym("s", 2), ca.MX.sym("u")
    arguments = {"ode": ca.vertcat(s[1], u), "state": s, "step": 0.1, "method": "rk4", "intervals": 1, "degree": 3}
    arguments |= {"algebraic": None, "residual": None}
    for _ in range(60):
        changes = {"method": draw.choice(["rk4", "midpoint", "collocation"])}
        changes[draw.choice(list(arguments))] = draw.choice([value for value in ANYTHING if not huge(value)])
        count += refused(lambda c=changes: discretise(**(arguments | c)))
    assert count > 30


def huge(value):
    return type(value) is int and value > 10**6


@pytest.mark.parametrize("solver", SOLVERS[:1] + SOLVERS[3:4], ids=repr)
def test_arrays_of_jax_are_numbers_like_others_and_tracers_are_refused(solver):
    """Tracers, as under jit, have no numbers yet."""
    jax = pytest.importorskip("jax")
    problem, count = state(), 0
    arguments = {"s0": [0, 0], "psi": [0.05, 0.3][: problem.n_parameters], "context": [], "guess": None}
    values = [[1.0, 2.0], [[1.0], [2.0]], [], 1.0, [np.nan, 1], [1j, 2], [True, False]]
    values = [*map(jax.numpy.asarray, values), jax.ShapeDtypeStruct((2,), float)]
    for name in arguments:
        for value in values:
            count += refused(lambda n=name, v=value: solver.solve(problem, **(arguments | {n: v})))
    assert count > 12
    np.testing.assert_array_equal(
        solver.solve(problem, **(arguments | {"s0": values[0]})).actions,
        solver.solve(problem, **(arguments | {"s0": [1.0, 2.0]})).actions,
    )
    traced = jax.jit(lambda s0: solver.solve(problem, **(arguments | {"s0": s0})).actions)
    assert refused(lambda: traced(values[0]))
