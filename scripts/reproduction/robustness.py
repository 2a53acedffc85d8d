"""Success rates of placing under disturbances, over random cases; the costs are those of experiment 2."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from kpirl_ocp.perception.plant.camera_plant import Disturbance
from reproduction.contenders import DEFAULT_MORE_STEPS, MORE_STEPS, Contender, in_a_name
from reproduction.data import Models
from reproduction.placing import SUCCESS, Condition, Setup, name_of, play, scores
from reproduction.sweep import Job, Result

_HIDING = Disturbance(hidden=1, patch=60, since=4, until=11)  # to the end
_CONFIDENCE = 0.8  # about one in a hundred of the training data's mu is lower, for the keypoint that varies most
CONDITIONS: Mapping[str, Condition] = {
    "as trained": Condition(),
    "parallel detector, 30 Hz": Condition(asynchronous=True),
    "camera noise": Condition(Disturbance(noise=20.0)),
    "wrong model": Condition(model_gain=1.5),
    "another start": Condition(),
    "keypoint hidden": Condition(_HIDING),
    "keypoint hidden, mu used": Condition(_HIDING, confidence=_CONFIDENCE),
}
TIME_DEPENDENT = Contender("TimeDep", "unrolled, more steps")
LETTER = Contender("TimeDep", "unrolled, to the letter")
CLOSED = (*MORE_STEPS, LETTER, Contender("TimeDep", "implicit"), DEFAULT_MORE_STEPS)
RUNS = (*((contender, True) for contender in CLOSED), (TIME_DEPENDENT, False))  # the last for comparison
_NEAR, _FAR = 0.01, 0.12  # how far joints 2, 4 and 6 are from start 1, at most [rad]
_IN_PLANE = np.array([0, 1, 0, 1, 0, 1, 0])


def jobs(models: Models, found: dict[int, Setup], learned: dict[str, Result], cases: int) -> list[Job]:
    """One for every condition and run whose costs were learned; the cases take the seeds' setups and costs in turn."""
    setups = list(found.items())
    drawn = [setups[case % len(setups)] for case in range(cases)]
    able = [run for run in RUNS if not any(learned[name_of(run[0], seed)]["failure"] for seed in found)]
    return [
        Job(
            name(condition, contender, closed),
            run,
            {
                "models": models,
                "setups": [setup for _, setup in drawn],
                "learned": [learned[name_of(contender, seed)] for seed, _ in drawn],
                "condition": CONDITIONS[condition],
                "far": condition == "another start",
                "closed_loop": closed,
            },
        )
        for condition in CONDITIONS
        for contender, closed in able
    ]


def label(contender: Contender, closed: bool) -> str:
    """Name of a run in the report."""
    return contender.label if closed else f"{contender.label}, open loop"


def name(condition: str, contender: Contender, closed: bool) -> str:
    """Name of the job."""
    parts = (condition, contender.label, "closed" if closed else "open")
    return "robustness/" + in_a_name("-".join(parts))


def run(
    models: Models,
    setups: list[Setup],
    learned: list[Result],
    condition: Condition,
    far: bool,
    closed_loop: bool,
) -> Result:
    """Distances of the bottle from its goal (cases,) [pixels]; success is SUCCESS or less."""
    distances, squared = [], []
    for case, (setup, cost) in enumerate(zip(setups, learned, strict=True)):
        rng = np.random.default_rng([case, 11])
        spread = _FAR if far else _NEAR
        joints = setup.joints[0] + _IN_PLANE * rng.uniform(-spread, spread, 7)
        done, plant = play(models, cost, joints, setup, closed_loop, condition, rng)
        found = scores(done, plant, setup)
        distances.append(found["bottle"])
        squared.append(found["squared"])
    bottle = np.array(distances)
    return {"bottle": bottle, "squared": np.array(squared), "success": float((bottle <= SUCCESS).mean())}
