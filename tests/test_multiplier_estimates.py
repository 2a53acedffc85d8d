"""Multipliers estimated at a plan are those of closed forms, and with them solvers that reach a plan are believed."""

import casadi as ca
import numpy as np
import pytest
from test_random_problems import random_case
from test_random_statements import Drawing

from kpirl_ocp import OCP, SQP, Fatrop, Ipopt, Riccati, Status, Trajectory
from kpirl_ocp.ocp.conditions.audit import audit
from kpirl_ocp.ocp.conditions.multiplier_estimates import estimate_multipliers

S, U = ca.SX.sym("s"), ca.SX.sym("u")
NONE = np.zeros(0)


def problem(**changes):
    """s_2 = s_0 + u_0 + u_1 is drawn to 5; its costate is 2 (s_2 - 5), and effort pulls with 2 u."""
    plain = {"state": S, "action": U, "dynamics": S + U, "stage_cost": U**2, "terminal_cost": (S - 5) ** 2}
    return OCP.from_expressions(horizon=2, **(plain | changes))


def plan(action):
    """Both actions alike, from 0.1."""
    return Trajectory(0.1 + action * np.arange(3.0)[:, None], np.full((2, 1), action))


def estimated(case, trajectory):
    multipliers = estimate_multipliers(case, NONE, NONE, trajectory)
    return multipliers, audit(case, NONE, NONE, trajectory, multipliers)


def corner(seed):
    """min -(A' mu).u + sum cosh(u - u*) subject to A u <= A u*, with mu > 0: solved by u* with multipliers mu."""
    rng = np.random.default_rng(seed)
    n = rng.integers(1, 4)
    best, mu, A = rng.normal(size=n), rng.uniform(0.1, 10, n) * 10 ** rng.uniform(-1, 2), rng.normal(size=(n, n))
    u = ca.SX.sym("u", n)
    cost = ca.sum1(ca.cosh(u - best)) - ca.dot(A.T @ mu, u)
    case = problem(action=u, dynamics=S + u[0], stage_cost=cost, terminal_cost=0 * S, path_constraint=A @ (u - best))
    return case, best, mu


PUSH = 2 * (5 - 1.1) - 2 * 0.5  # against what holds both actions at 0.5
HELD = {
    "a bound": {"action_bounds": (-1, 0.5)},
    "an inequality": {"path_constraint": U - 0.5},
    "an inequality twice": {"path_constraint": ca.vertcat(U - 0.5, U - 0.5)},
    "an inequality and a bound": {"path_constraint": U - 0.5, "action_bounds": (-1, 0.5)},
    "an equality": {"path_equality": U - 0.5},
    "an equality twice": {"path_equality": ca.vertcat(U - 0.5, U - 0.5)},
    "an equality as two inequalities": {"path_constraint": ca.vertcat(U - 0.5, 0.5 - U)},
    "equal bounds": {"action_bounds": (0.5, 0.5)},
}


@pytest.mark.parametrize("name", HELD)
def test_what_holds_an_action_pushes_with_the_slope_of_the_cost(name):
    found, residuals = estimated(problem(**HELD[name]), plan(0.5))
    np.testing.assert_allclose(found.dynamics, np.full((2, 1), -2 * (5 - 1.1)), rtol=1e-12)
    signs = [1, -1] if name == "an equality as two inequalities" else np.ones(found.path.shape[1])
    pushes = found.action[:, 0] + found.path @ signs + found.path_equality.sum(axis=1)
    np.testing.assert_allclose(pushes, PUSH, rtol=1e-12)
    assert residuals.worst < 1e-12


@pytest.mark.parametrize("action", [0.4, 0.6])
def test_no_multipliers_are_found_where_a_plan_is_no_solution(action):
    """Away from the bound nothing balances the slope, and beyond it the plan is not feasible."""
    assert estimated(problem(action_bounds=(-1, 0.5)), plan(action))[1].worst > 0.02


def test_no_multipliers_are_found_where_there_are_none():
    """u^2 <= 0 has the slope 0 where u = 0. Of the slope (0, -9.8, 0, 0) by (s_1, s_2, u_0, u_1) nothing balances the
    projection on the directions that the dynamics allow, -9.8 (1, 3, 1, 2) / 5."""
    _, residuals = estimated(problem(path_constraint=U**2), plan(0.0))
    assert residuals.worst == pytest.approx(3 / 5)


def test_multipliers_without_inequalities_are_costates():
    """u = (5 - s_0) / 3: 2 u = 2 (5 - s_0 - 2 u)."""
    found, residuals = estimated(problem(), plan(4.9 / 3))
    np.testing.assert_allclose(found.dynamics, -2 * 4.9 / 3, rtol=1e-12)
    assert residuals.worst < 1e-12


def test_a_derivative_that_is_infinite_has_no_estimates():
    assert estimate_multipliers(problem(stage_cost=ca.sqrt(U)), NONE, NONE, plan(0.0)) is None


@pytest.mark.parametrize("first", [0, 20])
def test_estimates_confirm_whatever_riccati_solves(first):
    """Any features together: free starts, schedules, statics, soft rows, nonlinear dynamics and obstacles."""
    confirmed = 0
    for seed in range(first, first + 20):
        if seed % 2:
            case, demonstration, psi = random_case(seed)
            numbers = demonstration.s0, psi, demonstration.context
        else:
            case, numbers = Drawing(seed).problem()
        found = Riccati().solve(case, *numbers)
        if found.status is Status.CONVERGED:
            at = case, found.psi, found.context, found.trajectory
            assert audit(*at, estimate_multipliers(*at)).worst < 1e-9, seed
            confirmed += 1
    assert confirmed >= 18


@pytest.mark.parametrize("solver", [SQP(), Ipopt(), Fatrop()], ids=str)
def test_plans_in_a_corner_of_their_constraints_are_converged(solver):
    """At some of them SQP's line search ends at rounding, with a share of each multiplier."""
    for seed in (*range(15), 24, 50, 85):
        case, best, mu = corner(seed)
        found = solver.solve(case, [0.0])
        assert found.status is Status.CONVERGED, seed
        np.testing.assert_allclose(found.actions, [best, best], rtol=0, atol=1e-6)
        atol = 1e-5 if isinstance(solver, Fatrop) else 1e-7
        np.testing.assert_allclose(found.multipliers.path, [mu, mu], rtol=1e-7, atol=atol)


@pytest.mark.parametrize("solver", [SQP(), Ipopt()], ids=str)
def test_the_only_feasible_plan_is_converged_as_a_guess(solver):
    """More equalities than unknowns: Ipopt takes no step then, and qrqp has no factors; neither finds multipliers."""
    found = solver.solve(problem(**HELD["an equality twice"]), [0.1], guess=plan(0.5))
    assert found.status is Status.CONVERGED
    assert found.iterations <= 1
    np.testing.assert_allclose(found.multipliers.path_equality.sum(axis=1), PUSH, rtol=1e-8)


@pytest.mark.parametrize("solver", [SQP(), Ipopt(), Fatrop()], ids=str)
def test_where_no_multipliers_fit_a_solver_is_not_believed(solver):
    """Stopped on the way, at plans that satisfy all constraints."""
    found = type(solver)(max_iterations=1).solve(problem(stage_cost=ca.exp(U) - U), [0.1])
    assert found.residuals.feasibility < 1e-8
    assert found.status is Status.ITERATION_LIMIT
