"""Learn a cost, by any of the methods, as one job."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kpirl_ocp.errors import CertificateError
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
from reproduction.contenders import Contender
from reproduction.identification import identified
from reproduction.settings import LARGER_RATE, PAPER_START, PRINTED_RATE
from reproduction.sweep import Result

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
        return learn_unrolled(dynamics, demonstrations, basis, inner, iterations, rng, learn_effort="effort" in method)
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


def _mean_loss(dynamics: NetworkDynamics, cost: PlanningCost, demonstrations: Sequence[Demonstration]) -> float:
    problem = planning_problem(dynamics, cost.horizon)
    return float(evaluate(problem, demonstrations, cost.psi, cost.solver).losses.mean())
