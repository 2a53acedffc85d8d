"""Evaluation of a cost on demonstrations that it was not trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.irl.hypergradients.certificate import demonstrated_observations
from kpirl_ocp.irl.hypergradients.loss import Loss, squared_distance
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Solver
from kpirl_ocp.types import Array, Demonstration, Mask, Solution


@dataclass(frozen=True)
class Evaluation:
    """Per demonstration: the planned solutions, IRL losses (n,) and relative distances (n,)."""

    solutions: tuple[Solution, ...]
    losses: Array
    relative_distances: Array


def evaluate(
    problem: OCP,
    solver: Solver,
    psi: ArrayLike,
    demonstrations: Sequence[Demonstration],
    loss: Loss = squared_distance,
) -> Evaluation:
    """Plan from the start of every demonstration with the cost psi (n_psi,), and compare.

    Raises:
        ProblemError: the observations of a demonstration do not fit the problem.
    """
    solutions = tuple(solver.solve(problem, demo.s0, psi, demo.context) for demo in demonstrations)
    measure = loss(problem)
    pairs = list(zip(solutions, demonstrations, strict=True))
    losses = [
        float(measure(plan.states.T, plan.actions.T, demonstrated_observations(problem, demo))) for plan, demo in pairs
    ]
    distances = [relative_distance(np.array(problem.observe(plan.states.T)).T, demo) for plan, demo in pairs]
    return Evaluation(solutions, np.array(losses), np.array(distances))


def relative_distance(observations: Array, demonstration: Demonstration, coordinates: Mask | None = None) -> float:
    """|z_T - z_goal| / |z_0 - z_goal| of observations (T+1, n_z), z_goal the demonstration's end (appendix A.5).

    coordinates: (n_z,) those that count; all by default.
    """
    errors = observations - demonstration.observations[-1]
    if coordinates is not None:
        errors = errors[:, coordinates]
    return float(np.linalg.norm(errors[-1]) / np.linalg.norm(errors[0]))
