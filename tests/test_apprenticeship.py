"""The baseline: Abbeel and Ng's max-margin step and loop."""

from dataclasses import replace

import numpy as np
import pytest

from kpirl_ocp import GradientDescent
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.cases.tasks import as_demonstration, demonstrate
from kpirl_ocp.irl.learning.apprenticeship import apprenticeship, features
from kpirl_ocp.irl.learning.margins import largest_margin, max_margin, projection, two_sided
from kpirl_ocp.ocp.models import KeypointCost, Robot, TimeDependent, Weighted, keypoint_ocp


def test_one_difference_gives_its_own_direction_and_length_as_margin():
    psi, margin = max_margin(np.array([[3.0, 4.0]]))
    np.testing.assert_allclose(psi, [0.6, 0.8], atol=1e-9)
    np.testing.assert_allclose(margin, 5.0, rtol=1e-9)


def test_two_differences_give_the_normal_of_the_segment_between_them():
    psi, margin = max_margin(np.array([[2.0, 1.0], [2.0, -1.0]]))
    np.testing.assert_allclose(psi, [1.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(margin, 2.0, rtol=1e-9)


def test_the_margin_is_the_largest_of_all_directions_in_three_dimensions():
    rng = np.random.default_rng(3)
    differences = rng.normal(size=(8, 3)) + np.array([1.5, 1.0, 0.5])
    psi, margin = max_margin(differences)
    directions = rng.normal(size=(200_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    sampled = (directions @ differences.T).min(axis=1).max()
    assert np.linalg.norm(psi) == pytest.approx(1.0, abs=1e-12)
    assert (differences @ psi).min() == pytest.approx(margin, abs=1e-12)
    assert sampled <= margin <= sampled + 1e-2


def test_an_expert_within_the_hull_of_the_others_cannot_be_separated():
    psi, margin = max_margin(np.array([[1.0, 0.0], [-1.0, 0.5], [-1.0, -0.5]]))
    assert margin == 0.0
    assert not psi.any()


def test_the_projection_is_the_normal_of_the_segment_for_two_plans_and_the_difference_for_one():
    expert, plans = np.zeros(2), np.array([[2.0, 1.0], [2.0, -3.0]])
    psi, margin = projection(plans[:1], expert)
    np.testing.assert_allclose((*psi, margin), (2 / np.sqrt(5), 1 / np.sqrt(5), np.sqrt(5)))
    psi, margin = projection(plans, expert)
    np.testing.assert_allclose((*psi, margin), (1, 0, 2), atol=1e-12)
    np.testing.assert_allclose(psi, largest_margin(plans, expert)[0], atol=1e-9)


def test_the_two_sided_program_has_its_closed_form_and_no_answer_for_an_expert_without_features():
    psi, margin = two_sided(np.array([[3.0, 0.0]]), np.array([0.0, 1.0]))  # the shortest is (1/3, -1)
    np.testing.assert_allclose(psi, np.array([1, -3]) / np.sqrt(10), atol=1e-9)
    np.testing.assert_allclose(margin, 6 / np.sqrt(10))
    psi, margin = two_sided(np.array([[3.0, 1.0]]), np.zeros(2))
    assert not psi.any()
    assert margin == 0.0


def test_a_target_for_every_step_makes_the_features_of_the_demonstration_zero(setup):
    _, demonstrations, _ = setup
    demo = demonstrations[0]
    following = replace(demo, context=demo.observations[1:].ravel())
    assert not features(demo.observations, following).any()
    shifted = demo.observations + np.arange(9.0)
    np.testing.assert_allclose(features(shifted, following), 9 * np.arange(9.0) ** 2)


@pytest.fixture(scope="module")
def setup():
    robot = Robot.iiwa()
    demonstrations = [as_demonstration(robot, episode) for episode in demonstrate(robot, "placing", 2, seed=5)]
    return keypoint_ocp(robot, KeypointCost(Weighted()), 9).unconstrained(), demonstrations, robot


def test_features_weighted_by_psi_are_the_cost(setup):
    problem, demonstrations, _ = setup
    demo, psi = demonstrations[0], np.linspace(0.2, 1.8, 9)
    plan = GradientDescent(3, 1e-2).solve(problem, demo.s0, psi, demo.context)
    np.testing.assert_allclose(psi @ features(plan.states[:, :9], demo), plan.objective, rtol=1e-12)


def test_discounted_features_weigh_step_t_by_gamma_to_the_t(setup):
    _, demonstrations, _ = setup
    demo = demonstrations[0]
    errors = (demo.observations - demo.context) ** 2
    expected = sum(0.9**t * errors[t] for t in range(1, 10))
    np.testing.assert_allclose(features(demo.observations, demo, 0.9), expected, rtol=1e-13)


def test_every_cost_of_the_baseline_separates_the_expert_and_margins_shrink(setup):
    problem, demonstrations, _ = setup
    result = apprenticeship(problem, demonstrations[:1], GradientDescent(5, 1e-2), 15, np.random.default_rng(0))
    np.testing.assert_allclose(np.linalg.norm(result.psis, axis=1), 1.0, atol=1e-12)
    assert (result.margins > 0).all()
    # Every plan adds a constraint to the max-margin step.
    assert (np.diff(result.margins) <= 1e-9 * result.margins[0]).all()
    assert result.loss == result.losses.min()


def test_the_baseline_repeats_for_a_seed_and_differs_for_another(setup):
    problem, demonstrations, _ = setup
    solver = GradientDescent(5, 1e-2)
    runs = [apprenticeship(problem, demonstrations, solver, 5, np.random.default_rng(seed)) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(runs[0].psis, runs[1].psis)
    assert not np.array_equal(runs[0].psis, runs[2].psis)


@pytest.mark.parametrize(
    "cost",
    [
        KeypointCost(TimeDependent()),
        KeypointCost(Weighted(), positivity="softplus"),
        KeypointCost(Weighted(), positivity="square"),  # the same as identity at psi = 1
    ],
)
def test_the_baseline_asks_for_a_cost_linear_in_psi(cost, setup):
    _, demonstrations, robot = setup
    problem = keypoint_ocp(robot, cost, 9).unconstrained()
    with pytest.raises(ProblemError, match="Weighted"):
        apprenticeship(problem, demonstrations, GradientDescent(), 3, np.random.default_rng(0))


def test_a_first_plan_like_the_expert_and_no_epochs_are_said(setup):
    problem, demonstrations, _ = setup
    demo = demonstrations[0]
    still = replace(demo, observations=np.tile(demo.observations[0], (10, 1)))
    with pytest.raises(ProblemError, match="nothing to learn"):
        apprenticeship(problem, [still], GradientDescent(), 3, np.random.default_rng(0), initial_spread=0.0)
    with pytest.raises(ProblemError, match="at least one epoch"):
        apprenticeship(problem, [demo], GradientDescent(), 0, np.random.default_rng(0))
