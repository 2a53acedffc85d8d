"""Learn a cost, by any of the methods, as one job; and the choice of the inner loop on validation demonstrations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kpirl_ocp.errors import CertificateError, ProblemError
from kpirl_ocp.irl.evaluation import evaluate
from kpirl_ocp.irl.visual_costs import PlanningCost, planning_problem
from kpirl_ocp.irl.visual_learning import (
    CONVERGED,
    COSTS,
    InnerLoop,
    LearnedPlan,
    horizon_of,
    learn_by_apprenticeship,
    learn_implicit,
    learn_unrolled,
)
from kpirl_ocp.ocp.network_dynamics import NetworkDynamics
from kpirl_ocp.types import Demonstration
from reproduction.data import Models
from reproduction.sweep import Job, Result

METHODS = (
    "unrolled",
    "unrolled, effort learned",
    "implicit",
    "implicit, effort learned",
    "implicit, effort per step",
    "apprenticeship",
    "default",
)


def learn(
    dynamics: NetworkDynamics,
    demonstrations: Sequence[Demonstration],
    cost: str,
    method: str,
    inner: InnerLoop,
    iterations: int,
    seed: int,
) -> LearnedPlan:
    """A cost of the family, learned by one of METHODS; "default" has nothing to learn."""
    rng = np.random.default_rng(seed)
    if method == "default":
        planned = PlanningCost.default(horizon_of(demonstrations), dynamics.n_z, inner.solver)
        return LearnedPlan(planned, np.array([_mean_loss(dynamics, planned, demonstrations)]), 0, 0.0)
    if method == "apprenticeship":
        return learn_by_apprenticeship(dynamics, demonstrations, inner, iterations, rng)
    if method.startswith("unrolled"):
        effort = "learned" if "effort" in method else None
        return learn_unrolled(dynamics, demonstrations, COSTS[cost], inner, iterations, rng, effort=effort)
    kinds = {
        "implicit": "fixed",
        "implicit, effort learned": "learned",
        "implicit, effort per step": "learned per step",
    }
    return learn_implicit(dynamics, demonstrations, COSTS[cost], inner, iterations, rng, effort=kinds[method])


def learn_or_fail(
    dynamics: NetworkDynamics,
    demonstrations: Sequence[Demonstration],
    cost: str,
    method: str,
    inner: InnerLoop,
    iterations: int,
    seed: int,
) -> Result:
    """What a job returns of a learned cost (`unpacked` gives it back), or the "failure" that the report will name."""
    try:
        learned = learn(dynamics, demonstrations, cost, method, inner, iterations, seed)
    except CertificateError as error:
        return {"failure": str(error)}
    return {
        "failure": "",
        "weights": learned.cost.weights,
        "efforts": learned.cost.efforts,
        "losses": learned.losses,
        "best": learned.best,
        "seconds": learned.seconds,
        "converged": method.startswith("implicit"),
    }


def unpacked(result: Result, inner: InnerLoop) -> PlanningCost:
    """The cost in the result of a job."""
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
    """Training and validation losses, one per demonstration learned from; infinite where learning broke down."""
    dynamics = models.load_dynamics(task)
    train, validation = [], []
    for index, demonstration in enumerate(demonstrations):
        others = demonstrations[:index] + demonstrations[index + 1 :]
        try:
            learned = learn(dynamics, [demonstration], cost, "unrolled", inner, iterations, seed=index)
        except CertificateError:  # NaN: the steps are too long
            return {"train": np.full(1, np.inf), "validation": np.full(1, np.inf)}
        train.append(learned.losses.min())
        validation.append(_mean_loss(dynamics, learned.cost, others))
    return {"train": np.array(train), "validation": np.array(validation)}


def choose(results: dict[str, Result], task: str, inner_loops: Sequence[InnerLoop]) -> tuple[InnerLoop, list[float]]:
    """The inner loop with the lowest validation loss in the mean over the costs; and all those losses."""
    losses = []
    for loop in inner_loops:
        names = [f"choice/{task}-{loop.steps}-{loop.step_size:g}-{cost}" for cost in COSTS]
        mean = float(np.mean([results[name]["validation"].mean() for name in names]))
        losses.append(mean if np.isfinite(mean) else np.inf)
    if not np.isfinite(losses).any():
        raise ProblemError(f"no inner loop can learn {task}: choose smaller steps.")
    return inner_loops[int(np.argmin(losses))], losses


def _mean_loss(dynamics: NetworkDynamics, cost: PlanningCost, demonstrations: Sequence[Demonstration]) -> float:
    problem = planning_problem(dynamics, cost.horizon)
    return float(evaluate(problem, cost.solver, cost.psi, demonstrations).losses.mean())
