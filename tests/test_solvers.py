"""Ipopt, Riccati and gradient descent against closed forms, against each other, and against their own audit."""

import re
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from problems import integrator, pendulum

from kpirl_ocp import OCP, GradientDescent, Ipopt, Riccati, Status
from kpirl_ocp.errors import ProblemError, SolveError
from kpirl_ocp.ocp.conditions.audit import audit
from kpirl_ocp.types import Trajectory

INF = np.inf


def one_step(cost, path=None, dynamics=lambda s, u: s + u, **bounds):
    """minimise cost(u, s_1) = (stage, terminal) over one step, with h = path(u) and s_1 = u when s_0 = 0."""
    s, u = ca.SX.sym("s"), ca.SX.sym("u")
    stage, terminal = cost(u, s)
    f, h = dynamics(s, u), path and path(u)
    return OCP.from_expressions(
        state=s, action=u, dynamics=f, stage_cost=stage, terminal_cost=terminal, horizon=1, path_constraint=h, **bounds
    )


def to_target(target):
    """J = u^2 + (s_1 - target)^2, so dJ/du = 4 u - 2 target along the dynamics."""
    return lambda u, s: (u**2, (s - target) ** 2)


def given(case):
    return case.problem, case.demonstration.s0, case.psi, case.demonstration.context


def numbers(solution):
    """Everything a solution of a problem with given s_0 holds, as one vector."""
    records = vars(solution.trajectory) | vars(solution.multipliers)
    records["state"] = records["state"][1:]
    return np.concatenate([[solution.objective], *(value.ravel() for value in records.values())])


MASS, *AT_MASS = given(integrator())  # bounds on force and velocity, limited power
FORCE_BOUNDED = replace(MASS, path_constraint=None, state_bounds=(-INF, INF))
CASES = {"bounded": (FORCE_BOUNDED, *AT_MASS), "nonlinear": given(pendulum())}

RNG = np.random.default_rng(0)
A, B = 0.8 * np.linalg.qr(RNG.normal(size=(3, 3)))[0], RNG.normal(size=(3, 2))
Q, R, Q_END = np.diag([1.0, 0.5, 2.0]), np.array([[2.0, 0.3], [0.3, 1.0]]), np.diag([3.0, 1.0, 2.0])
X0, T = np.array([1.0, -0.7, 0.4]), 6


def riccati():
    """Objective, states, actions, costates 2 P_t x_t, and no other multipliers: the backward recursion as a vector."""
    P, gains, values = Q_END, [], []
    for _ in range(T):
        values = [P, *values]
        gains = [np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A), *gains]
        P = Q + A.T @ P @ (A - B @ gains[0])
    states = [X0]
    for gain in gains:
        states.append((A - B @ gain) @ states[-1])
    actions = [-gain @ x for gain, x in zip(gains, states[:-1], strict=True)]
    costates = [2 * P @ x for P, x in zip(values, states[1:], strict=True)]
    return np.concatenate([[X0 @ P @ X0], *states, *actions, *costates, np.zeros(T * (3 + 2))])


@pytest.mark.parametrize("solver", [Ipopt(), Riccati(), GradientDescent(600, 0.0125)], ids=str)
def test_lqr_equals_the_riccati_recursion(solver):
    s, u = ca.SX.sym("s", 3), ca.SX.sym("u", 2)
    f, cost, end = ca.DM(A) @ s + ca.DM(B) @ u, ca.bilin(Q, s, s) + ca.bilin(R, u, u), ca.bilin(Q_END, s, s)
    problem = OCP.from_expressions(state=s, action=u, dynamics=f, stage_cost=cost, terminal_cost=end, horizon=T)
    solution = solver.solve(problem, X0)
    assert solution.status is Status.CONVERGED
    np.testing.assert_allclose(numbers(solution), riccati(), rtol=0, atol=1e-13)


ONE_STEP = {  # problem, action, multipliers of dynamics, state, action, path
    "free": (one_step(to_target(2)), 1, (-2, 0, 0)),
    "upper action bound": (one_step(to_target(2), action_bounds=(-INF, 0.5)), 0.5, (-3, 0, 2)),
    "lower action bound": (one_step(to_target(-2), action_bounds=(-0.5, INF)), -0.5, (3, 0, -2)),
    "upper of two action bounds": (one_step(to_target(2), action_bounds=(-0.5, 0.5)), 0.5, (-3, 0, 2)),
    "lower of two action bounds": (one_step(to_target(-2), action_bounds=(-0.5, 0.5)), -0.5, (3, 0, -2)),
    "action fixed below": (one_step(to_target(2), action_bounds=(0.5, 0.5)), 0.5, (-3, 0, 2)),
    "action fixed above": (one_step(to_target(-2), action_bounds=(0.5, 0.5)), 0.5, (5, 0, -6)),
    "upper state bound": (one_step(to_target(2), state_bounds=(-INF, 0.5)), 0.5, (-1, 2, 0)),
    "lower state bound": (one_step(to_target(-2), state_bounds=(-0.5, 9)), -0.5, (1, -2, 0)),
    "state fixed above": (one_step(to_target(-2), state_bounds=(0.5, 0.5)), 0.5, (-1, -6, 0)),
    "initial state outside the bounds": (one_step(to_target(2), state_bounds=(0.5, 9)), 1, (-2, 0, 0)),
    "path constraint": (one_step(to_target(2), lambda u: u - 0.5), 0.5, (-3, 0, 0, 2)),
}
ROWS = [(name, solver, 1e-10) for name in ONE_STEP for solver in (Ipopt(), Riccati())]
FREE_STATES = [name for name, (problem, *_) in ONE_STEP.items() if not problem.has_state_constraints]
ROWS += [(name, GradientDescent(200, 0.1, project=True), 1e-15) for name in FREE_STATES]


@pytest.mark.parametrize(("case", "solver", "atol"), ROWS, ids=str)
def test_multipliers_have_the_documented_signs(case, solver, atol):
    problem, u, multipliers = ONE_STEP[case]
    solution = solver.solve(problem, [0.0])
    assert solution.status is Status.CONVERGED
    np.testing.assert_allclose(numbers(solution)[3:], [u, *multipliers], rtol=0, atol=4 * atol)
    assert solution.residuals.worst < 1e-10


def test_gradient_descent_contracts_the_error_of_a_quadratic_by_the_same_factor_every_step():
    problem = one_step(lambda u, s: ((u - 2) ** 2, 0.0))
    solution = GradientDescent(steps=7, step_size=0.1).solve(problem, [0.0])
    np.testing.assert_allclose(solution.actions, 2 - 2 * (1 - 2 * 0.1) ** 7, rtol=1e-15)
    assert (solution.status, solution.iterations) == (Status.STEPS_TAKEN, 7)


@pytest.mark.parametrize("case", CASES)
def test_projected_gradient_descent_equals_ipopt(case):
    one, other = GradientDescent(1000, 0.1, project=True).solve(*CASES[case]), Ipopt().solve(*CASES[case])
    assert one.status is other.status is Status.CONVERGED
    np.testing.assert_allclose(numbers(one), numbers(other), rtol=0, atol=1e-9)
    assert np.sum(other.multipliers.action > 0.1) == (3 if case == "bounded" else 0)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("steps", [1, 10, 1000])
def test_audit_measures_the_residual_that_gradient_descent_reports(case, steps):
    problem, start, psi, context = CASES[case]
    solution = GradientDescent(steps, 0.1, project=True).solve(problem, start, psi, context)
    measured = audit(problem, psi, context, solution.trajectory, solution.multipliers)
    np.testing.assert_allclose(measured.stationarity, solution.residuals.stationarity, rtol=1e-12, atol=1e-13)
    assert max(measured.feasibility, measured.complementarity, measured.sign) <= 1e-15
    assert (measured.stationarity < 1e-12) == (steps == 1000)


@pytest.mark.parametrize("case", CASES)
def test_audit_notices_a_perturbed_point(case):
    problem, start, psi, context = CASES[case]
    solution = Ipopt().solve(problem, start, psi, context)
    multipliers, actions = solution.multipliers, solution.actions + 1e-3
    assert audit(problem, psi, context, solution.trajectory, multipliers).worst < 1e-11
    moved = audit(problem, psi, context, problem.simulate(start, actions, psi), multipliers)
    assert moved.stationarity > 1e-4
    torn = audit(problem, psi, context, Trajectory(solution.states, actions), multipliers)
    violated = {"bounded": 1e-3, "nonlinear": 1e-3 * 0.05 / (1.0 * 0.5**2)}  # a bound; the dynamics, dt / (m l^2)
    np.testing.assert_allclose(torn.feasibility, violated[case], rtol=0, atol=1e-10)


@pytest.mark.parametrize("solver", [Ipopt(), Riccati()], ids=str)
def test_constraints_hold_and_their_multipliers_are_complementary(solver):
    solution = solver.solve(MASS, *AT_MASS).raise_if_failed()
    multipliers = solution.multipliers
    path = np.array(MASS.path(solution.states.T, solution.actions.T, *AT_MASS[1:])).T
    for slack, multiplier, active in [
        (1.0 - solution.actions, multipliers.action, 2),
        (0.6 - solution.states[1:, 1:], multipliers.state[1:, 1:], 4),
        (-path, multipliers.path, 1),
    ]:
        assert slack.min() >= 0
        assert multiplier.min() >= -1e-10  # net of both sides, each at most 1e-11 / slack where inactive
        np.testing.assert_allclose(multiplier * slack, 0, rtol=0, atol=2e-11)
        assert np.sum(multiplier > 0.1) == np.sum(slack < 1e-9) == active
    assert multipliers.path.min() >= 0
    np.testing.assert_array_equal(multipliers.state[:, 0], 0)  # the position has no bounds
    np.testing.assert_array_equal(multipliers.state[0], 0)  # s_0 is given
    pulled = audit(MASS, *AT_MASS[1:], solution.trajectory, replace(multipliers, path=multipliers.path - 3))
    np.testing.assert_allclose([pulled.sign, pulled.complementarity], [3, 3 * -path.min()], rtol=1e-9)


@pytest.mark.parametrize("solver", [Ipopt(), Riccati()], ids=str)
def test_warm_start_takes_fewer_iterations_to_the_same_solution(solver):
    before, shifted = solver.solve(MASS, *AT_MASS), ([0.01, 0.0], *AT_MASS[1:])
    warm, cold = solver.solve(MASS, *shifted, guess=before), solver.solve(MASS, *shifted)
    assert warm.status is cold.status is Status.CONVERGED
    assert warm.iterations < cold.iterations
    assert solver.solve(MASS, *AT_MASS, guess=before).iterations <= 2 < before.iterations
    np.testing.assert_allclose(warm.actions, cold.actions, rtol=0, atol=1e-9)


UP = (-INF, 1)
AT_ONE = {"action": {"action_bounds": UP}, "state": {"state_bounds": UP}, "path": {"path": lambda u: u - 1}}


@pytest.mark.parametrize(("tau", "scale"), [(1e-1, 1), (1e-3, 1), (1e-5, 1), (1e-1, 1e3)])
@pytest.mark.parametrize("kind", AT_ONE)
@pytest.mark.parametrize("solver", [Ipopt(), Riccati()], ids=str)
def test_barrier_solution_has_multiplier_times_slack_equal_to_tau(solver, kind, tau, scale):
    solution = solver.with_barrier(tau).solve(one_step(lambda u, s: (scale * (u - 2) ** 2, 0), **AT_ONE[kind]), [0.0])
    u = (3 - np.sqrt(1 + 2 * tau / scale)) / 2  # 2 scale (u - 2) + tau / (1 - u) = 0
    multiplier, slack = getattr(solution.multipliers, kind)[-1:], 1 - solution.actions
    assert (solution.status, solution.barrier) == (Status.CONVERGED, tau)
    np.testing.assert_allclose(solution.actions, [[u]], rtol=0, atol=1e-10)
    np.testing.assert_allclose(multiplier * slack, [[tau]], rtol=0, atol=1e-10)
    assert solution.residuals.worst < 1e-10 / (1 - u)


@pytest.mark.parametrize("solver", [Ipopt(), Riccati()], ids=str)
def test_barrier_pushes_from_both_sides(solver):
    tau = 1e-3
    solution = solver.with_barrier(tau).solve(MASS, *AT_MASS).raise_if_failed()
    u, multipliers = solution.actions, solution.multipliers
    path = np.array(MASS.path(solution.states.T, u.T, *AT_MASS[1:])).T
    np.testing.assert_allclose(multipliers.action, tau / (1 - u) - tau / (u + 1), rtol=1e-7)
    np.testing.assert_allclose(multipliers.path * -path, tau, rtol=1e-7)
    assert solution.residuals.worst < 1e-9


APART = one_step(to_target(2), action_bounds=(-1, 1), state_bounds=(2, 9))
ROOT = one_step(lambda u, s: (-ca.sqrt(u - 0.1), 0), action_bounds=(-1, 1))
IMAGINARY = one_step(to_target(2), dynamics=lambda s, u: ca.sqrt(-1 - u**2))
INFINITE_CURVATURE = one_step(lambda u, s: (u**1.5, (s - 2) ** 2))
OUTCOMES = {  # solver, problem, status
    "descent arrives": (GradientDescent(100, 0.2), one_step(to_target(2)), Status.CONVERGED),
    "descent falls short": (GradientDescent(2, 0.1), one_step(to_target(2)), Status.STEPS_TAKEN),
    "steps too long": (GradientDescent(9, 0.6), one_step(to_target(2)), Status.DIVERGED),
    "cost without a minimum": (Ipopt(), one_step(lambda u, s: (u, s)), Status.DIVERGED),
    "one iteration": (Ipopt(max_iterations=1), ONE_STEP["upper action bound"][0], Status.ITERATION_LIMIT),
    "bounds that exclude each other": (Ipopt(), APART, Status.INFEASIBLE),
    "Ipopt meets NaN": (Ipopt(), IMAGINARY, Status.NOT_FINITE),
    "Riccati: cost without a minimum": (Riccati(), one_step(lambda u, s: (u, s)), Status.DIVERGED),
    "Riccati: one iteration": (Riccati(max_iterations=1), ONE_STEP["upper action bound"][0], Status.ITERATION_LIMIT),
    "Riccati: bounds that exclude each other": (Riccati(), APART, Status.INFEASIBLE),
    "Riccati meets NaN": (Riccati(), IMAGINARY, Status.NOT_FINITE),
    "Riccati meets infinity in second derivatives only": (Riccati(), INFINITE_CURVATURE, Status.NOT_FINITE),
    "descent meets NaN": (GradientDescent(), IMAGINARY, Status.NOT_FINITE),
    "steps too long, until overflow": (GradientDescent(5000, 0.6), one_step(to_target(2)), Status.DIVERGED),
    "projected descent meets NaN": (GradientDescent(project=True), ROOT, Status.NOT_FINITE),
}


@pytest.mark.parametrize("case", OUTCOMES)
def test_the_status_says_how_it_ended_and_becomes_an_exception_on_request(case):
    solver, problem, status = OUTCOMES[case]
    solution = solver.solve(problem, [0.0])
    assert solution.status is status
    if status in (Status.CONVERGED, Status.STEPS_TAKEN):
        assert solution.raise_if_failed() is solution
    else:
        with pytest.raises(SolveError, match=f"^{status.name}: {re.escape(status.value)}"):
            solution.raise_if_failed()


REFUSED = [("upper state bound", True, "state bounds"), ("path constraint", True, "path constraints")]
REFUSED += [("lower action bound", False, "project=True")]


@pytest.mark.parametrize(("case", "project", "message"), REFUSED, ids=str)
def test_gradient_descent_refuses_what_it_would_ignore(case, project, message):
    solver, problem = GradientDescent(project=project), ONE_STEP[case][0]
    with pytest.raises(ProblemError, match=message):
        solver.solve(problem, [0.0])
    assert solver.solve(problem.unconstrained(), [0.0]).status is Status.STEPS_TAKEN


@pytest.mark.parametrize("solver", [Ipopt(), Riccati(), GradientDescent(50, 0.1, project=True)], ids=str)
def test_solving_twice_gives_identical_bits_also_after_another_problem_and_when_built_anew(solver):
    first = solver.solve(*CASES["bounded"])
    solver.solve(FORCE_BOUNDED, [0.3, -0.2], *AT_MASS[1:])
    rebuilt = (replace(FORCE_BOUNDED), *AT_MASS)
    for again in (solver.solve(*CASES["bounded"]), replace(solver).solve(*rebuilt)):
        assert numbers(first).tobytes() == numbers(again).tobytes()
