"""Learn a cost, by any of the methods, as one job; and the choice of the inner loop on validation demonstrations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kpirl_ocp.errors import CertificateError, ProblemError
from kpirl_ocp.irl.learning.evaluation import evaluate
from kpirl_ocp.irl.learning.optimisers import Descent
from kpirl_ocp.irl.visual.learning import (
    CONVERGED,
    COSTS,
    InnerLoop,
    LearnedPlan,
    horizon_of,
    learn_by_apprenticeship,
    learn_implicit,
    learn_unrolled,
)
from kpirl_ocp.irl.visual.planning_costs import PlanningCost, planning_problem
from kpirl_ocp.ocp.models.keypoint_costs import Default, KeypointCost
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.types import Demonstration
from reproduction.data import Models
from reproduction.identification import identified
from reproduction.settings import LARGER_RATE, PAPER_LOOP, PAPER_START, PRINTED_RATE
from reproduction.sweep import Job, Result


@dataclass(frozen=True)
class Contender:
    """A cost family and a method to learn it."""

    cost: str
    method: str

    @property
    def label(self) -> str:
        """Name in tables and figures."""
        method, *rest = self.method.split(", ")
        first = {"unrolled": self.cost, "implicit": f"{self.cost}, converged"}.get(method, method.capitalize())
        return ", ".join([first, *rest])

    def inner_loop(self, chosen: InnerLoop) -> InnerLoop:
        """The paper's, or the one that was chosen; it also sets the effort of the converged problem."""
        return chosen if "more steps" in self.method or "implicit" in self.method else PAPER_LOOP


UNROLLED = tuple(Contender(cost, "unrolled") for cost in COSTS)
LITERAL = tuple(Contender(cost, "unrolled, to the letter") for cost in COSTS)
SMALL_START = tuple(Contender(cost, "unrolled, small start") for cost in COSTS)
MORE_STEPS = tuple(Contender(cost, "unrolled, more steps") for cost in COSTS)
APPRENTICE = Contender("Weighted", "apprenticeship")
DEFAULT = Contender("Weighted", "default")  # has nothing to learn
DEFAULT_MORE_STEPS = Contender("Weighted", "default, more steps")
IMPLICIT = tuple(Contender(cost, "implicit") for cost in COSTS)
EFFORT = (  # a single step from u = 0 knows no effort
    Contender("Weighted", "unrolled, more steps, effort learned"),
    Contender("Weighted", "implicit, effort learned"),
    Contender("Weighted", "implicit, effort per step"),
)
_DESCENT = {"unrolled, to the letter": PRINTED_RATE, "unrolled, small start": LARGER_RATE}


@dataclass(frozen=True)
class Lesson:
    """A task of learning: contender, inner loop, outer iterations, and the seed of the starting weights."""

    contender: Contender
    inner: InnerLoop
    iterations: int
    seed: int


def learn(dynamics: NetworkDynamics, demonstrations: Sequence[Demonstration], lesson: Lesson) -> LearnedPlan:
    """A cost of the contender's family."""
    method, inner, iterations = lesson.contender.method, lesson.inner, lesson.iterations
    basis, rng = COSTS[lesson.contender.cost], np.random.default_rng(lesson.seed)
    if method.startswith("default"):
        planned = PlanningCost.default(horizon_of(demonstrations), dynamics.n_z, inner.solver)
        losses = np.array([_mean_loss(dynamics, planned, demonstrations)])
        return LearnedPlan(planned, KeypointCost(Default()), np.zeros(0), losses, 0, 0.0)
    if method == "apprenticeship":
        return learn_by_apprenticeship(dynamics, demonstrations, inner, iterations, rng)
    if method in _DESCENT:
        optimiser = Descent(_DESCENT[method])
        return learn_unrolled(dynamics, demonstrations, basis, inner, iterations, rng, optimiser, start=PAPER_START)
    if method.startswith("unrolled"):
        effort = "learned" if "effort" in method else None
        return learn_unrolled(dynamics, demonstrations, basis, inner, iterations, rng, effort=effort)
    kinds = {
        "implicit": "fixed",
        "implicit, effort learned": "learned",
        "implicit, effort per step": "learned per step",
    }
    return learn_implicit(dynamics, demonstrations, basis, inner, iterations, rng, effort=kinds[method])


def learn_or_fail(dynamics: NetworkDynamics, demonstrations: Sequence[Demonstration], lesson: Lesson) -> Result:
    """The result of a job that learns a cost (`unpacked` gives it back), or the "failure" that the report will name."""
    try:
        learned = learn(dynamics, demonstrations, lesson)
    except CertificateError as error:
        return {"failure": str(error)}
    method = lesson.contender.method
    by_loss = method.startswith(("unrolled", "implicit")) and "effort" not in method
    intervals = identified(dynamics, demonstrations, learned, lesson.inner) if by_loss else {}
    return intervals | {
        "failure": "",
        "weights": learned.cost.weights,
        "efforts": learned.cost.efforts,
        "losses": learned.losses,
        "best": learned.best,
        "seconds": learned.seconds,
        "converged": lesson.contender.method.startswith("implicit"),
        "steps": lesson.inner.steps,
        "step_size": lesson.inner.step_size,
        "capped": len(learned.losses) > lesson.iterations,
    }


def unpacked(result: Result) -> PlanningCost:
    """The cost in the result of a job, with the solver that it was learned with."""
    inner = InnerLoop(int(result["steps"]), float(result["step_size"]))
    solver = CONVERGED if result["converged"] else inner.solver
    return PlanningCost(result["weights"], result["efforts"], solver)


def choice_jobs(
    task: str,
    models: Models,
    demonstrations: Sequence[Demonstration],
    inner_loops: Sequence[InnerLoop],
    iterations: int,
) -> list[Job]:
    """For every inner loop and cost: learn from the first validation demonstration, judge on the others."""
    return [
        Job(
            f"choice/{task}-{inner.steps}-{inner.step_size:g}-{cost}",
            try_inner_loop,
            {
                "task": task,
                "models": models,
                "demonstrations": list(demonstrations),
                "inner": inner,
                "cost": cost,
                "iterations": iterations,
            },
        )
        for inner in inner_loops
        for cost in COSTS
    ]


def try_inner_loop(
    task: str,
    models: Models,
    demonstrations: list[Demonstration],
    inner: InnerLoop,
    cost: str,
    iterations: int,
) -> Result:
    """Validation loss and relative distance, one per demonstration learned from, and those of Default.

    The loss is infinite where learning broke down.
    """
    dynamics = models.load_dynamics(task)
    problem = planning_problem(dynamics, horizon_of(demonstrations))
    default = PlanningCost.default(problem.horizon, dynamics.n_z, inner.solver)
    plain = evaluate(problem, demonstrations, default.psi, default.solver)
    found = []
    for index, demonstration in enumerate(demonstrations):
        others = demonstrations[:index] + demonstrations[index + 1 :]
        try:
            learned = learn(dynamics, [demonstration], Lesson(Contender(cost, "unrolled"), inner, iterations, index))
        except CertificateError:  # NaN: the steps are too long
            found.append((np.inf, np.inf))
            continue
        judged = evaluate(problem, others, learned.cost.psi, learned.cost.solver)
        found.append((judged.losses.mean(), judged.relative_distances.mean()))
    losses, distances = np.array(found).T
    return {
        "validation": losses,
        "distance": distances,
        "default_loss": plain.losses.mean(),
        "default_distance": plain.relative_distances.mean(),
    }


@dataclass(frozen=True)
class Tried:
    """An inner loop on validation demonstrations: IRL loss and relative distance in the mean over the costs."""

    inner: InnerLoop
    loss: float
    distance: float
    default_loss: float
    default_distance: float


def tried(results: dict[str, Result], task: str, inner_loops: Sequence[InnerLoop]) -> list[Tried]:
    """Validation results of every candidate."""
    found = []
    for inner in inner_loops:
        names = [f"choice/{task}-{inner.steps}-{inner.step_size:g}-{cost}" for cost in COSTS]
        keys = ("validation", "distance", "default_loss", "default_distance")
        found.append(Tried(inner, *(float(np.mean([results[name][key].mean() for name in names])) for key in keys)))
    return found


def choose(task: str, candidates: Sequence[Tried]) -> InnerLoop:
    """The inner loop with the lowest validation loss of the learned costs."""
    able = [candidate for candidate in candidates if np.isfinite(candidate.loss)]
    if not able:
        raise ProblemError(f"no inner loop can learn {task}: choose smaller steps.")
    return min(able, key=lambda candidate: candidate.loss).inner


def _mean_loss(dynamics: NetworkDynamics, cost: PlanningCost, demonstrations: Sequence[Demonstration]) -> float:
    problem = planning_problem(dynamics, cost.horizon)
    return float(evaluate(problem, demonstrations, cost.psi, cost.solver).losses.mean())
