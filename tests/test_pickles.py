"""Solvers, hypergradients and solutions are pickled before and after use; copies give the same numbers."""

import pickle
from dataclasses import fields, is_dataclass

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp import (
    OCP,
    SQP,
    Demonstration,
    Fatrop,
    FiniteDifference,
    GradientDescent,
    Implicit,
    Ipopt,
    Riccati,
    Truncated,
    Unrolled,
)
from kpirl_ocp.ocp.sensitivity import sensitivity

PSI = [0.8, 0.3]
SOLVERS = [Riccati(), Riccati(barrier=1e-3), GradientDescent(20, 0.05), Ipopt(), Fatrop(), SQP()]
METHODS = [
    Implicit(),
    Implicit(Ipopt(), policy="flag"),
    Unrolled(GradientDescent(5, 0.05), policy="flag"),
    Truncated(GradientDescent(5, 0.05), 2),
    FiniteDifference(Riccati(), policy="flag"),
]


def pendulum(bounds=(-np.inf, np.inf)):
    s, u, psi = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("psi", 2)
    return OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        horizon=6,
        action_bounds=bounds,
        dynamics=s + 0.1 * ca.vertcat(s[1], u - psi[0] * ca.sin(s[0])),
        stage_cost=(s[0] - 1) ** 2 + psi[1] * u**2,
        terminal_cost=ca.sumsqr(s),
    )


def copied(thing):
    return pickle.loads(pickle.dumps(thing))


def numbers_of(record):
    """All arrays and numbers of a record, by name."""
    found = {}
    for field in fields(record):
        value = getattr(record, field.name)
        inner = numbers_of(value) if is_dataclass(value) else {"": value}
        found |= {f"{field.name}.{name}": number for name, number in inner.items()}
    return found


def assert_same(one, other):
    expected = numbers_of(other)
    for name, value in numbers_of(one).items():
        np.testing.assert_array_equal(value, expected[name], err_msg=name)


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda x: type(x).__name__)
def test_a_solver_is_pickled_before_and_after_use(solver):
    problem = pendulum() if isinstance(solver, GradientDescent) else pendulum((-2, 2))
    before = copied(solver)
    found = solver.solve(problem, [0.2, 0], PSI)
    for copy in (before, copied(solver)):
        assert copy == solver
        assert_same(copy.solve(problem, [0.2, 0], PSI), found)


@pytest.mark.parametrize("method", METHODS, ids=lambda x: type(x).__name__)
def test_a_hypergradient_is_pickled_before_and_after_use(method):
    problem, before = pendulum(), copied(method)
    seen = Demonstration([0.2, 0], [], Ipopt().solve(problem, [0.2, 0], [0.5, 0.2]).states)
    loss, gradient, _ = method(problem, seen, PSI)
    for copy in (before, copied(method)):
        again = copy(problem, seen, PSI)
        assert again.loss == loss
        np.testing.assert_array_equal(again.gradient, gradient)


def test_a_solution_is_pickled_before_and_after_it_was_differentiated():
    problem = pendulum((-2, 2))
    found = Riccati().solve(problem, [0.2, 0], PSI)
    before, slopes = copied(found), (np.ones_like(found.states), np.ones_like(found.actions))
    gradients = sensitivity(problem, found).pull(*slopes)
    for copy in (before, copied(found)):
        assert_same(copy, found)
        np.testing.assert_array_equal(sensitivity(problem, copy).pull(*slopes).psi, gradients.psi)
    np.testing.assert_array_equal(copied(gradients).psi, gradients.psi)
