"""Feasibility restoration: past constraints that leave no room, and the proof that there is no feasible point."""

import runpy
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from reference import REFERENCES
from test_random_problems import random_case
from test_random_statements import Drawing

from kpirl_ocp import OCP, Ipopt, Riccati, Status, Trajectory
from kpirl_ocp.ocp.conditions.audit import audit

EXAMPLES = Path(__file__).parents[1] / "examples"


def around_a_disc(steps=30, dt=0.1, unit=1.0, unit_at_end=1.0):
    """From s_0 to rest at (2, 0), half a metre away from (1, 0); constraints in units of their own."""
    s, u = ca.SX.sym("s", 4), ca.SX.sym("u", 2)
    return OCP.from_expressions(
        state=s,
        action=u,
        horizon=steps,
        dynamics=ca.vertcat(s[:2] + dt * s[2:], s[2:] + dt * u),
        stage_cost=0.1 * ca.sumsqr(u),
        path_constraint=unit * (0.25 - ca.sumsqr(s[:2] - ca.vertcat(1, 0))),
        terminal_equality=unit_at_end * (s - ca.vertcat(2, 0, 0, 0)),
    )


@pytest.mark.parametrize("s0", [(0, 0.1), (0, -0.5), (0.2, 0.3), (0, 0.02), (0, 1), (-1, -0.1)])
def test_disc_between_start_and_goal_is_passed(s0):
    problem = around_a_disc()
    found = Riccati().solve(problem, [*s0, 0, 0]).raise_if_failed()
    residuals = audit(problem, np.zeros(0), np.zeros(0), found, found.multipliers)
    assert max(residuals.stationarity, residuals.feasibility, residuals.complementarity) <= 1e-6
    beside = found.states[:-1, :2] - [1, 0]
    assert np.linalg.norm(beside, axis=1).min() >= 0.5 - 1e-7


def test_a_way_around_a_disc_is_found_far_more_often_than_by_ipopt():
    """A narrow plan, with bounds of speed; where multipliers lag, most of these stay in front of the disc."""
    s, u = ca.SX.sym("s", 4), ca.SX.sym("u", 2)
    dt = 0.1
    position = s[:2] + dt * s[2:] + dt**2 / 2 * u
    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=30,
        dynamics=ca.vertcat(position, s[2:] + dt * u),
        stage_cost=ca.sumsqr(u),
        action_bounds=(-2, 2),
        state_bounds=([-10, -10, -1, -1], [10, 10, 1, 1]),
        path_constraint=0.25 - ca.sumsqr(position - ca.vertcat(1, 0)),
        terminal_equality=s - ca.vertcat(2, 0, 0, 0),
    )
    starts = [[0, y, 0, 0] for y in np.linspace(-1, 1, 21)]
    ours, theirs = (
        sum(solver.solve(problem, s0).status is Status.CONVERGED for s0 in starts) for solver in (Riccati(), Ipopt())
    )
    assert ours >= 16
    assert ours > 1.5 * theirs


def test_log_marks_restoration(capsys):
    Riccati(verbose=True).solve(around_a_disc(), [0, 0.1, 0, 0])
    lines = capsys.readouterr().err.splitlines()[1:]
    assert {line[4] for line in lines} == {"r", " "}
    assert [int(line[:4]) for line in lines] == list(range(1, len(lines) + 1))


def infeasible():
    """Random problems that Ipopt calls infeasible, too."""
    for seed in (89, 151, 230, 256, 288, 1586):
        problem, arguments = Drawing(seed).problem()
        yield f"statement {seed}", problem, arguments
    for seed in (*range(50, 100), 1127, 1425, 1497):  # in the last three multipliers grow without bound
        problem, demonstration, psi = random_case(seed)
        yield f"case {seed}", problem, (demonstration.s0, psi, demonstration.context)


def test_infeasible_is_said_of_what_ipopt_finds_infeasible_and_of_nothing_else():
    said, iterations = 0, np.zeros(2)
    for name, problem, arguments in infeasible():
        ours, peer = (solver.solve(problem, *arguments) for solver in (Riccati(), Ipopt()))
        assert (ours.status is Status.INFEASIBLE) == (peer.status is Status.INFEASIBLE), name
        if ours.status is Status.INFEASIBLE:
            said += 1
            iterations += ours.iterations, peer.iterations
    assert said == 16
    assert iterations[0] <= iterations[1]


@pytest.mark.parametrize("seed", [367, 399, 1425])
def test_barrier_problems_of_restoration_are_solved_in_few_steps(seed):
    """1.9, 2 and 5 times as many as Ipopt, where multipliers of violated constraints followed tau at once."""
    problem, demonstration, psi = random_case(seed)
    arguments = demonstration.s0, psi, demonstration.context
    ours, peer = (solver.solve(problem, *arguments) for solver in (Riccati(), Ipopt()))
    assert ours.status is peer.status is Status.INFEASIBLE
    assert ours.iterations <= 1.5 * peer.iterations


def test_the_violation_of_an_infeasible_convex_problem_is_nearly_the_least():
    """Twelve steps of at most 1 leave 3 of the way to 15; s_1 <= 2 and s_1 >= 3 are 1 apart."""
    s, u = ca.SX.sym("s", 2), ca.SX.sym("u", 2)
    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=12,
        dynamics=s + u,
        stage_cost=ca.sumsqr(u),
        action_bounds=(-1, 1),
        terminal_constraint=ca.vertcat(15 - s[0], s[1] - 2, 3 - s[1]),
    )
    found = Riccati().solve(problem, [0.0, 0.0])
    assert found.status is Status.INFEASIBLE
    end = found.states[-1]
    assert 4 <= max(15 - end[0], 0) + max(end[1] - 2, 0) + max(3 - end[1], 0) <= 4 / (1 - 0.1)


def test_terminal_set_out_of_reach_is_infeasible_in_any_unit():
    """|s_T - s_0| <= T |u| <= 1, so that s_T >= 1.5 cannot be."""
    for unit in (1e-3, 1.0, 1e3):
        s, u = ca.SX.sym("s"), ca.SX.sym("u")
        problem = OCP.from_expressions(
            state=s,
            action=u,
            horizon=10,
            dynamics=s + u,
            stage_cost=u**2,
            action_bounds=(-0.1 * unit, 0.1 * unit),
            terminal_constraint=1.5 * unit - s,
        )
        assert Riccati().solve(problem, [0.0]).status is Status.INFEASIBLE


@pytest.mark.parametrize("limit", [6, 15, 25])
def test_iteration_limit_counts_restoration(limit):
    found = Riccati(max_iterations=limit).solve(around_a_disc(), [0, 0.1, 0, 0])
    assert found.status is Status.ITERATION_LIMIT
    assert found.iterations == limit


def test_dynamics_alone_are_never_called_infeasible():
    """Whatever the start, s' = f(s, u) with bounded u has a solution: a cart-pole from states that follow nothing."""
    s, u, step = ca.SX.sym("s", 4), ca.SX.sym("u"), 0.04
    sine, cosine = ca.sin(s[1]), ca.cos(s[1])
    push = u + 0.1 * sine * (0.5 * s[3] ** 2 + 9.81 * cosine)
    turn = -u * cosine - 0.05 * s[3] ** 2 * cosine * sine - 1.1 * 9.81 * sine
    share = 1 + 0.1 * sine**2
    off = s[0] ** 2 + 5 * (1 + cosine) + 0.1 * ca.sumsqr(s[2:])
    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=50,
        dynamics=s + step * ca.vertcat(s[2:], push / share, turn / (0.5 * share)),
        stage_cost=step * (off + 0.01 * u**2),
        terminal_cost=50 * off,
        action_bounds=(-20, 20),
    )
    rng = np.random.default_rng(3)
    for _ in range(8):
        states = np.linspace([0, 2, 0, 0], [0, np.pi, 0, 0], 51) + 0.3 * rng.normal(size=(51, 4))
        found = Riccati().solve(problem, [0, 2, 0, 0], guess=Trajectory(states, 0.3 * rng.normal(size=(50, 1))))
        assert found.status is not Status.INFEASIBLE


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("unit_at_end", [1e-3, 1.0, 1e3])
def test_no_unit_of_a_constraint_makes_a_feasible_problem_infeasible(unit, unit_at_end):
    problem = around_a_disc(unit=unit, unit_at_end=unit_at_end)
    for s0 in ([0, 0.1, 0, 0], [0, -0.5, 0, 0], [0.2, 0.3, 0, 0], [-0.5, -0.1, 2, 0]):
        found = Riccati().solve(problem, s0)
        assert found.status in (Status.CONVERGED, Status.ACCEPTABLE), (s0, found)


@pytest.mark.parametrize("start", [1.2, 2.0, 2.2, 7.0])
def test_free_durations_that_run_to_their_bounds_are_given_up_soon(start):
    """A car drives with a force of at most 1, then brakes with 2, from rest to rest at 3.

    Nothing can be reached in the shortest durations, to which first steps lead: forces of constraints grow a million
    times over there, and waiting until they were 1e12 took 90 to 500 iterations. From 7 s steps of a hundredth and
    less led nowhere in 500. In closed form the durations are 2, 1.
    """
    problem = runpy.run_path(str(EXAMPLES / "phases.py"))["problem"]
    found = Riccati().solve(problem, [0, 0, start, start]).raise_if_failed()
    np.testing.assert_allclose(problem.static_of(found), [2, 1], rtol=1e-6)
    assert found.iterations <= 100


def test_infeasible_is_not_said_before_steps_along_the_dynamics_say_so_too():
    """Lifted steps lead to a stationary violation from this guess of a reaching arm, though Ipopt finds a plan.

    A minimum of the same problem is the right value: the conditions hold there, and it costs no more than Ipopt's.
    """
    (reference,) = (one for one in REFERENCES if one.name == "2R arm, reaching")
    case = reference.build(reference.steps)
    plan = Ipopt().solve(case.problem, case.s0, case.psi).raise_if_failed()
    sizes, rng = [np.abs(part).max(axis=0) for part in (plan.states, plan.actions)], np.random.default_rng(25)
    s0 = case.s0 + 0.1 * sizes[0] * rng.normal(size=len(case.s0))
    still = np.tile(case.s0, (len(plan.states), 1)), np.zeros_like(plan.actions)
    parts = zip(still, sizes, strict=True)
    guess = Trajectory(*(part + 0.1 * size * rng.normal(size=part.shape) for part, size in parts))
    found, peer = (solver.solve(case.problem, s0, case.psi, guess=guess) for solver in (Riccati(), Ipopt()))
    residuals = audit(case.problem, case.psi, np.zeros(0), found, found.multipliers)
    assert max(residuals.stationarity, residuals.feasibility, residuals.complementarity) <= 1e-8
    assert found.objective <= peer.raise_if_failed().objective + 1e-6


S, U = ca.SX.sym("s", 2), ca.SX.sym("u")
CONTRADICTIONS = {  # the smallest possible value of the largest violation, which rows may share
    "two rows of a stage": ({"path_equality": ca.vertcat(U - 0.3, U - 0.4)}, 0.05),
    "the same in large units": ({"path_equality": 1e6 * ca.vertcat(U - 0.3, U - 0.4)}, 5e4),
    "the same in small units": ({"path_equality": 1e-4 * ca.vertcat(U - 0.3, U - 0.4)}, 5e-6),
    "two rows of the end": ({"terminal_equality": ca.vertcat(S[1] - 1, S[1] - 2)}, 0.5),
    "stages and the end": ({"path_equality": U - 0.3, "terminal_equality": S[1] - 0.5}, 0.1),
    "fixed actions and the end": ({"action_bounds": (0.3, 0.3), "terminal_equality": S[1] - 0.5}, 0.1),
    "a state that no action moves": ({"dynamics": S + ca.vertcat(0, U), "terminal_equality": S[0]}, 1.0),
    "too few steps": ({"terminal_equality": S, "horizon": 1}, 1.0),
    "an equation without a real solution": ({"path_equality": U**2 + 1}, 1.0),
}


@pytest.mark.parametrize("name", CONTRADICTIONS)
def test_equalities_that_contradict_each_other_are_shown_to_be_infeasible(name):
    parts, least = CONTRADICTIONS[name]
    plain = {"dynamics": S + ca.vertcat(S[1], U), "stage_cost": U**2, "horizon": 3}
    found = Riccati().solve(OCP.from_expressions(state=S, action=U, **plain | parts), [1.0, 0.0])
    assert found.status is Status.INFEASIBLE
    assert found.iterations < 200
    assert found.residuals.feasibility >= least * (1 - 1e-3)


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e6])
def test_equalities_that_say_the_same_twice_are_no_contradiction(unit):
    same = unit * ca.vertcat(U - 0.3, 2 * U - 0.6)
    dynamics = S + ca.vertcat(S[1], U)
    problem = OCP.from_expressions(state=S, action=U, dynamics=dynamics, stage_cost=U**2, horizon=3, path_equality=same)
    found = Riccati(1e-10).solve(problem, [1.0, 0.0]).raise_if_failed()
    np.testing.assert_allclose(found.actions, np.full((3, 1), 0.3), rtol=0, atol=max(1e-10 / unit, 1e-13))


@pytest.mark.parametrize("unit", [1e-2, 1.0, 1e2])
def test_opposing_inequalities_that_leave_one_point_are_no_contradiction(unit):
    """Their multipliers grow without bound, as the set has no interior; the plan is right all the same."""
    opposing = unit * ca.vertcat(U - 0.3, 0.3 - U)
    dynamics = S + ca.vertcat(S[1], U)
    problem = OCP.from_expressions(
        state=S, action=U, dynamics=dynamics, stage_cost=U**2, horizon=3, path_constraint=opposing
    )
    found = Riccati().solve(problem, [1.0, 0.0])
    assert found.status.ok
    np.testing.assert_allclose(found.actions, np.full((3, 1), 0.3), rtol=0, atol=1e-7 / min(unit, 1))


def at_rest_on_its_bound(unit, cost, released, horizon=15):
    """A double integrator at rest at its bound s[0] <= unit; `released`: without that where no action moves s[0]."""
    stage_cost = cost * ((S[0] / unit - 0.2) ** 2 + 0.1 * (U / unit) ** 2 + 0.1 * S[1] * U / unit**2)
    upper = np.tile([unit, 2 * unit], (horizon + 1, 1))
    if released:
        upper[1, 0] = np.inf
    return OCP.from_expressions(
        state=S,
        action=U,
        dynamics=S + 0.1 * ca.vertcat(S[1], U),
        stage_cost=stage_cost,
        horizon=horizon,
        action_bounds=(-3 * unit, 3 * unit),
        state_bounds=(-2 * unit, upper),
    )


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("cost", [1e-2, 1.0, 1e2])
def test_a_bound_that_no_action_moves_changes_no_plan(unit, cost):
    bound, free = (
        Riccati().solve(at_rest_on_its_bound(unit, cost, released), [unit, 0.0]).raise_if_failed()
        for released in (False, True)
    )
    assert bound.status is Status.CONVERGED
    assert bound.iterations <= free.iterations + 5
    np.testing.assert_allclose(bound.actions, free.actions, rtol=0, atol=1e-6 * unit)
    assert bound.states[:, 0].max() <= unit + 1e-10


@pytest.mark.parametrize("cost", [1e-2, 1e2, 1e4])
def test_multipliers_without_bound_are_no_scale_for_the_gradient(cost):
    """In units in which rounding is near the tolerance, it may fail; but it does not call another plan converged."""
    bound, free = (Riccati().solve(at_rest_on_its_bound(1e4, cost, released), [1e4, 0.0]) for released in (False, True))
    assert bound.objective == pytest.approx(free.objective, rel=1e-6) or not bound.status.ok


def test_path_constraints_that_no_action_moves_change_no_plan():
    plain = {"dynamics": S + 0.1 * ca.vertcat(S[1], U), "stage_cost": S[0] ** 2 + U**2, "horizon": 10}
    free = OCP.from_expressions(state=S, action=U, **plain)
    held = OCP.from_expressions(state=S, action=U, path_constraint=ca.vertcat(S[0] - 1, -S[0] - 1), **plain)
    found = Riccati().solve(held, [1.0, 0.0])
    assert found.status is Status.CONVERGED
    np.testing.assert_allclose(found.actions, Riccati().solve(free, [1.0, 0.0]).actions, rtol=0, atol=1e-8)


def test_three_states_at_rest_on_a_bound_move_off_it():
    """Neither s_1 nor s_2 of a triple integrator is moved by an action."""
    s = ca.SX.sym("s", 3)
    dynamics = s + 0.1 * ca.vertcat(s[1], s[2], U)
    problem = OCP.from_expressions(
        state=s,
        action=U,
        dynamics=dynamics,
        stage_cost=s[0] ** 2 + 0.01 * U**2,
        horizon=20,
        state_bounds=(-1, 1),
        action_bounds=(-5, 5),
    )
    found, other = (solver.solve(problem, [1.0, 0.0, 0.0]) for solver in (Riccati(), Ipopt()))
    assert found.status is Status.CONVERGED
    np.testing.assert_allclose(found.actions, other.actions, rtol=0, atol=1e-4)
    assert found.objective == pytest.approx(other.objective, rel=1e-8)


@pytest.mark.parametrize("unit", [1e-7, 1e-6, 1e-5])
def test_a_plan_that_breaks_the_dynamics_is_not_acceptable_in_small_units(unit):
    """All of x is so small that any violation is below 1e-6: the guess was taken for a plan before the first step."""
    found = Riccati().solve(at_rest_on_its_bound(unit, 1e-4, False), [0.9 * unit, 0.0])
    other = Riccati().solve(at_rest_on_its_bound(1.0, 1e-4, False), [0.9, 0.0])
    assert found.status is Status.CONVERGED
    assert found.residuals.feasibility <= 1e-9 * unit
    assert found.objective == pytest.approx(other.objective, rel=1e-6)
