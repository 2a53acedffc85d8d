"""Solvers, hypergradients and solutions are pickled before and after use; copies give the same numbers."""

import pickle
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
from problems import pendulum

from kpirl_ocp import (
    SQP,
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

S0, PSI = [0.3, 0.0], [0.9, 0.6]
SOLVERS = [Riccati(), Riccati(barrier=1e-3), GradientDescent(20, 0.05), Ipopt(), Fatrop(), SQP()]
METHODS = [
    Implicit(),
    Implicit(Ipopt(), policy="flag"),
    Unrolled(GradientDescent(5, 0.05), policy="flag"),
    Truncated(GradientDescent(5, 0.05), 2),
    FiniteDifference(Riccati(), policy="flag"),
]


def bounded():
    """The problem of the pendulum with bounds on its torque, which gradient descent does not take."""
    return replace(pendulum().problem, action_bounds=(-1.0, 1.0))


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
    problem = pendulum().problem if isinstance(solver, GradientDescent) else bounded()
    before = copied(solver)
    found = solver.solve(problem, S0, PSI)
    for copy in (before, copied(solver)):
        assert copy == solver
        assert_same(copy.solve(problem, S0, PSI), found)


@pytest.mark.parametrize("method", METHODS, ids=lambda x: type(x).__name__)
def test_a_hypergradient_is_pickled_before_and_after_use(method):
    case, before = pendulum(), copied(method)
    loss, gradient, _ = method(case.problem, case.demonstration, PSI)
    for copy in (before, copied(method)):
        again = copy(case.problem, case.demonstration, PSI)
        assert again.loss == loss
        np.testing.assert_array_equal(again.gradient, gradient)


def test_a_solution_is_pickled_before_and_after_it_was_differentiated():
    problem = bounded()
    found = Riccati().solve(problem, S0, PSI)
    before, slopes = copied(found), (np.ones_like(found.states), np.ones_like(found.actions))
    gradients = sensitivity(problem, found).pull(*slopes)
    for copy in (before, copied(found)):
        assert_same(copy, found)
        np.testing.assert_array_equal(sensitivity(problem, copy).pull(*slopes).psi, gradients.psi)
    np.testing.assert_array_equal(copied(gradients).psi, gradients.psi)
