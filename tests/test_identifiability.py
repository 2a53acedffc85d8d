"""What demonstrations say about psi: closed forms, the derivative of the plan, coverage, and the next demonstration."""

import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import least_squares

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

from experiments.identifiability import Experiment, design, needed

from kpirl_ocp import OCP, Demonstration, FiniteDifference, GradientDescent, Implicit, Riccati, Unrolled
from kpirl_ocp.errors import CertificateError, ProblemError
from kpirl_ocp.irl.cases.examples import CASES, converging_descent, unconstrained
from kpirl_ocp.irl.identifiability.design import expected_information
from kpirl_ocp.irl.identifiability.gains import squared_gains, stiffness
from kpirl_ocp.irl.identifiability.identify import estimate_noise, identify
from kpirl_ocp.irl.identifiability.plan_jacobian import plan_jacobian

pytestmark = pytest.mark.usefixtures("virtual_machine")

Q, R, START, GOAL = 2.0, 0.5, 1.0, 4.0


def one_step(idle=False):
    """min q (s_0 + u - goal)^2 + r u^2, seen once: s_1 = s_0 + q (goal - s_0) / (q + r); idle: a third, idle weight."""
    s, u, goal, psi = ca.SX.sym("s"), ca.SX.sym("u"), ca.SX.sym("goal"), ca.SX.sym("psi", 2 + idle)
    return OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        context=goal,
        dynamics=s + u,
        stage_cost=psi[1] * u**2,
        terminal_cost=psi[0] * (s - goal) ** 2,
        horizon=1,
    )


def planned(start=START, goal=GOAL):
    end = start + Q * (goal - start) / (Q + R)
    return Demonstration([start], [goal], [[start], [end]])


def slope(start=START, goal=GOAL):
    return np.array([[R, -Q]]) * (goal - start) / (Q + R) ** 2


def test_the_derivative_of_one_step_is_its_closed_form():
    found = plan_jacobian(one_step(), planned(), [Q, R], Implicit())
    np.testing.assert_allclose(found.jacobian, slope(), rtol=1e-9)
    np.testing.assert_allclose(found.observations, planned().observations[1], rtol=1e-9)


@pytest.mark.parametrize("name", ["lqr", "integrator", "pendulum", "iiwa"])
def test_the_derivative_of_the_converged_plan_is_that_of_finite_differences(name):
    case = CASES[name]()
    found = plan_jacobian(case.problem, case.demonstration, case.psi, Implicit(Riccati(tolerance=1e-11)))
    for k, direction in enumerate(np.eye(len(case.psi))):
        ends = [
            Riccati(tolerance=1e-11).solve(
                case.problem, case.demonstration.s0, case.psi + h * direction, case.demonstration.context
            )
            for h in (1e-5, -1e-5)
        ]
        seen = [np.array(case.problem.observe(end.states.T)).T[1:].ravel() for end in ends]
        error = np.abs((seen[0] - seen[1]) / 2e-5 - found.jacobian[:, k])
        assert error.max() < 1e-6 * max(1.0, np.abs(found.jacobian).max())


@pytest.mark.parametrize("name", ["lqr", "iiwa"])
def test_the_derivative_of_gradient_steps_is_that_of_finite_differences(name):
    case = unconstrained(CASES[name]())
    solver = converging_descent(case, 3)
    found = plan_jacobian(case.problem, case.demonstration, case.psi, Unrolled(solver))
    for k, direction in enumerate(np.eye(len(case.psi))):
        ends = [
            solver.solve(case.problem, case.demonstration.s0, case.psi + h * direction, case.demonstration.context)
            for h in (1e-6, -1e-6)
        ]
        seen = [np.array(case.problem.observe(end.states.T)).T[1:].ravel() for end in ends]
        error = np.abs((seen[0] - seen[1]) / 2e-6 - found.jacobian[:, k])
        assert error.max() < 1e-7 * max(1.0, np.abs(found.jacobian).max())


def steps_from_rest(move=lambda u: u, step_size=0.1):
    """A problem of one step from 0 to move(u), where u is to be psi, and thirty gradient steps for it."""
    s, u, psi = ca.SX.sym("s"), ca.SX.sym("u"), ca.SX.sym("psi")
    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        horizon=1,
        dynamics=s + move(u),
        stage_cost=(u - psi) ** 2,
        terminal_cost=0 * s,
    )
    return problem, GradientDescent(steps=30, step_size=step_size)


@pytest.mark.parametrize("converged", [False, True], ids=["steps", "converged"])
@pytest.mark.parametrize(("move", "certified"), [(ca.sin, True), (ca.fabs, False)], ids=["smooth", "kinked"])
def test_the_certificate_of_a_plans_derivative_does_not_depend_on_the_observations(move, certified, converged):
    """The loss hides a kink of the plan where it vanishes: (|c psi| - 0)^2 is smooth."""
    problem, solver = steps_from_rest(move)
    method = Implicit(policy="flag") if converged else Unrolled(solver, policy="flag")
    for observed in (0.0, 1.0):
        seen = Demonstration([0.0], [], [[0.0], [observed]])
        assert plan_jacobian(problem, seen, [0.0], method).certified == certified


def test_gradient_steps_that_diverge_have_no_derivative_and_say_so():
    problem, solver = steps_from_rest(step_size=1e200)
    seen = Demonstration([0.0], [], np.zeros((2, 1)))
    with pytest.raises(CertificateError, match="NaN or infinite"):
        plan_jacobian(problem, seen, [0.2], Unrolled(solver))
    found = plan_jacobian(problem, seen, [0.2], Unrolled(solver, policy="flag"))
    assert not found.certified
    assert np.isnan(found.jacobian).all()
    with pytest.raises(ProblemError, match="finite and can be differentiated"):
        identify(problem, [seen], [0.2], noise=0.1, method=Unrolled(solver, policy="flag"))


def test_both_derivatives_agree_once_the_gradient_steps_have_converged():
    case = unconstrained(CASES["lqr"]())
    steps = plan_jacobian(case.problem, case.demonstration, case.psi, Unrolled(converging_descent(case)))
    converged = plan_jacobian(case.problem, case.demonstration, case.psi, Implicit())
    np.testing.assert_allclose(steps.jacobian, converged.jacobian, atol=1e-8)


def test_two_weights_of_one_step_are_known_up_to_their_common_scale_alone():
    found = identify(one_step(), [planned()], [Q, R], noise=0.01)
    assert found.known() == 1
    np.testing.assert_allclose(found.information, slope().T @ slope(), rtol=1e-8)
    np.testing.assert_allclose(np.abs(found.directions[:, 1]), np.array([Q, R]) / np.hypot(Q, R), rtol=1e-6)
    np.testing.assert_allclose(found.deviations[0], 0.01 / np.linalg.norm(slope()), rtol=1e-8)
    assert np.isinf(found.deviations[1])
    assert np.isinf(found.intervals()).all()
    across = found.intervals(0.9, [[R, -Q]])  # what the data do determine
    np.testing.assert_allclose(across, [[-1.645 * 0.01 * (Q + R) ** 2 / 3, 1.645 * 0.01 * (Q + R) ** 2 / 3]], rtol=1e-3)


def test_demonstrations_of_several_lengths_add_up_their_information():
    """s_{t+1} = psi s_t has the plan psi^t, and its derivative is t psi^(t-1)."""

    def growth(horizon):
        s, psi = ca.SX.sym("s"), ca.SX.sym("psi")
        return OCP.from_expressions(state=s, parameters=psi, dynamics=psi * s, horizon=horizon)

    seen = [Demonstration([1.0], [], (0.9 ** np.arange(T + 1))[:, None]) for T in (3, 5)]
    found = identify(growth, seen, [0.9], noise=0.1)
    alone = np.array([sum((t * 0.9 ** (t - 1)) ** 2 for t in range(1, T + 1)) for T in (3, 5)])
    np.testing.assert_allclose(found.information, [[alone.sum()]], rtol=1e-12)
    gains = 0.5 * np.log1p(alone * found.posterior[0, 0] / 0.1**2)
    np.testing.assert_allclose(expected_information(growth, found, seen), gains, rtol=1e-9)


@pytest.mark.parametrize(("share", "bounded"), [(1e-8, True), (1e-4, False)])
def test_an_interval_is_infinite_as_soon_as_a_combination_has_a_part_that_nothing_determines(share, bounded):
    found = identify(one_step(), [planned()], [Q, R], noise=0.01)
    combination = np.array([R, -Q]) + share * np.array([Q, R])  # across and along the scale that both have in common
    assert np.isfinite(found.intervals(0.9, combination)).all() == bounded


def test_the_decrement_is_the_gauss_newton_step_in_standard_deviations_of_the_posterior():
    problem, noise, spread, off = one_step(), 0.3, np.array([0.7, 2.0]), np.array([0.1, -0.05])
    seen = [planned(goal=GOAL), planned(goal=-GOAL)]
    seen = [Demonstration(d.s0, d.context, np.add(d.observations, [[0], [e]])) for d, e in zip(seen, off, strict=True)]
    found = identify(problem, seen, [Q, R], spread, noise)
    jacobian = np.vstack([slope(goal=GOAL), slope(goal=-GOAL)])
    precision = jacobian.T @ jacobian / noise**2 + np.diag(1 / spread**2)
    step = np.linalg.solve(precision, jacobian.T @ off / noise**2)
    np.testing.assert_allclose(found.decrement, np.sqrt(step @ precision @ step), rtol=1e-8)


def test_fewer_directions_are_known_with_more_noise_and_none_beyond_the_spread():
    case = CASES["pendulum"]()
    found = identify(case.problem, [case.demonstration], case.psi, noise=1e-3)
    counts = [found.known(noise) for noise in np.logspace(-6, 3, 19)]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] == 2
    assert counts[-1] == 0


def test_a_weight_that_moves_nothing_is_not_determined_and_keeps_its_spread():
    found = identify(one_step(idle=True), [planned()], [Q, R, 7.0], spread=[0.1, 5.0, 3.0], noise=1e-3)
    assert not found.determined()[2]
    np.testing.assert_allclose(found.posterior[2], [0, 0, 9.0], atol=1e-9)
    np.testing.assert_array_equal(found.intervals()[2], [-np.inf, np.inf])
    np.testing.assert_allclose(found.credible_intervals()[2], 7.0 + 1.6449 * 3.0 * np.array([-1, 1]), rtol=1e-4)


def test_the_posterior_is_the_inverse_of_information_and_prior():
    case, spread = CASES["iiwa"](), np.linspace(0.5, 2.0, 10)
    found = identify(case.problem, [case.demonstration], case.psi, spread, noise=0.02)
    expected = np.linalg.inv(found.information / 0.02**2 + np.diag(1 / spread**2))
    np.testing.assert_allclose(found.posterior, expected, rtol=1e-7, atol=1e-12)
    row = np.arange(10.0)
    halved = np.sqrt(row @ expected @ row) < 0.5 * np.linalg.norm(row * spread)
    assert found.determined(row) == [halved]
    units = 10.0 ** np.linspace(-12, 12, 10)  # of a spread that is none the worse for them
    identify(case.problem, [case.demonstration], case.psi, np.diag(units), noise=0.02)
    width = np.ptp(found.credible_intervals(0.9, row))
    np.testing.assert_allclose(width, 2 * 1.6448536 * np.sqrt(row @ expected @ row), rtol=1e-6)


def test_parameters_that_were_alike_before_learning_are_learned_together():
    rng, common = np.random.default_rng(2), np.array([[1.0, 0.3], [1.0, -0.3]])
    found = identify(one_step(), [planned()], [Q, R], spread=common, noise=0.05)
    expected = np.linalg.inv(slope().T @ slope() / 0.05**2 + np.linalg.inv(common @ common.T))
    np.testing.assert_allclose(found.posterior, expected, rtol=1e-7)
    turn, _ = np.linalg.qr(rng.normal(size=(2, 2)))  # the same covariance by another root
    other = identify(one_step(), [planned()], [Q, R], spread=common @ turn, noise=0.05)
    np.testing.assert_allclose(other.eigenvalues, found.eigenvalues, atol=1e-9 * found.eigenvalues[0])
    np.testing.assert_allclose(other.posterior, expected, rtol=1e-7)


def test_units_of_psi_do_not_change_how_many_directions_are_known():
    case, units = unconstrained(CASES["iiwa"]()), np.array([1e3, 1, 1, 1e-3, 1, 1, 1, 1, 1, 1.0])
    found = identify(case.problem, [case.demonstration], case.psi, units, noise=1e-3)
    jacobian = plan_jacobian(case.problem, case.demonstration, case.psi, Implicit()).jacobian * units
    np.testing.assert_allclose(found.eigenvalues, np.linalg.svd(jacobian)[1] ** 2, rtol=1e-6, atol=1e-9)


def test_noise_is_estimated_without_bias():
    rng, jacobian = np.random.default_rng(0), np.random.default_rng(1).normal(size=(30, 4)) * [100, 100, 100, 1e-9]
    left = np.eye(30) - jacobian[:, :3] @ np.linalg.pinv(jacobian[:, :3])
    eigenvalues = np.linalg.eigvalsh(jacobian.T @ jacobian)
    found = [estimate_noise(left @ rng.normal(scale=0.3, size=30), eigenvalues) for _ in range(500)]
    assert abs(np.mean([sigma**2 for sigma, _ in found]) / 0.09 - 1) < 3 * np.sqrt(2 / 27 / 500)
    np.testing.assert_allclose([freedom for _, freedom in found], 27, atol=1e-2)


def learn(problem, demonstration, psi0):
    """psi with the least IRL loss."""
    seen = demonstration.observations[1:].ravel()
    return least_squares(
        lambda psi: plan_jacobian(problem, demonstration, psi, Implicit()).observations - seen,
        psi0,
        lambda psi: plan_jacobian(problem, demonstration, psi, Implicit()).jacobian,
        xtol=1e-10,
    ).x


def test_ninety_per_cent_intervals_cover_nine_in_ten_true_values():
    problem = regulator()
    truth, rng, covered = np.array([0.7, 2.1]), np.random.default_rng(3), []
    plan = Riccati().solve(problem, [2.0], truth, ()).states
    for _ in range(200):
        observations = plan + np.vstack([np.zeros((1, 1)), rng.normal(scale=0.01, size=(problem.horizon, 1))])
        demonstration = Demonstration([2.0], [], observations)

        learned = learn(problem, demonstration, truth)
        intervals = identify(problem, [demonstration], learned).intervals(0.9)
        covered.append((intervals[:, 0] <= truth) & (truth <= intervals[:, 1]))
    assert 0.85 <= np.mean(covered) <= 0.95


def regulator():
    """A scalar LQR with weights on effort and on the end; that of the states is one, so that both are determined."""
    s, u, psi = ca.SX.sym("s"), ca.SX.sym("u"), ca.SX.sym("psi", 2)
    return OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        dynamics=0.9 * s + 0.5 * u,
        stage_cost=s**2 + psi[0] * u**2,
        terminal_cost=psi[1] * s**2,
        horizon=6,
    )


def test_the_decrement_tells_how_far_psi_is_from_the_minimum_in_standard_deviations():
    problem = regulator()
    truth = np.array([0.7, 2.1])
    demonstration = Demonstration([2.0], [], Riccati().solve(problem, [2.0], truth, ()).states)
    at = identify(problem, [demonstration], truth, spread=10.0, noise=1e-4)
    assert at.decrement < 1e-3
    step = 2 * at.deviations[0] * at.directions[:, 0] * 10.0
    away = identify(problem, [demonstration], truth + step, spread=10.0, noise=1e-4)
    np.testing.assert_allclose(away.decrement, 2.0, rtol=1e-2)


def test_expected_information_is_the_growth_of_the_log_determinant():
    candidates = [planned(0.0, 1.0), planned(0.0, 6.0), planned(2.0, 2.0)]
    found = identify(one_step(), [planned()], [Q, R], spread=2.0, noise=0.1)
    expected = []
    for candidate in candidates:
        J = plan_jacobian(one_step(), candidate, [Q, R], Implicit()).jacobian
        before = np.linalg.inv(found.posterior)
        expected.append(0.5 * (np.linalg.slogdet(before + J.T @ J / 0.01)[1] - np.linalg.slogdet(before)[1]))
    gains = expected_information(one_step(), found, candidates)
    np.testing.assert_allclose(gains, expected, rtol=1e-6, atol=1e-9)
    assert gains.argmax() == 1  # the longest way
    assert gains[2] < 1e-9  # at the goal already: nothing to see


def test_three_demonstrations_from_where_they_teach_most_teach_more_than_three_random_ones_on_reaching():
    errors = design(Experiment.reaching(24, 0, spread=1.0), repetitions=12, most=3, noise=5e-3, seed=0)
    chosen, random = errors["most informative"], errors["random"]
    np.testing.assert_array_equal(chosen[:, 0], random[:, 0])  # the first one is the same
    assert chosen[:, -1].mean() < 0.85 * random[:, -1].mean()


def test_demonstrations_are_needed_until_the_error_stays_below_the_bar():
    errors = np.array([[0.3, 0.1, 0.1], [0.1, 0.3, 0.1], [0.1, 0.1, 0.1], [0.3, 0.1, 0.3]])
    np.testing.assert_array_equal(needed(errors, 0.2), [2, 3, 1, 4])


def test_squared_gains_of_an_integrator_count_the_actions_so_far():
    s, u = ca.SX.sym("s", 2), ca.SX.sym("u", 2)
    problem = OCP.from_expressions(
        state=s, action=u, dynamics=s + ca.vertcat(u[0], 3 * u[1]), stage_cost=ca.sumsqr(u), horizon=4
    )
    gains = squared_gains(problem, problem.simulate([0, 0], np.zeros((4, 2))), np.zeros(0))
    np.testing.assert_allclose(gains, [[1, 9], [2, 18], [3, 27], [4, 36]])
    np.testing.assert_allclose(stiffness(np.ones((4, 1)), gains), [20, 180])
    np.testing.assert_allclose(stiffness(np.eye(4), gains, 0.5 * np.ones((4, 2))), gains.ravel())


def test_squared_gains_of_a_pendulum_are_the_squares_of_finite_differences():
    case, h = CASES["pendulum"](), 1e-6
    actions = np.linspace(-1, 1, case.problem.horizon)[:, None]

    def seen(change):
        states = case.problem.simulate(case.demonstration.s0, actions + change, case.psi).states
        return np.array(case.problem.observe(states.T)).T[1:]

    steps = h * np.eye(case.problem.horizon)[..., None]
    differences = np.array([(seen(step) - seen(-step)) / (2 * h) for step in steps])
    gains = squared_gains(case.problem, case.problem.simulate(case.demonstration.s0, actions, case.psi), case.psi)
    np.testing.assert_allclose(gains, (differences**2).sum(axis=0), rtol=1e-7)


def test_squared_gains_know_the_parameters_context_and_schedule_of_the_dynamics():
    s, u, psi, c, d = (ca.SX.sym(name) for name in ("s", "u", "psi", "c", "d"))
    problem = OCP.from_expressions(
        state=s, action=u, parameters=psi, context=c, stage=d, schedule=[[1.0], [2.0], [3.0], [0.0]],
        dynamics=s + psi * c * d * u, stage_cost=u**2, horizon=3,
    )  # fmt: skip
    along = problem.simulate([0], np.zeros((3, 1)), [2.0], [0.5])
    np.testing.assert_allclose(squared_gains(problem, along, [2.0], [0.5]), [[1], [1 + 4], [1 + 4 + 9]])


def test_what_cannot_be_identified_is_said():
    problem = one_step()
    with pytest.raises(ProblemError, match="at least one demonstration"):
        identify(problem, [], [Q, R])
    with pytest.raises(ProblemError, match="spread must be positive"):
        identify(problem, [planned()], [Q, R], spread=[1.0, 0.0])
    with pytest.raises(ProblemError, match="invertible"):
        identify(problem, [planned()], [Q, R], spread=np.ones((2, 2)))
    with pytest.raises(ProblemError, match="noise must be positive"):
        identify(problem, [planned()], [Q, R], noise=0.0)
    with pytest.raises(ProblemError, match="say nothing about their noise"):
        identify(problem, [planned()], [Q, R])
    with pytest.raises(ProblemError, match=r"Implicit\(\.\.\.\) or Unrolled"):
        identify(problem, [planned()], [Q, R], method=FiniteDifference())
    with pytest.raises(ProblemError, match="combinations must be"):
        identify(problem, [planned()], [Q, R], noise=1.0).intervals(0.9, [1.0, 2.0, 3.0])
    with pytest.raises(ProblemError, match="level"):
        identify(problem, [planned()], [Q, R], noise=1.0).intervals(1.5)
    with pytest.raises(CertificateError):
        identify(problem, [planned()], [Q, R], noise=1.0, method=Implicit(GradientDescent(1, 0.1)))
