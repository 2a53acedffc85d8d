"""Worth of the weights of an axis: the IRL loss on the test demonstrations of reaching without them.

Along y the object stays where it is, at its goal. Do weights on y hold it there, or do they not matter?
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kpirl_ocp.episodes import ArmTrack
from kpirl_ocp.irl.learning.evaluation import evaluate
from kpirl_ocp.irl.visual.demonstrations import robot_demonstration
from kpirl_ocp.irl.visual.planning_costs import planning_problem
from kpirl_ocp.types import Demonstration
from reproduction import reaching
from reproduction.contenders import IMPLICIT, LITERAL, MORE_STEPS, SMALL_START, UNROLLED
from reproduction.data import Models
from reproduction.learning import unpacked
from reproduction.settings import Preset
from reproduction.sweep import Job, Result

KEYS = ("both", "without_y", "without_x")
CONTENDERS = (*UNROLLED, *LITERAL, *SMALL_START, *MORE_STEPS, *IMPLICIT)


def jobs(
    models: Models, tracks: Sequence[ArmTrack], learned: dict[str, Result], preset: Preset, seeds: Sequence[int]
) -> list[Job]:
    """One for every cost that was learned."""
    dynamics = models.load_dynamics("reaching")
    test = [robot_demonstration(dynamics, track) for track in tracks[-preset.tests :]]
    names = [
        reaching.name_of(contender, count, seed)
        for contender in CONTENDERS
        for count in preset.demonstrations
        for seed in seeds
    ]
    return [
        Job(name_of(name), run, {"models": models, "test": test, "learned": learned[name]})
        for name in names
        if not learned[name]["failure"]
    ]


def name_of(learned: str) -> str:
    """Name of the job about the cost of the job `learned`."""
    return f"axes/{learned}"


def run(models: Models, test: list[Demonstration], learned: Result) -> Result:
    """Mean test IRL loss of the cost as learned, with no weight on y, and with no weight on x."""
    dynamics, cost = models.load_dynamics("reaching"), unpacked(learned)
    problem = planning_problem(dynamics, cost.horizon)

    def loss(*kept: int) -> float:
        """With the weights of these axes alone; axis 0 is x."""
        mask = np.isin(np.arange(dynamics.n_z) % 2, kept)
        psi = replace(cost, weights=np.where(mask, cost.weights, 0.0)).psi
        return float(evaluate(problem, test, psi, cost.solver).losses.mean())

    return {"both": loss(0, 1), "without_y": loss(0), "without_x": loss(1)}
