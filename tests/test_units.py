"""The certificate says the same, and the gradient is the same, in every unit of cost, states, time and constraints."""

from functools import lru_cache

import numpy as np
import pytest
import statements
from problems import TABLE
from units import in_units, solution_in_units

from kpirl_ocp import Riccati, sensitivity

COSTS = 10.0 ** np.arange(-6, 7, 2)
STATED = ["terminal inequality", "bounds per stage", "path equality", "free start", "soft constraints"]
NAMES = [*TABLE, *STATED]
UNTOUCHED = ("qualification", "margin", "curvature")


@lru_cache
def stated(name):
    """Problem, arguments of a solve, and solution."""
    if name in TABLE:
        case = TABLE[name]()
        problem, arguments = case.problem, (case.demonstration.s0, case.psi, case.demonstration.context)
    else:
        problem, arguments, _ = statements.CASES[name]()
    return problem, arguments, Riccati(tolerance=1e-11).solve(problem, *arguments).raise_if_failed()


def slopes(solution):
    rng = np.random.default_rng(0)
    return rng.normal(size=solution.states.shape), rng.normal(size=solution.actions.shape)


def assert_same(found, expected, tolerance):
    scale = np.abs(expected.psi).max(initial=0.0)
    np.testing.assert_allclose(found.psi, expected.psi, rtol=0, atol=tolerance * scale)
    assert found.certificate.certified, found.certificate
    for name in UNTOUCHED:
        one, other = (getattr(at.certificate, name) for at in (found, expected))
        np.testing.assert_allclose(one, other, rtol=0.05, err_msg=name)
    np.testing.assert_array_equal(found.certificate.active, expected.certificate.active)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", range(4))
def test_a_solution_in_other_units_has_the_same_gradient_and_evidence(name, seed):
    """Units of cost, constraints and every state and action between 1e-3 and 1e3, on their own."""
    problem, _, solution = stated(name)
    rng = np.random.default_rng(seed)
    draws = {"cost": 1, "rows": 1, "state": problem.n_states, "action": problem.n_actions}
    units = {key: 10.0 ** rng.uniform(-3, 3, size) for key, size in draws.items()}
    units |= {key: float(units[key][0]) for key in ("cost", "rows")}
    by_states, by_actions = slopes(solution)
    other = sensitivity(in_units(problem, **units), solution_in_units(solution, **units))
    found = other.pull(by_states * units["state"], by_actions * units["action"])
    assert_same(found, sensitivity(problem, solution).pull(by_states, by_actions), 1e-6)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("cost", COSTS)
def test_a_problem_solved_in_any_unit_of_the_cost_has_the_same_gradient_and_verdict(name, cost):
    """At its default tolerance, in units of the cost, Riccati leaves plans of a small cost far from exact."""
    problem, arguments, solution = stated(name)
    other = in_units(problem, cost=cost)
    found = sensitivity(other, Riccati().solve(other, *arguments)).pull(*slopes(solution))
    assert_same(found, sensitivity(problem, solution).pull(*slopes(solution)), 1e-6)
