"""The report's sections beyond the paper: learned effort weights, and robustness."""

from __future__ import annotations

import numpy as np

from reproduction import drawing, placing, robustness
from reproduction.contenders import EFFORT, IMPLICIT, MORE_STEPS, Contender
from reproduction.outcome import Outcome
from reproduction.page import Page
from reproduction.settings import STARTS
from reproduction.tables import spread

_NEAR = f"{placing.SUCCESS:g} px (31 mm)"


def effort(page: Page, outcome: Outcome) -> None:
    page.heading("Beyond the paper: effort weights learned together with keypoint weights")
    count = min(outcome.preset.demonstrations)
    pairs = (MORE_STEPS[0], EFFORT[0], IMPLICIT[0], EFFORT[1], EFFORT[2])
    rows = [
        [
            c.label,
            spread(outcome.reaching(c, count, "test")),
            spread(outcome.reaching(c, count, "distance")),
            *(spread(outcome.executed(c, start, True, "squared")) for start in STARTS),
            f"{np.mean([run.mean() for run in outcome.placing(c, 'efforts')]):.3g}",
        ]
        for c in pairs
    ]
    header = [
        f"Weighted ({count} dem.)",
        "reaching: test loss",
        "rel. distance",
        "placing 1 [px²]",
        "placing 2 [px²]",
        "effort, placing",
    ]
    page.table(header, rows, "Placing in closed loop.")


def robust(page: Page, outcome: Outcome) -> None:
    page.heading("Beyond the paper: robustness")
    page.text(
        f"{outcome.preset.cases} random cases per condition from around start 1. Success: the bottle's middle, which "
        f"only the simulation knows, ends within {_NEAR} of where it should."
    )
    runs = outcome.robust_runs
    rates = {
        condition: {name: float(outcome.robust(condition, *run, "success")) for name, run in runs.items()}
        for condition in robustness.CONDITIONS
    }
    page.figure(
        drawing.success(rates, f"within {placing.SUCCESS:g} px"), "Success rates, in closed loop unless said otherwise"
    )
    rows = [
        [
            condition,
            *(f"{100 * row[name]:.0f} %, {_median(outcome, condition, *run):.1f} px" for name, run in runs.items()),
        ]
        for condition, row in rates.items()
    ]
    page.table(["condition", *runs], rows, "Success rate, and median distance of the bottle from its goal.")


def _median(outcome: Outcome, condition: str, contender: Contender, closed: bool) -> float:
    return float(np.median(outcome.robust(condition, contender, closed, "bottle")))
