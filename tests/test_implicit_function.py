"""Derivatives of solutions by psi, s_0 and the context: against one dense KKT matrix, and against each other."""

from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np
import pytest
from dense_kkt import derivative
from kkt_products import times_hessian, times_jacobian
from problems import TABLE, network, swing_up

from kpirl_ocp import OCP, Ipopt, Riccati
from kpirl_ocp.ocp.conditions.nlp import pack
from kpirl_ocp.ocp.sensitivity.factorisation import Factorisation
from kpirl_ocp.ocp.sensitivity.implicit_function import ByParameters, ImplicitFunction
from kpirl_ocp.ocp.sensitivity.kkt_system import PrimalDual, linearise
from kpirl_ocp.ocp.sensitivity.solution_sensitivity import sensitivity

CASES = TABLE | {
    "swing-up, 45 steps": lambda: swing_up(45),
    "tanh network, 100 steps": lambda: long_network(),
}
SMOOTHED = {"integrator": 1e-3, "tanh network": 1e-4}


@lru_cache
def long_network():
    """A network problem of 100 steps; the random network is too lively for that without smaller steps."""
    case = network("tanh", 100)
    return replace(case, psi=case.psi * np.array([0.3, 0.3, 0.3, 0.3, 1.0]))


@lru_cache
def solved(name, barrier=0.0):
    """The arguments of a solve, the solution, its derivative and the dense one."""
    case = CASES[name]()
    given = (case.problem, case.demonstration.s0, case.psi, case.demonstration.context)
    solver = Riccati(tolerance=1e-11)
    solution = (solver.with_barrier(barrier) if barrier else solver).solve(*given).raise_if_failed()
    return given, solution, ImplicitFunction.at(given[0], solution), derivative(given[0], solution)


ROWS = [(name, 0.0) for name in CASES] + list(SMOOTHED.items())


@pytest.mark.parametrize(("name", "barrier"), ROWS)
def test_gradients_equal_those_of_the_dense_kkt_matrix(name, barrier):
    (problem, *_), solution, function, dense = solved(name, barrier)
    slope = np.random.default_rng(0).normal(size=len(pack(solution.trajectory)))
    adjoint, residual = function.factors.adjoint(slope)
    found = function.pull(adjoint)
    expected = slope @ dense
    assert len(found.psi) == problem.n_parameters
    np.testing.assert_allclose(np.concatenate(found), expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    assert residual < 1e-10


@pytest.mark.parametrize(("name", "barrier"), ROWS)
def test_changes_of_the_trajectory_equal_those_of_the_dense_kkt_matrix(name, barrier):
    (problem, s0, psi, context), _, function, dense = solved(name, barrier)
    parts = ByParameters(*(np.random.default_rng(1).normal(size=len(x)) for x in (psi, s0, context)))
    found, residual = function.push(parts)
    expected = dense @ np.concatenate(parts)
    np.testing.assert_allclose(pack(found), expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    np.testing.assert_array_equal(found.states[0], parts.s0)
    assert residual < 1e-10
    assert found.actions.shape == (problem.horizon, problem.n_actions)


@pytest.mark.parametrize("name", CASES)
def test_both_products_are_adjoint(name):
    (_, s0, psi, context), solution, function, _ = solved(name)
    rng = np.random.default_rng(2)
    slope = rng.normal(size=len(pack(solution.trajectory)))
    parts = ByParameters(*(rng.normal(size=len(x)) for x in (psi, s0, context)))
    one = slope @ pack(function.push(parts)[0])
    other = np.concatenate(function.pull(function.factors.adjoint(slope)[0])) @ np.concatenate(parts)
    np.testing.assert_allclose(one, other, rtol=1e-9)


@pytest.mark.parametrize("name", ["integrator", "iiwa at a limit", "tanh network"])
def test_derivative_by_the_initial_state_equals_differences_of_solutions(name):
    (problem, s0, psi, context), solution, function, _ = solved(name)
    direction = np.random.default_rng(3).normal(size=len(s0))
    found, _ = function.push(ByParameters(np.zeros(len(psi)), direction, np.zeros(len(context))))
    errors = []
    for h in (1e-3, 1e-4, 1e-5):
        ends = [
            Ipopt(tolerance=1e-12).solve(problem, s0 + sign * h * direction, psi, context, guess=solution)
            for sign in (1, -1)
        ]
        slope = (pack(ends[0].trajectory) - pack(ends[1].trajectory)) / (2 * h)
        errors.append(np.abs(slope - pack(found)).max() / np.abs(slope).max())
    assert min(errors) < 1e-6


def test_curvature_and_qualification_equal_their_dense_definitions():
    _, solution, function, _ = solved("tanh network")
    system, factors = function.system, function.factors
    n, size = len(system.defects), len(pack(solution.trajectory))
    columns = np.eye(size)
    H = np.array([times_hessian(system, column) for column in columns])
    A = np.array([times_jacobian(system, column) for column in columns]).T
    Z = np.vstack([-np.linalg.solve(A[:, :n], A[:, n:]), np.eye(size - n)])
    rows = np.array([system.times_rows(column) for column in columns]).T[system.active] @ Z
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    _, singular, right = np.linalg.svd(rows)
    free = right[len(singular) :].T
    condensed = Z.T @ H @ Z
    values = np.linalg.eigvalsh(free.T @ condensed @ free)
    assert len(rows) > 3
    np.testing.assert_allclose(factors.qualification, singular.min(), rtol=1e-2)
    n_s, n_u = system.instance.problem.n_states, system.instance.problem.n_actions
    local = 0.0
    for t in range(system.instance.problem.horizon):
        for i in n + n_u * t + np.arange(n_u):
            one_step = np.zeros(size)
            one_step[n_s * t : n_s * (t + 1)] = (Z @ columns[n:, i])[n_s * t : n_s * (t + 1)]
            one_step[i] = 1.0
            local = max(local, abs(one_step @ H @ one_step))
    np.testing.assert_allclose(factors.curvature, values[0] / local, rtol=2e-2)


def test_unstable_dynamics_do_not_hide_a_minimum():
    """s' = 1.3 s + u over 60 steps: the first action is worth 7e6 at the end, squared, beside an effort of one."""
    s, u, psi = ca.SX.sym("s"), ca.SX.sym("u"), ca.SX.sym("psi")
    problem = OCP.from_expressions(
        state=s, action=u, parameters=psi, horizon=60, dynamics=1.3 * s + u, stage_cost=psi * s**2 + u**2
    )
    solution = Riccati().solve(problem, [1.0], [1.0]).raise_if_failed()
    gradients = sensitivity(problem, solution).pull(np.zeros((61, 1)), np.eye(60)[:, :1])
    assert gradients.certificate.certified
    gain = []  # of u_0 = -K s_0 by the recursion of Riccati, for psi = 1 +- h
    for q in (1 + 1e-6, 1 - 1e-6):
        p = 0.0
        for _ in range(60):
            k = 1.3 * p / (1 + p)
            p = q + k**2 + p * (1.3 - k) ** 2
        gain.append(k)
    np.testing.assert_allclose(gradients.psi, -(gain[0] - gain[1]) / 2e-6, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "barrier"), [("integrator", 0.0), ("iiwa at a limit", 0.0), ("tanh network", 0.0), *SMOOTHED.items()]
)
def test_change_of_the_adjoint_nearby_is_that_between_two_linearisations(name, barrier):
    _, _, function, _ = solved(name, barrier)
    system, rng = function.system, np.random.default_rng(4)
    slope = rng.normal(size=len(system.point.w))
    adjoint, _ = function.factors.adjoint(slope)
    point = system.point
    nearby = PrimalDual(
        point.w + 1e-6 * rng.normal(size=point.w.shape),
        point.costates + 1e-4 * rng.normal(size=point.costates.shape),
        point.forces * (1 + 1e-4 * rng.normal(size=point.forces.shape)),
    )
    found = function.factors.change_nearby(nearby, slope, adjoint)
    moved, _ = Factorisation(linearise(system.instance, nearby, system.active)).adjoint(slope)
    expected = np.linalg.norm(moved.w - adjoint.w) / np.linalg.norm(adjoint.w)
    np.testing.assert_allclose(found, expected, rtol=1e-2, atol=1e-8)


@pytest.mark.parametrize("name", ["swing-up, 45 steps", "tanh network"])
def test_adjoint_is_not_found_where_these_factors_are_of_no_use(name):
    _, _, function, _ = solved(name)
    point, slope = function.system.point, np.ones(len(function.system.point.w))
    far = PrimalDual(point.w, point.costates * -1e4, point.forces)  # another Hessian
    assert function.factors.change_nearby(far, slope, function.factors.adjoint(slope)[0]) == np.inf


@pytest.mark.parametrize("name", ["integrator", "iiwa at a limit", "tanh network"])
def test_what_was_begun_with_the_factors_ends_where_it_would_otherwise(name):
    _, _, function, _ = solved(name)
    system, slope = function.system, np.random.default_rng(5).normal(size=len(function.system.point.w))
    together = Factorisation(system, slope)
    (one, residual), (other, _) = together.adjoint(slope), function.factors.adjoint(slope)
    assert residual < 1e-10
    np.testing.assert_allclose(one.w, other.w, rtol=0, atol=1e-10 * np.abs(other.w).max())
    another = -slope  # one that was not begun
    np.testing.assert_allclose(together.adjoint(another)[0].w, -one.w, rtol=0, atol=1e-10 * np.abs(other.w).max())
    steps = together.newton_step(), function.factors.newton_step()
    np.testing.assert_allclose(steps[0].w, steps[1].w, rtol=0, atol=1e-10)
