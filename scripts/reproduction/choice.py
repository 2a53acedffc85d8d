"""The choice of the inner loop, for every task, on validation demonstrations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kpirl_ocp.errors import CertificateError, ProblemError
from kpirl_ocp.irl.learning.evaluation import evaluate
from kpirl_ocp.irl.visual.learning import COSTS, InnerLoop, horizon_of
from kpirl_ocp.irl.visual.planning_costs import PlanningCost, planning_problem
from kpirl_ocp.types import Demonstration
from reproduction.contenders import Contender
from reproduction.data import Models
from reproduction.learning import Lesson, learn
from reproduction.sweep import Job, Result


def jobs(
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
