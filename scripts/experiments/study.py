"""The paper's simulation study (section "Illustrative Comparison with Feature-Matching IRL"), with more contenders.

For a task and a seed: one training demonstration, five test demonstrations with other starts and goals, and a Weighted
cost learned by every method. The cost of every outer iteration plans on the test demonstrations, in the way that its
method plans: the same gradient steps, or the converged problem with the learned effort.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kpirl_ocp.episodes import Episode, read_episodes
from kpirl_ocp.irl.baselines.inverse_kkt import inverse_kkt
from kpirl_ocp.irl.baselines.max_entropy import max_entropy
from kpirl_ocp.irl.baselines.single_level import single_level
from kpirl_ocp.irl.cases.tasks import HORIZON, as_demonstration
from kpirl_ocp.irl.hypergradients.implicit import Implicit
from kpirl_ocp.irl.hypergradients.unrolled import Unrolled
from kpirl_ocp.irl.learning.apprenticeship import apprenticeship
from kpirl_ocp.irl.learning.evaluation import evaluate
from kpirl_ocp.irl.learning.learn import learn
from kpirl_ocp.irl.learning.optimisers import LBFGS, Adam, Descent
from kpirl_ocp.irl.visual.learning import InnerLoop
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
    printed_*: of Algorithm 1 to the letter: alpha, eta, the start of the paper's code, and as many iterations as in
        section 5.2, of which every `printed_stride`-th is kept.
    """

    iterations: int = 100
    tests: int = 5
    horizon: int = HORIZON
    inner_steps: int = 5
    step_size: float = 1e-2
    learning_rate: float = 1e-2
    printed_step_size: float = 1e-2
    printed_rate: float = 1e-3
    printed_start: float = 1e-2
    printed_iterations: int = 5000
    printed_stride: int = 50

    @property
    def inner(self) -> GradientDescent:
        """The inner loop of N steps."""
        return InnerLoop(self.inner_steps, self.step_size).solver

    @property
    def effort(self) -> float:
        """The effort weight with which the converged plan moves about as far."""
        return InnerLoop(self.inner_steps, self.step_size).effort


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


@dataclass(frozen=True, eq=False)
class Case:
    """The common input of all methods.

    train, test: demonstrations. actions: (T, n_u) of the training one. start: (9,) of the weights, the same for all.
    """

    robot: Robot
    train: list[Demonstration]
    test: list[Demonstration]
    actions: Array
    start: Array
    seed: int
    settings: StudySettings

    @classmethod
    def read(cls, directory: Path, seed: int, settings: StudySettings) -> Case:
        """The case of the episodes in a directory: the first for training, the others for testing."""
        robot, (episodes, _) = Robot.iiwa(), read_episodes(directory, Episode)
        demonstrations = [as_demonstration(robot, episode) for episode in episodes]
        start = np.random.default_rng(seed).uniform(0.5, 1.5, 3 * robot.n_keypoints)
        return cls(robot, demonstrations[:1], demonstrations[1:], episodes[0].actions, start, seed, settings)

    def problem(self, cost: KeypointCost) -> OCP:
        """Planning with a cost, without joint limits."""
        return keypoint_ocp(self.robot, cost, self.settings.horizon).unconstrained()

    def curve(self, problem: OCP, solver: Solver, psis: Array, seconds: float) -> Curve:
        """Losses and distances of psis (n, n_psi)."""
        trained = np.array([evaluate(problem, self.train, psi, solver).losses.mean() for psi in psis])
        tested = [evaluate(problem, self.test, psi, solver) for psi in psis]
        losses = np.array([result.losses.mean() for result in tested])
        distances = np.array([result.relative_distances.mean() for result in tested])
        return Curve(trained, losses, distances, int(np.argmin(trained)), seconds)


def _unrolled(case: Case) -> Curve:
    settings, problem = case.settings, case.problem(KeypointCost(Weighted()))
    optimiser = Adam(settings.learning_rate)
    result = learn(
        problem, case.train, case.start, Unrolled(settings.inner), optimiser, settings.iterations, progress=False
    ).raise_if_interrupted()
    return case.curve(problem, settings.inner, result.psis, float(result.seconds[-1]))


def _to_the_letter(case: Case) -> Curve:
    """Algorithm 1 as printed: one step, plain descent, and the small start of the paper's code."""
    settings, problem = case.settings, case.problem(KeypointCost(Weighted()))
    solver, start = GradientDescent(1, settings.printed_step_size), np.full_like(case.start, settings.printed_start)
    iterations = min(settings.printed_iterations, settings.iterations * settings.printed_stride)
    optimiser = Descent(settings.printed_rate)
    result = learn(
        problem, case.train, start, Unrolled(solver), optimiser, iterations, progress=False
    ).raise_if_interrupted()
    return case.curve(problem, solver, result.psis[:: settings.printed_stride], float(result.seconds[-1]))


def _implicit(case: Case, effort: float | tuple[float, ...]) -> Curve:
    settings = case.settings
    cost = KeypointCost(Weighted(), effort=effort, learn_effort=True, positivity="softplus")
    problem = keypoint_ocp(case.robot, cost, settings.horizon)
    psi0 = cost.initial(settings.horizon, len(case.start), case.start)
    result = learn(
        problem, case.train, psi0, Implicit(), LBFGS(), settings.iterations, progress=False
    ).raise_if_interrupted()
    return case.curve(problem, Riccati(), result.psis, float(result.seconds[-1]))


def _apprenticeship(case: Case) -> Curve:
    settings, problem = case.settings, case.problem(KeypointCost(Weighted()))
    rng = np.random.default_rng(case.seed)
    result = apprenticeship(problem, case.train, settings.inner, settings.iterations, rng)
    return case.curve(problem, settings.inner, result.psis, result.seconds)


def _default(case: Case) -> Curve:
    problem = case.problem(KeypointCost(Default()))
    return case.curve(problem, case.settings.inner, np.zeros((1, 0)), 0.0)


def _at_once(case: Case, method: Callable[[OCP, Array], Array]) -> Curve:
    """A method without outer iterations: weights and one effort, from the same start, planned to convergence."""
    cost = KeypointCost(Weighted(), effort=case.settings.effort, learn_effort=True)
    problem = case.problem(cost)
    psi0 = cost.initial(case.settings.horizon, len(case.start), case.start)
    started = time.perf_counter()
    psi = method(problem, psi0)
    return case.curve(problem, Riccati(), psi[None], time.perf_counter() - started)


def _single_level(problem: OCP, train: list[Demonstration], psi0: Array) -> Array:
    """With at least a hundredth of the effort: without any, motions are stationary that no plan would choose."""
    least = np.append(np.zeros(len(psi0) - 1), 0.01 * psi0[-1])
    return single_level(problem, train, psi0, Riccati(), least=least).psi


METHODS: Mapping[str, Callable[[Case], Curve]] = {
    "unrolled": _unrolled,
    "to the letter": _to_the_letter,
    "implicit, scalar effort": lambda case: _implicit(case, case.settings.effort),
    "implicit, effort per step": lambda case: _implicit(case, (case.settings.effort,) * case.settings.horizon),
    "apprenticeship": _apprenticeship,
    "inverse KKT": lambda case: _at_once(case, lambda p, _: inverse_kkt(p, case.train, [case.actions])),
    "maximum entropy": lambda case: _at_once(case, lambda p, psi0: max_entropy(p, case.train, [case.actions], psi0)),
    "single level": lambda case: _at_once(case, lambda p, psi0: _single_level(p, case.train, psi0)),
    "default": _default,
}


DRAWN = ("unrolled", "to the letter", "implicit, scalar effort", "implicit, effort per step", "apprenticeship")


def run_case(case: Case) -> dict[str, Curve]:
    """All methods."""
    return {name: method(case) for name, method in METHODS.items()}
