"""Costs learned from detected keypoints, and control with them, on a linear arm where much is known exactly."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from kpirl_ocp.episodes import ArmTrack, KeypointTrack
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.cases.planar_arm import without_joints
from kpirl_ocp.irl.learning.evaluation import relative_distance
from kpirl_ocp.irl.learning.optimisers import Adam
from kpirl_ocp.irl.visual.closed_loop import KeypointController
from kpirl_ocp.irl.visual.demonstrations import (
    moving_keypoints,
    positions,
    robot_demonstration,
    transferred_demonstration,
)
from kpirl_ocp.irl.visual.learning import (
    CONVERGED,
    COSTS,
    InnerLoop,
    learn_by_apprenticeship,
    learn_implicit,
    learn_unrolled,
)
from kpirl_ocp.irl.visual.planning_costs import PlanningCost, planning_problem
from kpirl_ocp.ocp.models.keypoint_costs import KeypointCost
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.ocp.models.keypoint_problems import network_ocp
from kpirl_ocp.ocp.models.mlp import MLP
from kpirl_ocp.types import Demonstration, Sight

pytestmark = pytest.mark.usefixtures("virtual_machine")

T, K, N_Q = 6, 2, 3
# Keypoints move by A u: the first joint moves both along x, the second along y, the third turns them.
A = np.array([[0.5, 0.0, 0.1], [0.0, 0.4, 0.1], [0.5, 0.0, -0.1], [0.0, 0.4, -0.1]])
DYNAMICS = NetworkDynamics(
    MLP.from_layers([np.hstack([np.zeros((2 * K, 2 * K + 2 * N_Q)), A])], [np.zeros(2 * K)]), 2 * K, N_Q
)
Z0 = np.array([-0.3, -0.1, -0.2, 0.0])
GOAL = np.array([0.1, 0.2, 0.2, 0.3])
INNER = InnerLoop(5, 2e-2)


def demonstration(weights, solver=INNER.solver, efforts=0.0):
    """What the solver plans with a known cost, as if it had been seen."""
    cost = PlanningCost(weights, np.full(T, efforts), solver)
    s0 = DYNAMICS.state(Z0, np.zeros(N_Q))
    plan = solver.solve(planning_problem(DYNAMICS, T), s0, cost.psi, GOAL)
    return Demonstration(s0, GOAL, plan.states[:, : 2 * K])


def track(start, end, steps=T):
    """K keypoints that go straight from start to end (K, 2), with mu = 0.9."""
    path = np.linspace(start, end, steps + 1)
    return np.concatenate([path, np.full((steps + 1, K, 1), 0.9)], axis=-1)


@dataclass
class LinearPlant:
    """Follows the linear model, executes only `gain` of every command, and sees nonsense at times."""

    gain: float = 1.0
    nonsense: tuple = ()  # looks at which all keypoints are nonsense, and the first has mu = 0.01
    z: np.ndarray = field(default_factory=Z0.copy)
    theta: np.ndarray = field(default_factory=lambda: np.zeros(N_Q))
    looks: int = 0

    def look(self):
        seen = np.column_stack([self.z.reshape(K, 2), np.full(K, 0.9)])
        if self.looks in self.nonsense:
            seen[:, :2] = [0.7, -0.7]
            seen[0, 2] = 0.01
        self.looks += 1
        return Sight(seen, self.theta.copy(), np.zeros(N_Q))

    def act(self, u):
        self.z, self.theta = self.z + self.gain * A @ u, self.theta + self.gain * u


def converged_cost():
    return PlanningCost(np.linspace(1, 3, T)[:, None] * np.ones(2 * K), np.linspace(2.0, 1.0, T), CONVERGED)


def test_mu_is_no_part_of_z():
    assert positions([[[1, 2, 0.5], [3, 4, 0.1]]]).tolist() == [[1, 2, 3, 4]]


def test_a_robots_own_demonstration_is_what_was_seen_from_where_it_was():
    keypoints = track([[0, 0], [0.1, 0]], [[0.3, 0], [0.4, 0]])
    joints = np.arange(T + 1.0)[:, None] * np.ones(N_Q)
    seen = robot_demonstration(
        DYNAMICS, ArmTrack(keypoints, np.arange(T + 1.0), joints, 2 * joints + 1, np.diff(joints, axis=0))
    )
    assert np.array_equal(seen.s0, [0, 0, 0.1, 0, 0, 0, 0, 1, 1, 1])
    assert np.array_equal(seen.context, [0.3, 0, 0.4, 0])
    assert seen.observations.shape == (T + 1, 2 * K)


def test_a_persons_demonstration_starts_at_the_robots_keypoints_and_keeps_the_persons_displacement():
    clip = KeypointTrack(track([[0.5, 0.5], [0.6, 0.5]], [[0.9, 0.8], [0.9, 0.9]]), np.arange(T + 1.0))
    own = np.array([[-0.4, 0.1, 1.0], [-0.3, 0.0, 1.0]])
    moved = transferred_demonstration(DYNAMICS, clip, own, np.ones(N_Q))
    assert np.allclose(moved.observations[0], positions(own), atol=1e-15)
    assert np.allclose(moved.context - positions(own), [0.4, 0.3, 0.3, 0.4], atol=1e-15)
    assert np.array_equal(moved.s0[2 * K :], [1, 1, 1, 0, 0, 0])


def test_a_person_and_a_robot_with_other_keypoints_do_not_go_together():
    clip = KeypointTrack(track([[0, 0], [0, 0]], [[1, 1], [1, 1]]), np.arange(T + 1.0))
    with pytest.raises(ProblemError, match="3 keypoints, the demonstration has 2"):
        transferred_demonstration(DYNAMICS, clip, np.zeros((3, 3)), np.ones(N_Q))


def test_a_keypoint_in_the_background_does_not_move():
    seen = positions(track([[0, 0], [0.5, 0.5]], [[0.4, 0], [0.51, 0.5]]))
    assert moving_keypoints([Demonstration(seen[0], seen[-1], seen)]).tolist() == [True, False]


def test_relative_distance_counts_the_chosen_coordinates_only():
    seen = np.array([[0.0, 0.0], [1.0, 0.0]])
    demo = Demonstration(np.zeros(1), np.zeros(0), np.array([[0.0, 0.0], [2.0, 4.0]]))
    assert relative_distance(seen, demo) == pytest.approx(np.sqrt(17 / 20), rel=1e-15)
    assert relative_distance(seen, demo, np.array([True, False])) == 0.5


@pytest.mark.parametrize("name", COSTS)
def test_every_member_of_the_family_is_a_cost_of_the_one_planning_problem(name):
    cost = KeypointCost(COSTS[name], effort=(0.5,) * T, learn_effort=True, positivity="exp")
    psi = np.random.default_rng(0).normal(size=cost.n_parameters(T, 2 * K))
    planned = PlanningCost.of(cost, psi, T, 2 * K, CONVERGED)
    states, actions = np.random.default_rng(1).normal(size=(2 * K + 2 * N_Q, T + 1)), np.ones((N_Q, T))
    member = network_ocp(DYNAMICS, cost, T).cost(states, actions, psi, GOAL)
    same = planning_problem(DYNAMICS, T).cost(states, actions, planned.psi, GOAL)
    assert float(same) == pytest.approx(float(member), rel=1e-13)


def test_after_some_steps_the_rest_of_the_cost_is_left_and_nothing_beyond_the_end():
    cost = PlanningCost(np.arange(8.0).reshape(4, 2), np.array([1.0, 2.0, 3.0, 4.0]), CONVERGED).after(3)
    assert cost.weights.tolist() == [[6, 7], [0, 0], [0, 0], [0, 0]]
    assert cost.efforts.tolist() == [4, 4, 4, 4]
    with pytest.raises(ProblemError, match="within the plan of 4"):
        cost.after(5)


def stopped_cost():
    """A cost for N gradient steps, with a negative weight: more steps would go ever farther."""
    return PlanningCost(np.tile([1.0, 1.5, -0.1, 0.5], (T, 1)), np.zeros(T), INNER.solver)


@pytest.mark.parametrize(("cost", "accuracy"), [(converged_cost(), 1e-8), (stopped_cost(), 1e-15)])
def test_with_a_true_model_planning_again_changes_nothing(cost, accuracy):
    """Bellman's principle where the solver converges."""
    runs = [KeypointController.build(DYNAMICS, cost, closed).run(LinearPlant(), GOAL) for closed in (False, True)]
    assert np.allclose(runs[0].actions, runs[1].actions, atol=accuracy)
    assert [len(run.plans) for run in runs] == [1, T]
    assert all(run.tracking_error < 1e-15 for run in runs)


def test_a_converged_solver_plans_again_from_what_is_seen():
    cost, plant = converged_cost(), LinearPlant(gain=0.6)
    done = KeypointController.build(DYNAMICS, cost).run(plant, GOAL)
    seen = DYNAMICS.state(done.believed[2], done.joints[2])
    anew = cost.solver.solve(planning_problem(DYNAMICS, T), seen, cost.after(2).psi, GOAL)
    assert np.allclose(done.actions[2], anew.actions[0], atol=1e-8)


@pytest.mark.parametrize(
    ("cost", "share"),
    [(converged_cost(), 0.31), (PlanningCost(np.ones((T, 2 * K)), np.zeros(T), INNER.solver), 0.68)],
)
def test_planning_again_makes_up_for_an_arm_that_falls_short(cost, share):
    def miss(closed):
        done = KeypointController.build(DYNAMICS, cost, closed).run(LinearPlant(gain=0.6), GOAL)
        assert done.tracking_error == pytest.approx(0.4 * np.sqrt(np.mean(done.actions**2)), rel=1e-12)
        return np.linalg.norm(positions(done.keypoints[-1]) - GOAL)

    assert miss(closed=True) < share * miss(closed=False)


def test_where_the_detector_is_not_sure_of_a_keypoint_all_are_predicted_instead():
    calm = KeypointController.build(DYNAMICS, converged_cost()).run(LinearPlant(), GOAL)
    careful = KeypointController.build(DYNAMICS, converged_cost(), confidence=0.5).run(
        LinearPlant(nonsense=(2, 3)), GOAL
    )
    trusting = KeypointController.build(DYNAMICS, converged_cost()).run(LinearPlant(nonsense=(2, 3)), GOAL)
    assert np.allclose(careful.actions, calm.actions, atol=1e-8)
    assert np.abs(trusting.actions - calm.actions).max() > 0.1
    assert careful.keypoints[2, 0].tolist() == [0.7, -0.7, 0.01]  # what was seen is kept as it was


def test_a_goal_of_another_length_is_refused():
    with pytest.raises(ProblemError, match=r"goal must be \(4,\)"):
        KeypointController.build(DYNAMICS, converged_cost()).run(LinearPlant(), np.zeros(6))


@pytest.mark.parametrize("name", COSTS)
def test_a_demonstration_that_the_family_can_express_is_learned(name):
    basis = COSTS[name]
    kernels = np.random.default_rng(3).uniform(0.2, 2.0, (basis.matrix(T).shape[1], 2 * K))
    wanted = demonstration(basis.matrix(T) @ kernels)
    rng = np.random.default_rng(0)
    learned = learn_unrolled(DYNAMICS, [wanted], basis, INNER, 300, rng, Adam(3e-2))
    assert learned.losses[learned.best] < 1e-3 * learned.losses[0]
    planned = learned.cost.solver.solve(planning_problem(DYNAMICS, T), wanted.s0, learned.cost.psi, GOAL)
    assert np.sum((planned.states[:, : 2 * K] - wanted.observations) ** 2) == pytest.approx(
        learned.losses.min(), rel=1e-9
    )


@pytest.mark.parametrize("effort", ["fixed", "learned", "learned per step"])
def test_the_converged_problem_learns_it_too_with_or_without_effort(effort):
    wanted = demonstration(np.tile([0.3, 1.5, 1.0, 0.8], (T, 1)), CONVERGED, 5.0)
    inner = InnerLoop(5, 1 / (2 * 5 * 5.0))
    assert inner.effort == pytest.approx(5.0)
    learned = learn_implicit(DYNAMICS, [wanted], COSTS["Weighted"], inner, 40, np.random.default_rng(0), effort=effort)
    assert learned.losses.min() < 1e-3 * learned.losses[0]
    assert (learned.cost.weights > 0).all()
    assert (learned.cost.efforts > 0).all()


def test_unrolled_learning_can_learn_effort_too():
    wanted = demonstration(np.ones((T, 2 * K)), efforts=3.0)
    rngs = [np.random.default_rng(0), np.random.default_rng(0)]
    without = learn_unrolled(DYNAMICS, [wanted], COSTS["Weighted"], INNER, 40, rngs[0], Adam(3e-2))
    with_it = learn_unrolled(DYNAMICS, [wanted], COSTS["Weighted"], INNER, 40, rngs[1], Adam(3e-2), learn_effort=True)
    assert not without.cost.efforts.any()
    assert with_it.cost.efforts[0] > 0


def test_the_baseline_keeps_its_best_iterate():
    wanted = demonstration(np.tile([0.3, 1.5, 1.0, 0.8], (T, 1)))
    learned = learn_by_apprenticeship(DYNAMICS, [wanted], INNER, 5, np.random.default_rng(0))
    assert learned.best == int(np.argmin(learned.losses))
    assert learned.cost.weights.shape == (T, 2 * K)


def test_demonstrations_of_different_lengths_are_refused():
    short, long = (Demonstration(np.zeros(10), GOAL, np.zeros((n + 1, 2 * K))) for n in (3, 4))
    with pytest.raises(ProblemError, match=r"one length, got T = \[3, 4\]"):
        learn_unrolled(DYNAMICS, [short, long], COSTS["Weighted"], INNER, 1, np.random.default_rng(0))


def test_joints_without_influence_on_the_model_are_not_moved_by_any_plan():
    held = without_joints(DYNAMICS, [0, 2])
    s0, u = DYNAMICS.state(Z0, np.array([0.3, 0.2, 0.1])), np.array([0.0, 0.5, 0.0])
    followed, original = (np.array(model.function(0)(s0, u, [])) for model in (held, DYNAMICS))
    assert np.array_equal(followed, original)  # the other joint acts as before
    for solver in (CONVERGED, INNER.solver):
        cost = PlanningCost(np.ones((T, 2 * K)), np.full(T, 0.1), solver)
        plan = solver.solve(planning_problem(held, T), s0, cost.psi, GOAL)
        assert np.abs(plan.actions[:, [0, 2]]).max() < 1e-12
        assert np.abs(plan.actions[:, 1]).max() > 1e-3
