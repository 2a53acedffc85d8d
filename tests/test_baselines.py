"""Baselines recover weights exactly from optimal motions, on average from noisy ones, and as nested learning does."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from two_link_arm import GOAL, START, folding, hand, two_link_arm

from kpirl_ocp import LBFGS, OCP, Demonstration, Implicit, Ipopt, Riccati
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.baselines.demonstrated_conditions import DemonstratedConditions
from kpirl_ocp.irl.baselines.inverse_kkt import inverse_kkt, simplex_least_squares
from kpirl_ocp.irl.baselines.max_entropy import max_entropy, negative_log_likelihood
from kpirl_ocp.irl.baselines.single_level import single_level
from kpirl_ocp.irl.cases.examples import CASES
from kpirl_ocp.irl.learning.learn import learn


def swing():
    """A pendulum with weights on angle, rate, torque and the end; psi has the sum one."""
    s, u, psi = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("psi", 4)
    rate = s[1] + 0.1 * (u - 3 * ca.sin(s[0]))
    return OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        dynamics=ca.vertcat(s[0] + 0.1 * rate, rate),
        stage_cost=psi[0] * (s[0] - 1) ** 2 + psi[1] * s[1] ** 2 + psi[2] * u**2,
        terminal_cost=psi[3] * 20 * (s[0] - 1) ** 2,
        horizon=12,
    )


TRUTH = np.array([0.4, 0.1, 0.05, 0.45])


def optimal(problem, s0, psi=TRUTH):
    solution = Riccati(tolerance=1e-11).solve(problem, s0, psi, ()).raise_if_failed()
    return Demonstration(s0, [], solution.states), solution.actions


@pytest.fixture(scope="module")
def demonstrated():
    problem = swing()
    pairs = [optimal(problem, s0) for s0 in ([0.0, 0.0], [1.5, -1.0])]
    return problem, [demo for demo, _ in pairs], [actions for _, actions in pairs]


def test_inverse_kkt_finds_the_weights_of_an_optimal_motion_exactly(demonstrated):
    np.testing.assert_allclose(inverse_kkt(*demonstrated), TRUTH, rtol=1e-6)


def test_inverse_kkt_minimises_over_the_simplex():
    rng = np.random.default_rng(0)
    for _ in range(20):
        A = rng.normal(size=(6, 4)) * [1, 10, 0.1, 1]
        psi = simplex_least_squares(A)
        slope = 2 * A.T @ (A @ psi)
        assert psi.min() >= 0
        np.testing.assert_allclose(psi.sum(), 1)
        assert slope.min() >= slope @ psi - 1e-9 * np.abs(slope).max()  # no vertex is downhill


@pytest.mark.parametrize("name", ["lqr", "pendulum"])
def test_demonstrated_derivatives_are_those_of_the_cost(name):
    if name == "pendulum":
        problem, s0, actions = swing(), [0.3, 0.1], np.full((12, 1), 0.5)
    else:
        problem, s0, actions = CASES["lqr"]().problem, [2.0], np.full((6, 1), -0.2)
    psi = np.arange(1.0, problem.n_parameters + 1)
    found = DemonstratedConditions.at(problem, Demonstration(s0, [], np.zeros((1, 1))), actions)

    def cost(u):
        plan = problem.simulate(s0, u.reshape(actions.shape), psi)
        return float(problem.cost(plan.states.T, plan.actions.T, psi, []))

    u, eye = actions.ravel(), np.eye(actions.size)
    slope = [(cost(u + 1e-5 * e) - cost(u - 1e-5 * e)) / 2e-5 for e in eye]
    np.testing.assert_allclose(found.gradient + found.gradients @ psi, slope, rtol=1e-7, atol=1e-7)
    bent = [(cost(u + 1e-3 * e) - 2 * cost(u) + cost(u - 1e-3 * e)) / 1e-6 for e in eye]
    np.testing.assert_allclose(np.diag(found.hessian + np.tensordot(psi, found.hessians, 1)), bent, rtol=1e-4)


def test_the_likelihood_has_the_gradient_of_finite_differences(demonstrated):
    problem, demos, actions = demonstrated
    one = DemonstratedConditions.at(problem, demos[0], actions[0] + 0.1)
    _, slope = negative_log_likelihood(one, TRUTH)
    steps = 1e-6 * np.eye(4)
    ends = [[negative_log_likelihood(one, TRUTH + sign * step)[0] for sign in (1, -1)] for step in steps]
    np.testing.assert_allclose(slope, [(up - down) / 2e-6 for up, down in ends], rtol=1e-6)


def test_maximum_entropy_finds_the_weights_and_the_exactness_of_a_noisy_demonstrator():
    case, rng = CASES["lqr"](), np.random.default_rng(1)
    problem, truth = case.problem, np.array([1.3, 0.7, 2.1]) * 20
    plan = Riccati().solve(problem, [2.0], truth, ())
    demo = Demonstration([2.0], [], plan.states)
    hessian = np.tensordot(truth, DemonstratedConditions.at(problem, demo, plan.actions).hessians, 1)
    root = np.linalg.cholesky(np.linalg.inv(hessian))
    actions = [plan.actions + (root @ rng.normal(size=6))[:, None] for _ in range(500)]
    found = max_entropy(problem, [demo] * 500, actions, np.ones(3))
    np.testing.assert_allclose(found, truth, rtol=0.2)


def test_single_level_recovers_the_weights_of_optimal_motions(demonstrated):
    problem, demos, _ = demonstrated
    found = single_level(problem, demos, np.full(4, 0.25), Riccati())
    assert found.success
    np.testing.assert_allclose(found.psi, TRUTH, rtol=1e-3)


def test_single_level_keeps_weights_above_the_least(demonstrated):
    problem, demos, _ = demonstrated
    found = single_level(problem, demos, np.full(4, 0.25), Riccati(), least=[0, 0.2, 0, 0])
    assert found.success
    np.testing.assert_allclose(found.psi[1], 0.2, atol=1e-6)  # the truth is below
    np.testing.assert_allclose(found.psi.sum(), 1.0)


def test_single_level_reaches_the_loss_of_nested_learning(demonstrated):
    problem, (demo, _), _ = demonstrated
    rng = np.random.default_rng(2)
    noisy = replace(demo, observations=demo.observations + 0.02 * rng.normal(size=demo.observations.shape))
    found = single_level(problem, [noisy], np.full(4, 0.25), Riccati())
    assert found.success
    nested = learn(problem, [noisy], found.psi * 1.3, Implicit(), LBFGS(tolerance=1e-12), steps=100, progress=False)
    np.testing.assert_allclose(found.loss, nested.loss, rtol=1e-4)


@pytest.mark.parametrize(
    "method",
    [
        lambda case, actions: inverse_kkt(case.problem, [case.demonstration], actions),
        lambda case, actions: max_entropy(case.problem, [case.demonstration], actions, case.psi),
        lambda case, actions: single_level(case.problem, [case.demonstration], case.psi, Ipopt()),
    ],
)
def test_inequalities_are_refused(method):
    with pytest.raises(ProblemError, match=r"unconstrained\(\)"):
        method(CASES["integrator"](), [np.zeros((12, 1))])


def test_inverse_kkt_refuses_a_motion_that_is_stationary_under_all_weights():
    problem = CASES["lqr"]().problem
    resting = Demonstration([0.0], [], np.zeros((problem.horizon + 1, 1)))
    with pytest.raises(ProblemError, match="stationary under all weights"):
        inverse_kkt(problem, [resting], [np.zeros((problem.horizon, 1))])


def test_costs_that_are_not_linear_in_psi_are_refused():
    case = CASES["iiwa"]()  # softplus weights
    problem = case.problem.unconstrained()
    with pytest.raises(ProblemError, match="linear in psi"):
        inverse_kkt(problem, [case.demonstration], [np.zeros((5, 7))])


@pytest.mark.parametrize(("noise", "error"), [(0.0, 1e-4), (1e-3, 0.01)])
def test_single_level_finds_the_mixture_of_the_two_link_arm_of_its_paper(noise, error):
    problem, truth = two_link_arm(), np.array([0.2, 0.5, 0.3])  # fifty points, the hand at its goal as an equality
    plan = Ipopt().solve(problem, START, truth, GOAL, folding()).raise_if_failed()
    np.testing.assert_allclose(hand(plan.states[-1]), GOAL, atol=1e-8)
    seen = plan.states[:, :2] + np.random.default_rng(0).normal(0.0, noise, (50, 2))  # [rad]
    found = single_level(problem, [Demonstration(START, GOAL, seen)], np.full(3, 1 / 3), Ipopt(), folding())
    assert found.success
    np.testing.assert_allclose(found.psi, truth, atol=error)
