"""Outer optimisers, the learning loop (Algorithm 1) and evaluation."""

import numpy as np
import pytest

from kpirl_ocp import GradientDescent, Implicit, Riccati, Unrolled
from kpirl_ocp.errors import CertificateError, FileError, ProblemError
from kpirl_ocp.irl.cases.cost_files import LearnedCost
from kpirl_ocp.irl.cases.examples import lqr, pendulum
from kpirl_ocp.irl.cases.tasks import as_demonstration, demonstrate
from kpirl_ocp.irl.learning.evaluation import evaluate, relative_distance
from kpirl_ocp.irl.learning.learn import Learner, learn
from kpirl_ocp.irl.learning.optimisers import LBFGS, Adam, Box, Descent, Point
from kpirl_ocp.ocp.models import RBF, KeypointCost, Robot, TimeDependent, Weighted, keypoint_ocp
from kpirl_ocp.ocp.solvers.ipopt import Ipopt

pytestmark = pytest.mark.usefixtures("virtual_machine")

CURVATURES = np.array([1.0, 10.0, 100.0])


def quadratic(psi):
    """L = 1/2 (psi - 1)^T diag(1, 10, 100) (psi - 1)."""
    return Point(psi, float(0.5 * CURVATURES @ (psi - 1) ** 2), CURVATURES * (psi - 1))


def run(optimiser, evaluate, psi0, steps):
    point = evaluate(psi0)
    memory = optimiser.start(point)
    for _ in range(steps):
        point, memory = optimiser.step(evaluate, point, memory)
    return point


def test_descent_contracts_every_coordinate_by_one_minus_eta_times_curvature():
    psi0 = np.array([3.0, 2.0, 0.5])
    point = run(Descent(0.01), quadratic, psi0, 7)
    np.testing.assert_allclose(point.psi, 1 + (1 - 0.01 * CURVATURES) ** 7 * (psi0 - 1), rtol=1e-14)


def test_adam_follows_its_published_recursion():
    psi, m, v = np.array([3.0, 2.0, 0.5]), np.zeros(3), np.zeros(3)
    for t in range(1, 6):
        g = CURVATURES * (psi - 1)
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g**2
        psi = psi - 0.1 * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-8)
    np.testing.assert_allclose(run(Adam(0.1), quadratic, np.array([3.0, 2.0, 0.5]), 5).psi, psi, rtol=1e-14)


def test_lbfgs_solves_an_ill_conditioned_quadratic_in_a_few_steps():
    point = run(LBFGS(tolerance=0.0), quadratic, np.array([3.0, 2.0, 0.5]), 25)
    np.testing.assert_allclose(point.psi, 1.0, atol=1e-10)


def test_lbfgs_shortens_a_step_whose_gradient_cannot_be_certified():
    def guarded(psi):
        if psi[0] < 0.9:
            raise CertificateError("beyond the edge", None)
        return Point(psi, float(psi[0] ** 2), 2 * psi)

    point = run(LBFGS(first_step=5.0), guarded, np.array([2.0]), 20)
    assert 0.9 <= point.psi[0] < 1.0


def test_lbfgs_forgets_a_pair_that_curves_down_on_the_entries_that_may_move():
    asked = []

    def evaluate(psi):
        asked.append(psi)
        return Point(psi, float(psi[0] + 0.5 * psi[1] ** 2), np.array([1.0, psi[1]]))

    held, pair = Box(lower=np.array([0.0, -9.0])), (np.array([1.0, 1.0]), np.array([2.0, -1.0]))
    found, _ = LBFGS().step(evaluate, Point(np.array([0.0, 1.0]), 0.5, np.ones(2)), (pair,), held)
    np.testing.assert_array_equal(found.psi, [0.0, 0.0])
    assert len(asked) == 1


def test_lbfgs_stays_at_a_minimum():
    point = quadratic(np.ones(3))
    assert LBFGS().step(quadratic, point, ())[0] is point


@pytest.fixture(scope="module")
def placing():
    robot = Robot.iiwa()
    demonstrations = [as_demonstration(robot, episode) for episode in demonstrate(robot, "placing", 3, seed=11)]
    return robot, demonstrations


def test_learning_is_the_gradient_step_of_algorithm_1_on_the_mean_over_demonstrations(placing):
    robot, demonstrations = placing
    problem = keypoint_ocp(robot, KeypointCost(Weighted()), 9).unconstrained()
    method, psi = Unrolled(GradientDescent(2, 1e-2)), np.linspace(0.5, 1.5, 9)
    result = learn(problem, demonstrations, psi, method, Descent(1e-2), steps=1, progress=False)
    singles = [method(problem, demonstration, psi) for demonstration in demonstrations]
    expected = psi - 1e-2 * np.mean([single.gradient for single in singles], axis=0)
    np.testing.assert_allclose(result.psis[1], expected, rtol=1e-14)
    np.testing.assert_allclose(result.losses[0], np.mean([single.loss for single in singles]), rtol=1e-14)


def test_learning_keeps_the_best_psi_and_repeats_bit_by_bit(placing):
    robot, demonstrations = placing
    problem = keypoint_ocp(robot, KeypointCost(Weighted()), 9).unconstrained()
    arguments = (problem, demonstrations[:1], np.ones(9), Unrolled(GradientDescent(1, 3e-2)), Adam(0.3))
    first, second = (learn(*arguments, steps=30, progress=False) for _ in range(2))
    assert (np.diff(first.losses) > 0).any()  # else the best would be the last
    assert first.loss == first.losses.min()
    np.testing.assert_array_equal(first.psi, first.psis[first.losses.argmin()])
    np.testing.assert_array_equal(first.psis, second.psis)
    assert not first.uncertified.any()


def test_implicit_learning_recovers_the_cost_that_produced_the_demonstration():
    case = lqr()
    truth = np.array([2.0, 0.4, 1.1])
    plan = Ipopt().solve(case.problem, case.demonstration.s0, truth)
    demonstration = type(case.demonstration)(case.demonstration.s0, np.zeros(0), plan.states)
    result = learn(case.problem, [demonstration], case.psi, Implicit(), LBFGS(tolerance=0), steps=60, progress=False)
    assert result.loss < 1e-20
    # A cost is identified up to scale.
    np.testing.assert_allclose(result.psi / result.psi[1], truth / truth[1], rtol=1e-8)


def test_one_step_in_centimetres_cuts_the_placing_loss_by_four_in_50_epochs_and_stays_there():
    # The settings of the paper's own placing example; its cost is a mean over coordinates, hence step_size / 9.
    robot = Robot.iiwa()
    cost = KeypointCost(RBF(5))
    problem = keypoint_ocp(robot, cost, 9, unit=0.01).unconstrained()
    for seed in range(3):
        demonstration = as_demonstration(robot, demonstrate(robot, "placing", 1, seed)[0], unit=0.01)
        method, psi0 = Unrolled(GradientDescent(1, 1e-3 / 9)), cost.initial(9, 9, 0.01)
        result = learn(problem, [demonstration], psi0, method, Adam(1e-2), steps=100, progress=False)
        assert result.losses[50:].max() < result.losses[0] / 4


def test_learning_without_demonstrations_is_an_error(placing):
    robot, _ = placing
    problem = keypoint_ocp(robot, KeypointCost(Weighted()), 9)
    with pytest.raises(ProblemError, match="at least one demonstration"):
        Learner(problem, (), Implicit(), Adam())


def test_evaluation_of_the_demonstration_itself_is_zero_and_of_standing_still_is_one(placing):
    _, demonstrations = placing
    demo = demonstrations[0]
    assert relative_distance(demo.observations, demo) == 0.0
    assert relative_distance(np.tile(demo.observations[0], (10, 1)), demo) == 1.0


def test_evaluation_reports_the_squared_keypoint_distance(placing):
    robot, demonstrations = placing
    problem = keypoint_ocp(robot, KeypointCost(Weighted()), 9).unconstrained()
    result = evaluate(problem, demonstrations, np.ones(9), GradientDescent(2, 1e-2))
    for plan, demo, loss in zip(result.solutions, demonstrations, result.losses, strict=True):
        np.testing.assert_allclose(loss, np.sum((plan.states[:, :9] - demo.observations) ** 2), rtol=1e-12)
    assert result.failures == ""


def test_an_evaluation_says_which_plans_failed(placing):
    robot, demonstrations = placing
    problem = keypoint_ocp(robot, KeypointCost(Weighted(), 0.1), 9)
    result = evaluate(problem, demonstrations, np.ones(9), Riccati(max_iterations=1))
    count = len(demonstrations)
    assert result.failures.startswith(f"{count} of {count} plans failed; number 0: ITERATION_LIMIT: ")


def test_a_learned_cost_plans_the_same_after_a_round_trip_through_its_file(tmp_path, placing):
    robot, demonstrations = placing
    cost = KeypointCost(TimeDependent(), (3.0,) * 9, learn_effort=True, positivity="softplus")
    learned = LearnedCost(cost, cost.initial(9, 9, 1.3), 9, Ipopt())
    learned.write(tmp_path / "cost.json")
    again = LearnedCost.read(tmp_path / "cost.json")
    demo = demonstrations[0]
    plans = [c.solver.solve(c.problem(robot), demo.s0, c.psi, demo.context) for c in (learned, again)]
    np.testing.assert_array_equal(plans[0].actions, plans[1].actions)


@pytest.mark.parametrize("text", ["{", "[]", '{"basis": {"kind": "nonsense"}}'])
def test_a_malformed_cost_file_is_named(tmp_path, text):
    path = tmp_path / "cost.json"
    path.write_text(text)
    with pytest.raises(FileError, match=r"cost\.json"):
        LearnedCost.read(path)


def test_a_certificate_error_is_one_line_with_its_certificate():
    case = pendulum()
    with pytest.raises(CertificateError) as caught:
        Implicit(Ipopt(max_iterations=1))(case.problem, case.demonstration, case.psi)
    assert "\n" not in str(caught.value)
    assert not caught.value.certificate.certified
