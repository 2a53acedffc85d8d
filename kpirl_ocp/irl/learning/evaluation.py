"""Evaluation of a cost on demonstrations that it was not trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.irl.hypergradients.loss import Loss, data_of, squared_distance
from kpirl_ocp.irl.learning.horizons import Problems, problems_of
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.problem.solver import Solver
from kpirl_ocp.pictures import Brief
from kpirl_ocp.types import Array, Demonstration, Mask, Solution


@dataclass(frozen=True, repr=False)
class Evaluation(Brief):
    """Per demonstration: the planned solutions, IRL losses (n,) and relative distances (n,)."""

    solutions: tuple[Solution, ...]
    losses: Array
    relative_distances: Array

    @property
    def failures(self) -> str:
        """The number of failed plans and the first of them, or nothing. Losses count them like the others."""
        failed = [(index, plan) for index, plan in enumerate(self.solutions) if not plan.status.ok]
        if not failed:
            return ""
        index, plan = failed[0]
        return f"{len(failed)} of {len(self.solutions)} plans failed; number {index}: {plan}"


def evaluate(
    problem: Problems,
    demonstrations: Sequence[Demonstration],
    psi: ArrayLike,
    solver: Solver,
    loss: Loss = squared_distance,
) -> Evaluation:
    """Plan from the start of every demonstration with the cost psi (n_psi,), and compare; arguments as in `learn`.

    Raises:
        ProblemError: the observations of a demonstration do not fit the problem.
    """
    rows = list(zip(problems_of(problem, demonstrations), demonstrations, strict=True))
    solutions = tuple(solver.solve(own, demo.s0, psi, demo.context) for own, demo in rows)
    losses, distances = [], []
    for (own, demo), plan in zip(rows, solutions, strict=True):
        losses.append(float(loss(own)(plan.states.T, plan.actions.T, data_of(loss, own, demo))))
        distances.append(relative_distance(dense(own.observe(plan.states.T)).T, demo))
    return Evaluation(solutions, np.array(losses), np.array(distances))


def relative_distance(observations: Array, demonstration: Demonstration, coordinates: Mask | None = None) -> float:
    """|z_T - z_goal| / |z_0 - z_goal| of observations (T+1, n_z), z_goal the demonstration's end (appendix A.5).

    coordinates: (n_z,) those that count; all by default.
    """
    errors = observations - demonstration.observations[-1]
    if coordinates is not None:
        errors = errors[:, coordinates]
    return float(np.linalg.norm(errors[-1]) / np.linalg.norm(errors[0]))
