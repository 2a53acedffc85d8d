"""The paper's simulation study (section "Illustrative Comparison with Feature-Matching IRL").

For a task and a seed: one training demonstration, five test demonstrations with other starts and goals. A Weighted cost
is learned by the paper's method (unrolled gradient steps), by the implicit gradient of the converged OCP, and by
apprenticeship learning with the paper's inner loop; the cost of every outer iteration plans on the test demonstrations.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kpirl_ocp.episodes import Episode, read_episodes
from kpirl_ocp.irl.cases.tasks import HORIZON, as_demonstration
from kpirl_ocp.irl.hypergradients.implicit import Implicit
from kpirl_ocp.irl.hypergradients.unrolled import Unrolled
from kpirl_ocp.irl.learning.apprenticeship import apprenticeship
from kpirl_ocp.irl.learning.evaluation import evaluate
from kpirl_ocp.irl.learning.learn import learn
from kpirl_ocp.irl.learning.optimisers import LBFGS, Adam
from kpirl_ocp.irl.learning.result import LearningResult
from kpirl_ocp.ocp.models.keypoint_costs import Default, KeypointCost, Weighted
from kpirl_ocp.ocp.models.keypoint_problems import keypoint_ocp
from kpirl_ocp.ocp.models.robot import Robot
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Solver
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.types import Array, Demonstration


@dataclass(frozen=True)
class StudySettings:
    """Numbers of the study.

    iterations: outer iterations of every method. tests: test demonstrations.
    inner_steps, step_size: N and alpha of the inner loop; alpha is the paper's, N was chosen among 1, 2, 5, 10 and 20
        on validation demonstrations of seeds that the study does not use.
    learning_rate: of Adam on psi; the paper's code uses the same.
    """

    iterations: int = 100
    tests: int = 5
    horizon: int = HORIZON
    inner_steps: int = 5
    step_size: float = 1e-2
    learning_rate: float = 1e-2

    @property
    def inner(self) -> GradientDescent:
        """The paper's inner loop."""
        return GradientDescent(self.inner_steps, self.step_size)

    @property
    def effort(self) -> float:
        """rho of about 1 / (2 alpha N), which lets a converged problem move as far as N gradient steps."""
        return 1 / (2 * self.step_size * self.inner_steps)


@dataclass(frozen=True)
class Curve:
    """One method on one task and seed; row k belongs to psi after k outer iterations.

    train: (n,) IRL loss on the training demonstration. test: (n,) mean IRL loss on the test demonstrations.
    distance: (n,) mean relative distance there. best: the row with the lowest training loss, whose psi is kept.
    seconds: of learning alone.
    """

    train: Array
    test: Array
    distance: Array
    best: int
    seconds: float


METHODS = (
    "unrolled",
    "implicit, scalar effort",
    "implicit, effort per step",
    "apprenticeship",
    "default",
)


def run_case(directory: Path, seed: int, settings: StudySettings) -> dict[str, Curve]:
    """All methods on the episodes of a directory, the first for training, the others for testing."""
    robot, (episodes, _) = Robot.iiwa(), read_episodes(directory, Episode)
    demonstrations = [as_demonstration(robot, episode) for episode in episodes]
    train, test = demonstrations[:1], demonstrations[1:]
    rng = np.random.default_rng(seed)
    scale = rng.uniform(0.5, 1.5, 3 * robot.n_keypoints)  # starting weights, the same for every method
    return {
        "unrolled": _unrolled(robot, train, test, scale, settings),
        "implicit, scalar effort": _implicit(robot, train, test, scale, settings.effort, settings),
        "implicit, effort per step": _implicit(
            robot, train, test, scale, (settings.effort,) * settings.horizon, settings
        ),
        "apprenticeship": _apprenticeship(robot, train, test, rng, settings),
        "default": _default(robot, train, test, settings),
    }


def _unrolled(
    robot: Robot, train: list[Demonstration], test: list[Demonstration], scale: Array, settings: StudySettings
) -> Curve:
    problem = keypoint_ocp(robot, KeypointCost(Weighted()), settings.horizon).unconstrained()
    method, optimiser = Unrolled(settings.inner), Adam(settings.learning_rate)
    result = learn(problem, train, scale, method, optimiser, settings.iterations, progress=False)
    return _curve_of(result, problem, settings.inner, test)


def _implicit(
    robot: Robot,
    train: list[Demonstration],
    test: list[Demonstration],
    scale: Array,
    effort: float | tuple[float, ...],
    settings: StudySettings,
) -> Curve:
    cost = KeypointCost(Weighted(), effort=effort, learn_effort=True, positivity="softplus")
    problem = keypoint_ocp(robot, cost, settings.horizon)
    psi0 = cost.initial(settings.horizon, len(scale), scale)
    result = learn(problem, train, psi0, Implicit(), LBFGS(), settings.iterations, progress=False)
    return _curve_of(result, problem, Riccati(), test)


def _apprenticeship(
    robot: Robot,
    train: list[Demonstration],
    test: list[Demonstration],
    rng: np.random.Generator,
    settings: StudySettings,
) -> Curve:
    problem = keypoint_ocp(robot, KeypointCost(Weighted()), settings.horizon).unconstrained()
    result = apprenticeship(problem, train, settings.inner, settings.iterations, rng)
    test_losses, distances = _on_tests(problem, settings.inner, result.psis, test)
    return Curve(result.losses, test_losses, distances, int(np.argmin(result.losses)), result.seconds)


def _default(robot: Robot, train: list[Demonstration], test: list[Demonstration], settings: StudySettings) -> Curve:
    problem = keypoint_ocp(robot, KeypointCost(Default()), settings.horizon).unconstrained()
    trained = evaluate(problem, settings.inner, (), train).losses
    test_losses, distances = _on_tests(problem, settings.inner, np.zeros((1, 0)), test)
    return Curve(trained, test_losses, distances, 0, 0.0)


def _curve_of(result: LearningResult, problem: OCP, solver: Solver, test: list[Demonstration]) -> Curve:
    test_losses, distances = _on_tests(problem, solver, result.psis, test)
    return Curve(result.losses, test_losses, distances, int(np.argmin(result.losses)), float(result.seconds[-1]))


def _on_tests(problem: OCP, solver: Solver, psis: Array, test: list[Demonstration]) -> tuple[Array, Array]:
    """Mean test loss (n,) and relative distance (n,) for psis (n, n_psi)."""
    results = [evaluate(problem, solver, psi, test) for psi in psis]
    return (
        np.array([result.losses.mean() for result in results]),
        np.array([result.relative_distances.mean() for result in results]),
    )
