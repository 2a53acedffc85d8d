"""Predictor-corrector steps against the equations that define them, and lengths that slacks allow."""

from dataclasses import replace

import numpy as np
import pytest
from problems import TABLE

from kpirl_ocp import Riccati
from kpirl_ocp.ocp.interior_point.iterate import Newton, longest, shortened
from kpirl_ocp.ocp.interior_point.newton_step import CORRECTED

BOUNDED = [name for name in TABLE if name not in ("lqr", "pendulum")]
LEAST = 1e-9


def at_start(name, tau=0.1):
    """Newton's method at a cold start on the central path's complementarity."""
    case = TABLE[name]()
    seen = case.demonstration
    newton = Newton(case.problem, *case.problem.inputs(seen.s0, case.psi, seen.context))
    iterate = newton.start(None)
    return newton, newton.differentiate(replace(iterate, z=tau / iterate.y))


@pytest.mark.parametrize("name", BOUNDED)
def test_corrected_step_chooses_tau_by_the_first_and_adds_its_second_order(name):
    newton, at = at_start(name)
    y, z = at.iterate.y, at.iterate.z
    first, found = newton.step(at, LEAST, 0.0), newton.corrected_step(at, LEAST, 1.0)
    primal, dual = longest(y, first.dy, 1.0), longest(z, first.dz, 1.0)
    mu, mu_first = np.mean(y * z), np.mean((y + primal * first.dy) * (z + dual * first.dz))
    assert found.tau == pytest.approx(max(mu_first**3 / mu**2, LEAST), rel=1e-9)
    product = first.dy * first.dz if min(primal, dual) > CORRECTED else 0 * y
    left = y * z + z * found.dy + y * found.dz
    np.testing.assert_allclose(left, found.tau - product, rtol=0, atol=1e-11 * np.abs(z * found.dy).max())


@pytest.mark.parametrize("name", BOUNDED)
def test_corrected_step_meets_linear_constraints_at_once(name):
    newton, at = at_start(name)
    found, rows = newton.corrected_step(at, LEAST, 1.0), newton._rows
    left = rows.evaluate(at.iterate.w + found.dw, np.zeros(rows.n_path)) + at.iterate.y + found.dy
    bounds = slice(0, len(rows.bounds))
    np.testing.assert_allclose(left[bounds], 0, rtol=0, atol=1e-11 * (1 + np.abs(found.dw).max()))


def test_solution_of_the_barrier_problem_is_where_the_corrected_step_vanishes():
    """A first step towards tau = 0 would leave a correction there, and never converge."""
    case, tau = TABLE["integrator"](), 1e-3
    given = case.problem.inputs(case.demonstration.s0, case.psi, case.demonstration.context)
    newton = Newton(case.problem, *given)
    solution = Riccati(barrier=tau).solve(case.problem, *given).raise_if_failed()
    at = newton.differentiate(newton.resume(solution, tau))
    assert np.abs(newton.corrected_step(at, tau, tau).dw).max() < 1e-6
    assert np.abs(newton.step(at, 0.0, 0.0).dw).max() > 1e-4


def test_without_inequalities_the_corrected_step_is_the_newton_step():
    newton, at = at_start("lqr")
    found, plain = newton.corrected_step(at, LEAST, 1.0), newton.step(at, LEAST, 0.0)
    np.testing.assert_array_equal(found.dw, plain.dw)


@pytest.mark.parametrize(
    ("slack", "left"),
    [(0.0, 0.95), (-0.2, 0.99 / 1.2), (-9.0, 0.5), (0.5, 0.5), (np.nan, 0.5), (-np.inf, 0.5)],
    ids=["just on the bound", "beyond", "far beyond", "for another reason", "NaN", "infinite"],
)
def test_step_is_shortened_to_what_slacks_allow_but_to_half_at_least(slack, left):
    _, at = at_start("integrator")
    before = replace(at.iterate, y=np.ones(2))
    after = replace(before, y=np.array([1.0, slack]))
    assert shortened(0.8, before, after) == pytest.approx(0.8 * left, rel=1e-12)
