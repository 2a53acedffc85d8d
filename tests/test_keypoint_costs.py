"""Keypoint problems: the costs against their formula, the time bases against their definition."""

import itertools
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp import Ipopt, Riccati
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.models import (
    RBF,
    Default,
    KeypointCost,
    Robot,
    TimeDependent,
    Weighted,
    keypoint_ocp,
    keypoint_state,
)
from kpirl_ocp.ocp.models.keypoint_costs import PARAMETRISATIONS
from kpirl_ocp.ocp.problem.trajectory_cost import GROUP, coefficients_of, stage_costs

T = 5
ROBOT = Robot.from_example_data("ur5", {"tool0": [[0, 0, 0.1], [0.05, 0, 0.2]]})
N_Z, N_Q = 6, 6
PER_STEP = (0.3, 0.1, 1.2, 0.7, 2.0)
BASES = (Weighted(), TimeDependent(), RBF(3), Default())
MAPS = {  # the map g from numbers to weights, and weights that it can represent
    "identity": (lambda x: x, [-2.0, 0.0, 1e-3, 1.0, 50.0]),
    "softplus": (lambda x: np.logaddexp(0, x), [1e-6, 1e-3, 1.0, 50.0]),
    "exp": (np.exp, [1e-6, 1e-3, 1.0, 50.0]),
    "square": (np.square, [0.0, 1e-3, 1.0, 50.0]),
}


def test_weighted_basis_is_ones():
    np.testing.assert_array_equal(Weighted().matrix(T), np.ones((T, 1)))


def test_time_dependent_basis_is_the_identity():
    np.testing.assert_array_equal(TimeDependent().matrix(T), np.eye(T))


def test_default_basis_is_empty():
    assert Default().matrix(T).shape == (T, 0)


def test_rbf_kernels_are_uniform_peak_at_one_and_neighbours_cross_at_one_half():
    basis = RBF(4).matrix(13)  # centres at t = 1, 5, 9, 13: crossings at 3, 7, 11
    np.testing.assert_array_equal(np.argmax(basis, axis=0) + 1, [1, 5, 9, 13])
    np.testing.assert_array_equal(np.max(basis, axis=0), np.ones(4))
    for j, t in enumerate((3, 7, 11)):
        np.testing.assert_allclose(basis[t - 1, j : j + 2], [0.5, 0.5], rtol=1e-15)


def test_rbf_kernels_are_gaussians_also_between_the_steps():
    basis = RBF(3).matrix(6)  # centres at t = 1, 3.5, 6: log kernel = -log 2 (distance / 1.25)^2
    expected = -np.log(2) * ((np.arange(1, 7)[:, None] - [1, 3.5, 6]) / 1.25) ** 2
    np.testing.assert_allclose(np.log(basis), expected, rtol=1e-13)


def formula(cost, psi, z, u, goal):
    """C = sum_{t=1}^T sum_i W[t, i] (z_t[i] - goal[i])^2 + sum_{t=0}^{T-1} rho_t |u_t|^2, W = B g(Psi), in loops."""
    g, basis = MAPS[cost.positivity][0], cost.basis.matrix(T)
    n_weights = basis.shape[1] * N_Z
    Psi = g(psi[:n_weights]).reshape(-1, N_Z)
    rho = np.broadcast_to(g(psi[n_weights:]) if cost.learn_effort else cost.effort, T)
    total = 0.0
    for t in range(1, T + 1):
        for i in range(N_Z):
            weight = 1.0 if isinstance(cost.basis, Default) else basis[t - 1] @ Psi[:, i]
            total += weight * (z[t, i] - goal[i]) ** 2
    return total + sum(rho[t] * u[t] @ u[t] for t in range(T))


COSTS = list(itertools.product(BASES, (0.7, PER_STEP), (False, True), MAPS))


@pytest.mark.parametrize(("basis", "effort", "learn_effort", "positivity"), COSTS, ids=str)
def test_objective_equals_the_formula_in_numpy(basis, effort, learn_effort, positivity):
    cost, rng = KeypointCost(basis, effort, learn_effort, positivity), np.random.default_rng(1)
    problem = keypoint_ocp(ROBOT, cost, T)
    states, actions = rng.normal(size=(T + 1, N_Z + 2 * N_Q)), rng.normal(size=(T, N_Q))
    psi, goal = rng.normal(size=problem.n_parameters), rng.normal(size=N_Z)
    n_efforts = np.size(effort) if learn_effort else 0
    assert len(psi) == cost.n_parameters(T, N_Z) == basis.matrix(T).shape[1] * N_Z + n_efforts
    expected = formula(cost, psi, states[:, :N_Z], actions, goal)
    scale = formula(cost, np.abs(psi), states[:, :N_Z], actions, goal)  # free signs may cancel
    np.testing.assert_allclose(
        float(problem.cost(states.T, actions.T, psi, goal)), expected, rtol=0, atol=1e-14 * scale
    )


def test_objective_of_a_solution_equals_the_formula_in_numpy():
    cost = KeypointCost(RBF(3), effort=0.1)
    problem, psi = keypoint_ocp(ROBOT, cost, T), np.linspace(0.5, 2, 3 * N_Z)
    theta = np.array([0.2, -1.0, 1.1, -0.4, 0.6, 0.1])
    goal = ROBOT.locate(theta + 0.1).ravel()
    solution = Ipopt().solve(problem, keypoint_state(ROBOT, theta), psi, goal).raise_if_failed()
    expected = formula(cost, psi, solution.states[:, :N_Z], solution.actions, goal)
    np.testing.assert_allclose(solution.objective, expected, rtol=1e-12)


@pytest.mark.parametrize("beyond", [0.0, 0.3], ids=["goal within the joint limits", "goal beyond them"])
def test_iiwa_reaches_a_goal_within_its_joint_limits(beyond):
    robot, theta = Robot.iiwa(), np.array([0.3, 0.5, -0.2, -1.2, 0.1, 0.9, 0.0])  # [rad]
    lower, upper = robot.joint_limits
    reach = np.array([0.5, -0.3, 0.2, 0.4, -0.2, 0.3, 0.1]) if not beyond else np.eye(7)[1] * (upper - theta + beyond)
    goal = robot.locate(theta + reach).ravel()
    problem = keypoint_ocp(robot, KeypointCost(Default(), effort=1e-4), 8)
    solution = Ipopt().solve(problem, keypoint_state(robot, theta), context=goal).raise_if_failed()
    joints, pushes = solution.states[1:, 9:16], solution.multipliers.state[1:, 9:16]
    assert (lower <= joints).all()
    assert (joints <= upper).all()
    distance = np.abs(solution.states[-1, :9] - goal).max()  # [m]
    assert distance < 1e-9 if not beyond else (np.abs(pushes) > 1e-5).any()
    np.testing.assert_allclose(np.maximum(pushes, 0) * (upper - joints), 0, rtol=0, atol=1e-10)
    np.testing.assert_allclose(np.minimum(pushes, 0) * (joints - lower), 0, rtol=0, atol=1e-10)


@pytest.mark.parametrize("positivity", MAPS)
@pytest.mark.parametrize("effort", [0.5, PER_STEP], ids=str)
def test_equal_weights_make_weighted_time_dependent_and_default_agree(positivity, effort):
    rng, values = np.random.default_rng(2), []
    states, actions, goal = rng.normal(size=(T + 1, N_Z + 2 * N_Q)), rng.normal(size=(T, N_Q)), rng.normal(size=N_Z)
    for basis in (Weighted(), TimeDependent(), Default()):
        cost = KeypointCost(basis, effort, positivity=positivity)
        problem = keypoint_ocp(ROBOT, cost, T)
        values.append(float(problem.cost(states.T, actions.T, cost.initial(T, N_Z), goal)))
    np.testing.assert_allclose(values, values[-1], rtol=1e-14)


@pytest.mark.parametrize(("positivity", "weight"), [(name, w) for name in MAPS for w in MAPS[name][1]])
def test_initial_inverts_the_parametrisation(positivity, weight):
    cost = KeypointCost(TimeDependent(), max(weight, 1e-3), learn_effort=True, positivity=positivity)
    W, rho = cost.weights(cost.initial(T, N_Z, weight), T, N_Z)
    np.testing.assert_allclose(W, np.full((T, N_Z), weight), rtol=1e-14)
    np.testing.assert_allclose(rho, np.full(T, max(weight, 1e-3)), rtol=1e-14)


def test_initial_takes_one_weight_per_kernel_and_coordinate():
    wanted, cost = np.arange(1.0, 1 + 3 * N_Z).reshape(3, N_Z), KeypointCost(RBF(3), positivity="softplus")
    W, _ = cost.weights(cost.initial(T, N_Z, wanted), T, N_Z)
    np.testing.assert_allclose(W, RBF(3).matrix(T) @ wanted, rtol=1e-14)


def test_initial_starts_a_learned_effort_at_the_given_one():
    cost = KeypointCost(Default(), PER_STEP, learn_effort=True, positivity="exp")
    np.testing.assert_allclose(cost.weights(cost.initial(T, N_Z), T, N_Z)[1], cost.effort, rtol=1e-14)


REMAINING = {
    "weights and efforts per step": (KeypointCost(TimeDependent(), PER_STEP), None),
    "the same, learned": (KeypointCost(TimeDependent(), PER_STEP, learn_effort=True, positivity="softplus"), None),
    "kernels": (KeypointCost(RBF(3), 0.3), None),
    "no weights": (KeypointCost(Default(), 0.3), None),
    "a goal for each step": (KeypointCost(TimeDependent(), 0.3), np.linspace(-0.1, 0, T)[:, None] * np.ones(N_Z)),
}


@pytest.mark.parametrize("name", REMAINING)
def test_with_the_preview_planning_again_in_every_period_keeps_to_the_first_plan(name):
    """Bellman: the rest of an optimal plan is optimal for the remaining cost."""
    cost, goals = REMAINING[name]
    problem, solver = keypoint_ocp(ROBOT, cost, T, goals=goals), Riccati(1e-11)
    s0 = keypoint_state(ROBOT, [0.2, -1.0, 1.1, -0.4, 0.6, 0.1])
    goal, psi = s0[:N_Z] + 0.1, cost.initial(T, N_Z, 3.0)
    preview = cost.preview(T) if goals is None else np.hstack([cost.preview(T), np.zeros((T - 1, N_Z))])
    rows = np.vstack([problem.schedule, preview])
    plan = solver.solve(problem, s0, psi, goal)
    scale = np.abs(plan.actions).max()
    assert scale > 0.01
    for k in range(1, T):
        remaining = replace(problem, schedule=rows[k : k + T + 1])
        again = solver.solve(remaining, plan.states[k], psi, goal)
        rest = np.vstack([plan.actions[k:], np.zeros((k, N_Q))])
        np.testing.assert_allclose(again.actions, rest, rtol=0, atol=1e-7 * scale)


def test_softplus_represents_a_weight_of_a_thousand():
    cost = KeypointCost(Weighted(), positivity="softplus")
    W, _ = cost.weights(cost.initial(T, N_Z, 1000.0), T, N_Z)
    np.testing.assert_allclose(W, np.full((T, N_Z), 1000.0), rtol=1e-14)


@pytest.mark.parametrize("basis", BASES[:3], ids=str)
@pytest.mark.parametrize("positivity", ["softplus", "exp", "square"])
def test_weights_are_never_negative_whatever_psi(basis, positivity):
    cost = KeypointCost(basis, 1.0, learn_effort=True, positivity=positivity)
    for size in (1e-3, 1.0, 30.0, 700.0):
        psi = np.random.default_rng(3).uniform(-size, size, cost.n_parameters(T, N_Z))
        W, rho = cost.weights(psi, T, N_Z)
        assert psi.min() < 0
        assert W.min() >= 0
        assert rho.min() >= 0


def test_identity_lets_weights_be_negative():
    W, _ = KeypointCost(Weighted()).weights(np.full(N_Z, -2.0), T, N_Z)
    np.testing.assert_array_equal(W, np.full((T, N_Z), -2.0))


ERRORS = {
    "unknown positivity lists the names": (
        lambda: KeypointCost(Weighted(), positivity="relu"),
        "one of identity, softplus, exp, square; got 'relu'",
    ),
    "negative effort": (lambda: KeypointCost(Weighted(), effort=-0.1), r"effort must be a number >= 0.*-0\.1"),
    "one negative effort": (lambda: KeypointCost(Weighted(), effort=(1.0, -1.0)), "effort must be a number >= 0"),
    "NaN effort": (lambda: KeypointCost(Weighted(), effort=np.nan), "effort must be a number >= 0"),
    "effort per step and joint": (lambda: KeypointCost(Weighted(), effort=((1.0,),)), "effort must be a number"),
    "wrong number of efforts": (
        lambda: keypoint_ocp(ROBOT, KeypointCost(Weighted(), (1.0, 2.0)), T),
        r"one per step \(5,\), got 2",
    ),
    "more kernels than steps": (
        lambda: keypoint_ocp(ROBOT, KeypointCost(RBF(6)), T),
        "2 <= kernels <= horizon = 5, got 6",
    ),
    "one kernel": (lambda: KeypointCost(RBF(1)).schedule(T), "2 <= kernels"),
    "zero weight as exp": (lambda: KeypointCost(Weighted(), positivity="exp").initial(T, 2, 0), "cannot represent"),
    "zero weight as softplus": (
        lambda: KeypointCost(Weighted(), positivity="softplus").initial(T, 2, [1, 0]),
        "'softplus' cannot represent weights of 0: choose positive ones",
    ),
    "negative weight as square": (
        lambda: KeypointCost(Weighted(), positivity="square").initial(T, 2, -1),
        "'square' cannot represent weights of -1",
    ),
    "zero learned effort as exp": (
        lambda: KeypointCost(Default(), 0.0, learn_effort=True, positivity="exp").initial(T, 2),
        "'exp' cannot represent",
    ),
}


@pytest.mark.parametrize("case", ERRORS)
def test_an_impossible_cost_is_refused_with_what_was_expected(case):
    call, message = ERRORS[case]
    with pytest.raises(ProblemError, match=message):
        call()


def test_keypoint_problem_moves_by_displacements_and_sees_keypoints_in_its_unit():
    robot, theta = Robot.from_example_data("ur5"), np.array([0.2, -1.0, 1.1, -0.4, 0.6, 0.1])
    problem = keypoint_ocp(robot, KeypointCost(Default()), 3, unit=0.01)
    steps = np.random.default_rng(0).normal(0, 0.1, (3, 6))
    s0 = keypoint_state(robot, theta, unit=0.01)
    states = problem.simulate(s0, steps).states
    positions = theta + np.vstack([np.zeros(6), np.cumsum(steps, axis=0)])
    keypoints = np.array([robot.locate(q).ravel() for q in positions]) / 0.01  # [cm]
    np.testing.assert_allclose(states, np.hstack([keypoints, positions, np.zeros((4, 6))]), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(np.array(problem.observe(states.T)).T, states[:, :9])


def test_keypoint_problem_is_bounded_by_joint_limits_and_largest_displacement_on_request():
    problem = keypoint_ocp(ROBOT, KeypointCost(Default()), 3, max_displacement=0.1)
    np.testing.assert_array_equal(np.array(problem.action_bounds)[:, 0], [[-0.1] * N_Q, [0.1] * N_Q])
    np.testing.assert_array_equal(np.array(problem.state_bounds)[:, -1, N_Z : N_Z + N_Q], ROBOT.joint_limits)
    free = keypoint_ocp(ROBOT, KeypointCost(Default()), 3, joint_limits=False)
    assert not free.has_action_bounds
    assert not free.has_state_constraints


def test_keypoint_problem_refuses_meaningless_numbers():
    robot = Robot.from_example_data("ur5")
    for change in ({"unit": 0.0}, {"max_displacement": -1.0}, {"unit": np.nan}):
        with pytest.raises(ProblemError, match="must be positive"):
            keypoint_ocp(robot, KeypointCost(Default()), 3, **change)
    for theta in (np.zeros(7), np.full(6, np.nan)):
        with pytest.raises(ProblemError, match="theta must be 6 finite joint positions"):
            keypoint_state(robot, theta)


def test_every_parametrisation_has_the_derivatives_of_its_formula():
    x = ca.SX.sym("x")
    formulas = {
        "softplus": (lambda v: 1 / (1 + np.exp(-v)), lambda v: 1 / (2 + np.exp(v) + np.exp(-v))),
        "exp": (np.exp, np.exp),
        "square": (lambda v: 2 * v, lambda v: 2.0),
        "identity": (lambda v: 1.0, lambda v: 0.0),
    }
    for name, (first, second) in formulas.items():
        slope = ca.gradient(PARAMETRISATIONS[name].forward(x), x)
        derivatives = ca.Function("derivatives", [x], [slope, ca.gradient(slope, x)])
        for v in (-30.0, -1.0, 0.0, 0.5, 30.0):
            np.testing.assert_allclose(np.array(derivatives(v)).ravel(), [first(v), second(v)], rtol=1e-14)


def test_goals_of_the_steps_move_the_goal_of_each_step():
    cost, rng = KeypointCost(TimeDependent(), effort=0.3), np.random.default_rng(0)
    goals, goal, psi = rng.normal(size=(T, N_Z)), rng.normal(size=N_Z), rng.uniform(1, 2, T * N_Z)
    problem, plain = keypoint_ocp(ROBOT, cost, T, goals=goals), keypoint_ocp(ROBOT, cost, T)
    s0, actions = keypoint_state(ROBOT, np.zeros(ROBOT.n_joints)), rng.normal(0, 0.1, (T, ROBOT.n_joints))
    states = problem.simulate(s0, actions, psi).states
    point = states.T, actions.T, psi, goal
    weighted = psi.reshape(T, N_Z) * (states[1:, :N_Z] - goal - goals) ** 2
    assert float(problem.cost(*point)) == pytest.approx(weighted.sum() + 0.3 * (actions**2).sum(), rel=1e-13)
    without = keypoint_ocp(ROBOT, cost, T, goals=np.zeros((T, N_Z)))
    assert float(without.cost(*point)) == pytest.approx(float(plain.cost(*point)), rel=1e-14)
    for wrong in (goals[1:], goals * np.nan):
        with pytest.raises(ProblemError, match="goals must be"):
            keypoint_ocp(ROBOT, cost, T, goals=wrong)


@pytest.mark.parametrize("basis", BASES, ids=str)
def test_coefficients_of_all_stages_are_those_of_each_stage(basis):
    horizon = 2 * GROUP + 3  # several functions of so many stages, and a shorter one
    cost = KeypointCost(basis, effort=tuple(np.linspace(0.1, 1, horizon)), learn_effort=True, positivity="softplus")
    problem = keypoint_ocp(ROBOT, cost, horizon)
    rng = np.random.default_rng(0)
    psi, goal = rng.normal(size=problem.n_parameters), rng.normal(size=N_Z)
    by_stage, last = (np.array(x) for x in coefficients_of(problem)(psi, goal))
    running, final = (cost.coefficients for cost in stage_costs(problem))
    expected = [np.array(running(psi, goal, d)).ravel() for d in problem.schedule[:-1]]
    np.testing.assert_allclose(by_stage.reshape(horizon, -1), expected, rtol=1e-15, atol=0)
    np.testing.assert_allclose(last, final(psi, goal, problem.schedule[-1]), rtol=1e-15, atol=0)


def test_coefficients_of_a_weight_per_step_take_operations_in_proportion_to_the_horizon():
    sizes = []
    for horizon in (32, 128):
        function = coefficients_of(keypoint_ocp(ROBOT, KeypointCost(TimeDependent()), horizon))
        sizes.append(function.expand("expanded").n_instructions())
    assert sizes[1] <= 4.2 * sizes[0]
