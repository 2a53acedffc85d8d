"""Solvers that run in CasADi: statuses of infeasible and unbounded problems, threads, and an end in any case."""

import gc
import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from problems import integrator
from statements import D, S, T, U, state

from kpirl_ocp import OCP, SQP, Fatrop, GradientDescent, Ipopt, Riccati, Status, Trajectory
from kpirl_ocp.ocp.problem.guards import dense, one_at_a_time

SOLVERS = [Ipopt(), Fatrop(), SQP()]
LINEAR = ca.vertcat(S[0] + 0.1 * S[1], S[1] + 0.1 * U)
INFEASIBLE = {
    "a goal out of reach": {"terminal_equality": S - ca.DM([5, 0]), "action_bounds": (-1, 1)},
    "bounds out of reach": {"state_bounds": ([2, -0.6], [3, 0.6])},
    "rows that contradict each other": {"path_constraint": ca.vertcat(U - 1, 2 - U)},
    "an empty set": {"path_constraint": ca.sumsqr(S) + 1},
    "an equality without a root": {"terminal_equality": S[0] ** 2 + 1},
    "a start that violates a row": {"path_constraint": S[0] + 1},
}


AT_THE_END = {"stage": D, "schedule": np.arange(T + 1)[:, None] == T}
MOST_VIOLATED = {
    "path_constraint[1] at step 0": {"path_constraint": ca.vertcat(U - 9, S[1] + 0.7)},
    "terminal_constraint[1] at the end": {
        "path_constraint": S[0] - 9,
        "terminal_constraint": ca.vertcat(S[0] - 9, S[0] ** 2 + 1),
    },
    "path_constraint[2] at the end": {
        "path_constraint": ca.vertcat(U - 9, S[1] - 9, D * (1 + S[0] ** 2)),
        **AT_THE_END,
    },
    "terminal_equality[1] at the end": {"terminal_equality": ca.vertcat(S[1], S[0] ** 2 + 1)},
}


@pytest.mark.parametrize("solver", [Riccati(), Ipopt(), Fatrop()], ids=lambda solver: type(solver).__name__)
@pytest.mark.parametrize("row", MOST_VIOLATED)
def test_an_infeasible_solution_says_which_constraint_is_violated_most(row, solver):
    found = solver.solve(state(dynamics=LINEAR, stage_cost=U**2, **MOST_VIOLATED[row]), [0.0, 0.3])
    assert found.status is Status.INFEASIBLE
    said, size = str(found).rstrip(")").split("; ")[-1].split(" is violated most, by ")
    assert said == row
    assert float(size) == pytest.approx(1, rel=1e-2)


@pytest.mark.parametrize("solver", SOLVERS, ids=str)
@pytest.mark.parametrize("name", INFEASIBLE)
def test_a_problem_without_a_feasible_point_is_called_infeasible(name, solver):
    problem = state(dynamics=LINEAR, stage_cost=U**2, **INFEASIBLE[name])
    found = solver.solve(problem, [0.0, 0.3])
    assert found.status is Status.INFEASIBLE
    assert found.residuals.feasibility > 0.05


def rate_limited():
    """A mass whose force, the third state, changes by at most 0.3 a step."""
    x, change = ca.SX.sym("x", 3), ca.SX.sym("du")
    force = x[2] + change
    return OCP.from_expressions(
        state=x,
        action=change,
        dynamics=ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * force, force),
        stage_cost=(x[0] - 1) ** 2 + 0.1 * x[1] ** 2 + 0.01 * force**2,
        terminal_cost=10 * (x[0] - 1) ** 2,
        action_bounds=(-0.3, 0.3),
        state_bounds=([-np.inf, -np.inf, -1], [np.inf, np.inf, 1]),
        horizon=15,
    )


@pytest.mark.parametrize("solver", [Fatrop(), SQP()], ids=str)
def test_a_rate_limited_quadratic_program_is_solved(solver):
    found, expected = (method.solve(rate_limited(), [0.0, 0.0, 0.0]) for method in (solver, Ipopt()))
    assert found.status is Status.CONVERGED
    np.testing.assert_allclose(found.actions, expected.actions, rtol=0, atol=1e-5)


@pytest.mark.parametrize("solver", SOLVERS, ids=str)
def test_one_problem_is_solved_by_several_threads_at_once(solver):
    case = integrator()
    problems = [case.problem, replace(case.problem, action_bounds=(-0.9, 0.9))]  # they share their functions
    arguments = case.demonstration.s0, case.psi, case.demonstration.context

    def solve(number):
        return solver.solve(problems[number % 2], *arguments).objective

    alone = [solve(0), solve(1)]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(solve, range(20))) == alone * 10


@pytest.mark.parametrize("tau", [1e-2, 1e-4, 1e-6])
def test_ipopt_is_converged_only_where_its_tolerance_is_met(tau):
    case = integrator()
    arguments = case.problem, case.demonstration.s0, case.psi, case.demonstration.context
    found = Ipopt(barrier=tau).solve(*arguments)
    assert found.status is Status.CONVERGED
    assert found.residuals.worst <= 1e-10
    assert Ipopt(tolerance=1e-16).solve(*arguments).status is not Status.CONVERGED


NOWHERE = {  # where a derivative is NaN or infinite on the way, Fatrop alone would not end
    "a pole at the start": (1 / U + U**2, 0.0, Status.NOT_FINITE),
    "a root of negative numbers with bounds": (ca.sqrt(U - 2) + U**2, 0.0, Status.NOT_FINITE),
    "a root that ends within the bounds": (ca.sqrt(U - 0.3) + U**2, 0.4, Status.FAILED),
}


@pytest.mark.parametrize("name", NOWHERE)
def test_fatrop_ends_within_its_time_limit(name):
    cost, action, status = NOWHERE[name]
    problem = state(stage_cost=cost, action_bounds=(-1, 1))
    guess = Trajectory(np.full((13, 2), 0.5), np.full((12, 1), action))
    assert Fatrop().solve(state(), [0.0, 0.0]).status is Status.CONVERGED  # its process is there
    begun = time.monotonic()
    assert Fatrop(time_limit=1.0).solve(problem, [0.5, 0.5], guess=guess).status is status
    assert time.monotonic() - begun < 30  # it is ended, not late
    assert Fatrop().solve(state(), [0.0, 0.0]).status is Status.CONVERGED  # and begins again


@pytest.mark.parametrize("solver", [Riccati(), Ipopt(), Fatrop(), SQP(), GradientDescent(3, 0.1)], ids=str)
def test_an_infinite_cost_with_a_zero_gradient_is_not_finite(solver):
    solution = solver.solve(state(stage_cost=ca.sumsqr(S) / 0 + U**2), [0.5, 0.5])
    assert solution.status is Status.NOT_FINITE
    assert not np.isfinite(solution.objective)


def test_fatrop_answers_with_a_status_where_the_dynamics_leave_their_domain():
    problem = state(dynamics=S + ca.sqrt(U), stage_cost=ca.sumsqr(S) + U)
    guess = Trajectory(np.full((13, 2), 0.5), np.full((12, 1), 0.1))
    assert not Fatrop(time_limit=3.0).solve(problem, [0.5, 0.5], guess=guess).status.ok


def test_fatrop_in_this_process_takes_the_same_steps():
    here, there = (Fatrop(time_limit=limit).solve(state(action_bounds=(-1, 1)), [0.0, 0.0]) for limit in (None, 60.0))
    np.testing.assert_array_equal(here.states, there.states)
    assert here.iterations == there.iterations


def test_fatrop_tells_problems_apart_while_others_come_and_go():
    kept = state(stage_cost=(S[0] - 1) ** 2 + 0.05 * U**2)
    expected = Fatrop().solve(kept, [0.0, 0.0]).objective
    for target in range(3):  # none of these outlives its solve
        solver, here = Fatrop(), Fatrop(time_limit=None)
        problem = state(stage_cost=(S[0] - target) ** 2 + 0.05 * U**2)
        assert solver.solve(problem, [0.0, 0.0]).objective == here.solve(problem, [0.0, 0.0]).objective
        del problem
        gc.collect()
    assert Fatrop().solve(kept, [0.0, 0.0]).objective == expected


@pytest.mark.parametrize("solver", [*SOLVERS, Riccati(compile=False)], ids=str)
def test_ctrl_c_ends_a_solve_and_is_no_status(solver):
    """Solves of a rugged cost, one after another; the signal comes in the middle of one of them."""
    cost = ca.sin(30 * S[0]) ** 2 + 0.001 * U**2
    problem = state(dynamics=LINEAR, stage_cost=cost, horizon=200, action_bounds=(-3, 3))
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        solve_for(60, solver, problem)


@pytest.mark.parametrize("cause", [KeyboardInterrupt(), ValueError()], ids=repr)
def test_ctrl_c_that_comes_while_casadi_hands_over_numbers_is_ctrl_c(cause):
    """DM.__array__ makes a SystemError of any exception; others stay one."""

    @one_at_a_time
    def convert():
        raise SystemError("<function DM.__array__> returned a result with an exception set") from cause

    with pytest.raises(KeyboardInterrupt if isinstance(cause, KeyboardInterrupt) else SystemError):
        convert()


def test_ctrl_c_that_casadi_drops_while_it_converts_numbers_is_ctrl_c():
    """DM.full gives None where an exception came meanwhile."""

    class Dropped:
        def full(self):
            return None

    with pytest.raises(KeyboardInterrupt):
        dense(Dropped())
    np.testing.assert_array_equal(dense(ca.DM([[1, 0], [0, 2]])), [[1, 0], [0, 2]])


def solve_for(seconds, solver, problem):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        solver.solve(problem, [0.5, 0.0])
