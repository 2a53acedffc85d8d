"""The interior-point method where it once went wrong: barriers, saddle points, rounding, infeasible sets, units."""

import sys
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from units import in_units

from kpirl_ocp import OCP, Riccati, Status, Trajectory

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
from stress.starts import minimum_time


def integrator(horizon, n=1, step=0.1, **fields):
    """s' = s + step u; the cost is given."""
    s, u = ca.SX.sym("s", n), ca.SX.sym("u", n)
    cost = fields.pop("cost")(s, u)
    return OCP.from_expressions(state=s, action=u, horizon=horizon, dynamics=s + step * u, stage_cost=cost, **fields)


@pytest.mark.parametrize("p", np.linspace(-3, 3, 25))
@pytest.mark.parametrize("barrier", [1e-1, 1e-2, 1e-4])
def test_barrier_problem_has_the_root_of_its_cubic(barrier, p):
    """min (u - p)^2 - tau log(1 - u) - tau log(1 + u):  2 (u - p)(1 - u^2) + 2 tau u = 0 within |u| < 1."""
    problem = integrator(1, cost=lambda s, u: (u - p) ** 2, action_bounds=(-1, 1))
    found = Riccati(barrier=barrier).solve(problem, [0.0])
    roots = np.roots([-1.0, p, 1.0 + barrier, -p])
    (exact,) = [root.real for root in roots if abs(root.imag) < 1e-12 and abs(root) < 1]
    assert found.status is Status.CONVERGED
    assert found.actions[0, 0] == pytest.approx(exact, abs=1e-8)


def test_indefinite_hessian_at_a_stationary_point_does_not_hold_the_method_up():
    """The plan goes to a bound at once: u = 1 or -1 at both steps."""
    problem = integrator(2, cost=lambda s, u: s**2 - u**2, action_bounds=(-1, 1))
    found = Riccati().solve(problem, [0.3])
    assert found.status is Status.CONVERGED
    assert found.iterations <= 30
    np.testing.assert_allclose(np.abs(found.actions), 1, rtol=0, atol=1e-8)


def test_where_there_is_nothing_to_decide_one_iteration_finds_the_multipliers():
    """s_t = 0.9^t, and what it costs is known before the first step; bounds that hold weigh nothing."""
    s = ca.SX.sym("s")
    problem = OCP.from_expressions(state=s, horizon=6, dynamics=0.9 * s, stage_cost=s**2, state_bounds=(0, 2))
    found = Riccati().solve(problem, [1.0])
    assert found.status is Status.CONVERGED
    assert found.iterations <= 1
    np.testing.assert_allclose(found.states[:, 0], 0.9 ** np.arange(7), rtol=1e-14, atol=0)
    costates = 2 * 0.9 ** np.arange(1, 7) * (1 - 0.81 ** np.arange(5, -1, -1)) / (1 - 0.81)
    np.testing.assert_allclose(found.multipliers.dynamics[:, 0], costates, rtol=0, atol=1e-9)


def swing_up():
    s, u = ca.SX.sym("s", 2), ca.SX.sym("u")
    return OCP.from_expressions(
        state=s,
        action=u,
        horizon=40,
        action_bounds=(-12, 12),
        dynamics=s + 0.05 * ca.vertcat(s[1], u - 9.81 * ca.sin(s[0])),
        stage_cost=1 + ca.cos(s[0]) + 1e-3 * u**2,
        terminal_cost=100 * (1 + ca.cos(s[0])) + s[1] ** 2,
    )


def test_swing_up_from_exact_rest_leaves_the_saddle_while_tau_leaves_room_to_turn():
    found = Riccati(1e-8).solve(swing_up(), [0.0, 0.0])
    assert found.status is Status.CONVERGED
    assert found.iterations <= 30
    assert np.cos(found.states[-1, 0]) < -0.99


@pytest.mark.parametrize("sign", [1, -1])
def test_without_bounds_a_maximum_is_no_solution(sign):
    problem = integrator(1, cost=lambda s, u: sign * u**2)
    assert Riccati().solve(problem, [0.0]).status is (Status.CONVERGED if sign > 0 else Status.DIVERGED)


def test_flat_minimum_is_a_solution():
    problem = integrator(2, 2, cost=lambda s, u: (u[0] + u[1] - 1) ** 2)
    found = Riccati().solve(problem, [0.0, 0.0])
    assert found.status is Status.CONVERGED
    np.testing.assert_allclose(found.actions.sum(axis=1), 1, rtol=0, atol=1e-8)


def test_feasible_set_without_interior_ends_without_a_crash():
    """The only plans from (0.9, 2) within |s| <= 1 brake at once; with |u| <= 20 there are some, and few."""
    s, u = ca.SX.sym("s", 2), ca.SX.sym("u")
    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=30,
        action_bounds=(-20, 20),
        state_bounds=(-1, 1),
        dynamics=s + 0.1 * ca.vertcat(s[1], u),
        stage_cost=ca.sumsqr(s) + 1e-2 * u**2,
    )
    found = Riccati().solve(problem, [0.9, 2.0])
    assert found.status in (Status.INFEASIBLE, Status.STALLED)  # 0.9 + 0.1 * 2 > 1
    assert found.residuals.feasibility > 1e-3


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1e3, 1e6])
def test_units_of_cost_and_states_change_neither_the_plan_nor_the_iterations_by_much(unit):
    def problem(cost_unit, length_unit):
        s, u = ca.SX.sym("s", 2), ca.SX.sym("u")
        place = s / length_unit
        return OCP.from_expressions(
            state=s,
            action=u,
            horizon=20,
            action_bounds=(-length_unit, length_unit),
            dynamics=s + 0.1 * ca.vertcat(s[1], u),
            stage_cost=cost_unit * (ca.sumsqr(place - 1) + 0.1 * (u / length_unit) ** 2),
        )

    expected = Riccati(tolerance=1e-8).solve(problem(1.0, 1.0), [0.0, 0.0])
    for cost_unit, length_unit in ((unit, 1.0), (1.0, unit)):
        found = Riccati(tolerance=1e-8 * min(1, cost_unit)).solve(problem(cost_unit, length_unit), [0.0, 0.0])
        assert found.status.ok
        np.testing.assert_allclose(found.actions / length_unit, expected.actions, rtol=0, atol=1e-5)
        assert found.iterations <= 2 * expected.iterations + 8


@pytest.mark.parametrize("state", [(1, 2**10), (2**-10, 1), (8, 1 / 8)])
@pytest.mark.parametrize("action", [(1, 2**10), (2**-10, 1), (1 / 4, 4)])
def test_a_unit_of_each_state_and_action_changes_a_cold_start_by_an_iteration_at_most(state, action):
    """By one, as tau depends on them."""
    s, u = ca.SX.sym("s", 2), ca.SX.sym("u", 2)
    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=20,
        state_bounds=([-2, -0.6], [2, 0.6]),
        action_bounds=([-1, -0.5], [1, 0.5]),
        dynamics=s + 0.1 * ca.vertcat(s[1] + 0.1 * u[1], u[0] - 0.2 * s[1]),
        stage_cost=ca.sumsqr(s) + 0.1 * ca.sumsqr(u),
    )
    s0 = np.array([1.5, 0.3])
    expected = Riccati().solve(problem, s0)
    found = Riccati().solve(in_units(problem, state=state, action=action), s0 / state)
    assert found.status.ok
    np.testing.assert_allclose(found.actions * action, expected.actions, rtol=0, atol=1e-5)
    assert abs(found.iterations - expected.iterations) <= 1


def test_closed_loop_near_equilibrium_never_runs_to_the_iteration_limit():
    """A double integrator whose weights span ten orders of magnitude, warm from period to period."""
    s, u = ca.SX.sym("s", 2), ca.SX.sym("u")
    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=20,
        action_bounds=(-1, 1),
        dynamics=s + 0.05 * ca.vertcat(s[1], ca.sin(u)),
        stage_cost=1e5 * s[0] ** 2 + s[1] ** 2 + 1e-5 * u**2,
    )
    state, plan = np.array([0.01, 0.0]), None
    for _ in range(60):
        plan = Riccati().solve(problem, state, guess=plan)
        assert plan.status.ok
        assert plan.iterations < 60
        state = plan.states[1]


def test_lifted_steps_converge_from_states_that_do_not_follow_the_dynamics():
    problem = integrator(
        20, 2, cost=lambda s, u: ca.sumsqr(ca.sin(s) - 0.5) + 0.01 * ca.sumsqr(u), action_bounds=(-2, 2)
    )
    cold = Riccati().solve(problem, [0.0, 0.0])
    wild = replace(cold.trajectory, states=np.random.default_rng(0).normal(size=(21, 2)))
    found = Riccati().solve(problem, [0.0, 0.0], guess=wild)
    assert found.status is Status.CONVERGED
    assert found.objective == pytest.approx(cold.objective, rel=1e-6)


def test_a_quadrotor_is_solved_from_states_that_follow_nothing():
    """Lifted steps close such gaps at any cost: costates grow with the regularisation, and it with them, 200 times."""
    from bench.control_problems import quadrotor

    case, rng = quadrotor(), np.random.default_rng(0)
    best = Riccati().solve(case.problem, case.s0)
    for _ in range(8):
        states = np.linspace(case.s0, 0 * case.s0, 41) + 0.2 * rng.normal(size=(41, 12))
        found = Riccati().solve(case.problem, case.s0, guess=Trajectory(states, 0.1 * rng.normal(size=(40, 4))))
        assert found.status is Status.CONVERGED, found
        assert found.iterations <= 60, found
        assert found.objective == pytest.approx(best.objective, rel=1e-8)


@pytest.mark.parametrize("change", [(0, 1e-4), (0, -1e-4), (2e-4, 0), (0, 2e-4)])
def test_rounding_of_constraints_keeps_no_warm_start_that_only_needs_multipliers(change):
    """The equality leaves nothing to decide: only multipliers are to be found."""
    s, u, p = ca.MX.sym("s", 2), ca.MX.sym("u"), ca.MX.sym("p", 2)
    speed = s[1] + 0.2 * (u - ca.sin(s[0]))
    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=p,
        horizon=12,
        dynamics=ca.vertcat(s[0] + 0.2 * speed, speed),
        stage_cost=(s[0] - 1) ** 2 + 0.1 * s[1] ** 2 + p[0] * u**2,
        terminal_cost=3 * (s[0] - 1) ** 2,
        path_equality=u + 2 * p[1] * s[1] - 0.3 * ca.cos(s[0]),
    )
    solver, psi = Riccati(barrier=1e-4), np.array([0.05, 0.4])
    guess = solver.solve(problem, [0, 0], psi).raise_if_failed()
    found = solver.solve(problem, [0, 0], psi + change, guess=guess)
    assert found.status is Status.CONVERGED
    assert found.iterations <= 5


@pytest.mark.parametrize("fixed", [False, True])
def test_one_step_leaves_nothing_but_rounding_of_a_linear_quadratic_problem_with_equalities(fixed):
    """Multipliers have no rounding of the proximal term, be they of an equality or of bounds that coincide."""
    s, u, rest = ca.SX.sym("s", 2), ca.SX.sym("u"), np.array([1.0, 0.0])
    ends = np.vstack([np.full((100, 2), np.inf), rest])
    bounds = {"state_bounds": (np.where(np.isinf(ends), -np.inf, ends), ends)}
    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=100,
        dynamics=ca.vertcat(s[0] + 0.01 * s[1] + 5e-5 * u, s[1] + 0.01 * u),
        stage_cost=0.005 * u**2 + 1e-3 * s[1] ** 2,
        **bounds if fixed else {"terminal_equality": s - rest},
    )
    found = Riccati(tolerance=1e-12).solve(problem, [0, 0])
    assert (found.status, found.iterations) == (Status.CONVERGED, 1)
    assert found.residuals.worst < 1e-13


def test_running_cost_as_a_state_costs_no_more_iterations_than_as_stage_costs():
    """Mayer's form has no Hessian but that of the dynamics, weighed with costates that a start does not know."""
    s, u = ca.SX.sym("s", 3), ca.SX.sym("u")
    step, cost = 2 / 100, (s[0] ** 2 + s[1] ** 2 + u**2) / 2
    speed = (1 - s[0] ** 2) * s[1] - s[0] + u
    moved = ca.vertcat(s[0] + step * s[1], s[1] + step * speed)
    given = {"state": s, "action": u, "horizon": 100}
    mayer = OCP.from_expressions(**given, dynamics=ca.vertcat(moved, s[2] + step * cost), terminal_cost=s[2])
    lagrange = OCP.from_expressions(**given, dynamics=ca.vertcat(moved, s[2]), stage_cost=step * cost)
    first, second = (Riccati().solve(problem, [1, 0, 0]) for problem in (mayer, lagrange))
    assert first.status is second.status is Status.CONVERGED
    assert first.objective == pytest.approx(second.objective, rel=1e-9)
    assert first.iterations <= second.iterations + 3


@pytest.mark.parametrize("place", [-15, 3, 10])
@pytest.mark.parametrize("rope", [2, 12])
def test_a_free_final_time_counts_the_same_by_stages_and_at_the_end(place, rope):
    """Its slope at one stage is a fortieth, which is no measure of what the barrier is to weigh at the start."""
    crane = minimum_time.TASKS["crane"]
    by_stages, at_end = map(minimum_time.problem_of, (crane, replace(crane, price=0.0)))
    s, *rest = at_end.terminal_cost.mx_in()
    at_end = replace(at_end, terminal_cost=ca.Function("final", [s, *rest], [s[-1]]))
    first, second = (Riccati().solve(problem, [place, rope, 0, 0, 0, 0]) for problem in (by_stages, at_end))
    assert first.status is second.status is Status.CONVERGED
    assert first.objective == pytest.approx(second.objective, rel=1e-7)
    assert first.iterations <= second.iterations + 5


@pytest.mark.parametrize("scale", [1e-5, 1e-6, 1e-7, 1e-8])
@pytest.mark.parametrize("horizon", [20, 50])
def test_a_start_that_follows_the_dynamics_is_not_taken_for_the_floor_of_rounding(scale, horizon):
    """With a small cost its residuals are those of an end already; lifted steps let feasibility get worse first."""
    s, u = ca.SX.sym("s", 2), ca.SX.sym("u")
    speed = ca.vertcat(s[1], u - ca.sin(s[0]))
    given = {"state": s, "action": u, "dynamics": s + 0.1 * speed, "stage_cost": scale * (ca.sumsqr(s) + 0.01 * u**2)}
    problem = OCP.from_expressions(**given, horizon=horizon, action_bounds=(-2, 2))
    for tolerance in (1e-8, 1e-10):
        for s0 in ([1.0, 1.0], [3.0, 0.0]):
            assert Riccati(tolerance).solve(problem, s0).status is Status.CONVERGED
