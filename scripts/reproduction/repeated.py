"""One cost, several executions: the spread that the paper's Table 1 shows, in addition to that over seeds.

A real arm never does the same twice. Here the start is off by up to 0.01 rad a joint, and the camera has noise.
"""

from __future__ import annotations

import numpy as np

from kpirl_ocp.perception.plant.camera_plant import Disturbance
from kpirl_ocp.types import Array
from reproduction.contenders import TABLE_1, Contender, in_a_name
from reproduction.data import Models
from reproduction.placing import Condition, Setup, name_of, play, scores
from reproduction.settings import STARTS
from reproduction.sweep import Job, Result

_OFF = 0.01 * np.array([0, 1, 0, 1, 0, 1, 0])  # of the joints that move in the plane [rad]
_CAMERA = Condition(Disturbance(noise=5.0))


def jobs(models: Models, found: dict[int, Setup], learned: dict[str, Result], executions: int, seed: int) -> list[Job]:
    """One for every contender of Table 1 and start, in open loop as in the paper."""
    setup = found[seed]
    return [
        Job(
            job_name(contender, start),
            run,
            {
                "models": models,
                "learned": learned[name_of(contender, seed)],
                "joints": setup.joints[start - 1],
                "setup": setup,
                "executions": executions,
            },
        )
        for contender in TABLE_1
        for start in STARTS
        if not learned[name_of(contender, seed)]["failure"]
    ]


def job_name(contender: Contender, start: int) -> str:
    """Name of the job."""
    return f"placing-repeated/{in_a_name(contender.label)}-{start}"


def run(models: Models, learned: Result, joints: Array, setup: Setup, executions: int) -> Result:
    """Squared distances at the end (executions,) [pixels^2]."""
    squared = []
    for number in range(executions):
        rng = np.random.default_rng([number, 17])
        placed = joints + _OFF * rng.uniform(-1, 1, 7)
        done, plant = play(models, learned, placed, setup, False, _CAMERA, rng)
        squared.append(scores(done, plant, setup)["squared"])
    return {"squared": np.array(squared)}
