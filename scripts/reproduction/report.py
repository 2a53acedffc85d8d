"""The report: every section takes the outcome and writes text, tables and figures to the page."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from experiments.apprenticeship_variants import HEADER, rows_of
from experiments.study import DRAWN
from experiments.study import METHODS as STUDY_METHODS

from kpirl_ocp.irl.cases.tasks import TASKS
from kpirl_ocp.perception.detector.track_images import image_strips
from kpirl_ocp.reporting import plus_minus
from kpirl_ocp.types import Array
from reproduction import axes, drawing, placing, reaching, robustness, simulation
from reproduction.learning import (
    APPRENTICE,
    DEFAULT,
    DEFAULT_MORE_STEPS,
    EFFORT,
    IMPLICIT,
    MORE_STEPS,
    UNROLLED,
    Contender,
)
from reproduction.outcome import Outcome, claims, restlessness
from reproduction.page import Page
from reproduction.settings import PAPER_LOOP, STARTS

# Table 1 of the paper: mean and standard deviation of the squared distance, in its own unit.
_PAPER = {
    (1, "Weighted"): (40.99, 9.08),
    (1, "TimeDep"): (6.12, 0.94),
    (1, "RBF"): (4.26, 1.20),
    (1, "Default"): (26.96, 5.41),
    (2, "Weighted"): (3.61, 0.40),
    (2, "TimeDep"): (3.53, 0.21),
    (2, "RBF"): (4.40, 0.15),
    (2, "Default"): (15.76, 1.34),
}
_TABLE_1 = tuple(zip((*UNROLLED, DEFAULT), (*MORE_STEPS, DEFAULT_MORE_STEPS), strict=True))
_LOSS = "IRL loss [(image half-widths)²]"
_NEAR = f"{placing.SUCCESS:g} px (31 mm)"


def write(page: Page, outcome: Outcome, settings: Mapping[str, Any]) -> None:
    """All sections."""
    _findings(page, outcome)
    _choice(page, outcome)
    _simulation(page, outcome)
    _reaching(page, outcome)
    _placing(page, outcome)
    _effort(page, outcome)
    _robustness(page, outcome)
    page.heading("Settings and versions")
    page.listing(json.dumps(settings, indent=2, default=str))


def _findings(page: Page, outcome: Outcome) -> None:
    page.heading("The paper's findings, tested")
    rows = [[claim.text, "holds" if claim.holds else "does NOT hold", claim.numbers] for claim in claims(outcome)]
    page.table(["finding", "here", "numbers"], rows, f"Means over seeds {list(outcome.seeds)}.")
    failed = [[name, reason] for name, reason in outcome.failures().items()]
    if failed:
        page.table(["not learned", "why"], failed, "These are left out of means; where all seeds fail, it says so.")


def _choice(page: Page, outcome: Outcome) -> None:
    page.heading("The inner loop")
    page.text(
        f"N gradient steps of size alpha on the actions. The paper's own: N = {PAPER_LOOP.steps}, alpha = "
        f"{PAPER_LOOP.step_size:g}. 'More steps' are chosen on validation demonstrations that appear nowhere else, by "
        "the loss of the learned costs: every family learned from one of them and was judged on the others, in turn. "
        "More steps bring Default nearer to the goal too, without making it follow the demonstration."
    )
    for task, candidates in outcome.tried.items():
        rows = [
            [
                f"{task}: N = {c.inner.steps}, alpha = {c.inner.step_size:g}",
                *(c.loss, c.default_loss, c.distance, c.default_distance),
                "chosen" if c.inner == outcome.chosen[task] else "",
            ]
            for c in candidates
        ]
        page.table(["inner loop", "loss, learned", "loss, Default", "rel. distance, learned", "Default", ""], rows)


def _simulation(page: Page, outcome: Outcome) -> None:
    page.heading("Simulation study (paper, section 4.3)")
    page.text("Known dynamics and exact 3-D keypoints; a Weighted cost from one demonstration, five for testing.")
    rows = []
    for task in TASKS:
        runs = [outcome.results[f"simulation/{task}-{seed}"] for seed in outcome.seeds]
        panels = {
            f"{task}: {what}": {m: [run[f"{m}/{what}"] for run in runs] for m in DRAWN} for what in ("train", "test")
        }
        page.figure(drawing.curves(panels, "IRL loss [m²]"), f"{task}: training and test loss over outer iterations")
        for method in STUDY_METHODS:
            kept = [
                [run[f"{method}/{what}"][run[f"{method}/best"]] for run in runs]
                for what in ("train", "test", "distance")
            ]
            seconds = np.mean([run[f"{method}/seconds"] for run in runs])
            rows.append([f"{task}: {method}", *map(spread, kept), f"{seconds:.2f}"])
    page.table(["task: method", "train loss [m²]", "test loss [m²]", "relative distance", "learning [s]"], rows)
    page.text("Does apprenticeship learning oscillate? Every choice that the paper leaves open:")
    names = {task: [outcome.results[f"simulation/{task}-{seed}"] for seed in outcome.seeds] for task in TASKS}
    page.table(HEADER, rows_of({task: [simulation.variants_of(run) for run in runs] for task, runs in names.items()}))


def _reaching(page: Page, outcome: Outcome) -> None:
    page.heading("Experiment 1: reaching (paper, section 5.1)")
    counts = outcome.preset.demonstrations
    shown = (*UNROLLED, APPRENTICE)
    contenders = (*shown, DEFAULT, *MORE_STEPS, DEFAULT_MORE_STEPS, *IMPLICIT)
    panels = {
        f"{count} demonstration(s), train": {c.label: outcome.reaching(c, count, "losses") for c in shown}
        for count in counts
    }
    page.figure(drawing.curves(panels, _LOSS), "IRL loss over training; bands from lowest to highest seed")
    page.figure(
        drawing.curves(
            {
                f"{count} demonstration(s), {name}": {c.cost: outcome.reaching(c, count, "losses") for c in group}
                for name, group in (("more steps", MORE_STEPS), ("implicit", IMPLICIT))
                for count in counts
            },
            _LOSS,
        ),
        "The same with more inner steps, and with the converged inner problem and the implicit gradient (L-BFGS)",
    )
    both = {"all dimensions": "distance", "x of moving keypoints": "distance_x"}
    bars = {
        f"{count} demonstration(s), test": {
            c.label: {name: _per_seed(outcome.reaching(c, count, key)) for name, key in both.items()}
            for c in contenders
        }
        for count in counts
    }
    page.figure(drawing.bars(bars, "relative distance"), "Relative distance to the goal on test demonstrations")
    most = max(counts)
    for name, group in (("one step", shown), ("more steps", MORE_STEPS)):
        page.figure(
            drawing.keypoint_weights({c.label: outcome.reaching(c, most, "weights") for c in group}),
            f"{name}: learned weights per keypoint (colour) and axis, {most} demonstration(s), mean over time",
        )
    rows = [
        [
            f"{c.label}, {count}",
            spread([run.min() for run in outcome.reaching(c, count, "losses")]),
            *(spread(outcome.reaching(c, count, key)) for key in ("test", "distance", "distance_x")),
            f"{100 * restlessness(outcome.reaching(c, count, 'losses')):.0f} %",
            spread(outcome.reaching(c, count, "seconds")),
        ]
        for count in counts
        for c in contenders
    ]
    header = ["cost, demonstrations", "train loss", "test loss", "rel. distance", "x of moving", "rises", "time [s]"]
    page.table(header, rows, "Mean ± standard deviation over seeds, at the iterate with the lowest training loss.")
    _axes(page, outcome)
    page.text("Played on the simulated arm, first seed:")
    rows = [
        [c.label, *(cell for loop in ("open", "closed") for cell in _played(outcome, c, loop))] for c in reaching.PLAYED
    ]
    page.table(["cost", "open loop", "tracking [mrad]", "closed loop (MPC)", "tracking [mrad]"], rows)


def _axes(page: Page, outcome: Outcome) -> None:
    page.text(
        "The object moves along x alone, and the paper's costs give y little weight. Are the weights on y idle here? "
        "Test loss of the costs as learned, and with the weights of one axis set to zero:"
    )
    keys = ("both", "without_y", "without_x")
    rows = [[c.label, *(spread(outcome.without_axis(c, key)) for key in keys)] for c in axes.CONTENDERS]
    page.table(["cost", "as learned", "no weight on y", "no weight on x"], rows)


def _played(outcome: Outcome, contender: Contender, loop: str) -> list[str]:
    found = outcome.results[f"reaching-executed/{contender.label}-{loop}"]
    return [spread(found["distance"]), f"{1e3 * found['tracking_error'].mean():.1f}"]


def _placing(page: Page, outcome: Outcome) -> None:
    page.heading("Experiment 2: placing from one human demonstration (paper, section 5.2)")
    panels = {
        "one step": {c.label: outcome.placing(c, "losses") for c in UNROLLED},
        "more steps": {c.cost: outcome.placing(c, "losses") for c in MORE_STEPS},
        "implicit": {c.cost: outcome.placing(c, "losses") for c in IMPLICIT},
    }
    page.figure(drawing.curves(panels, _LOSS), "IRL loss over training on one demonstration")
    for name, group in (("one step", UNROLLED), ("more steps", MORE_STEPS)):
        page.figure(
            drawing.early_and_late_weights({c.cost: outcome.placing(c, "weights") for c in group}, 5),
            f"{name}: learned weights per keypoint (colour) and axis, in the first and in the last five steps",
        )
    _table_1(page, outcome)
    for loop, closed in (("open", False), ("closed", True)):
        rows = [
            [
                f"{c.label}, start {start}",
                spread(outcome.executed(c, start, closed, "squared")),
                spread(outcome.executed(c, start, closed, "bottle")),
                f"{100 * (outcome.executed(c, start, closed, 'bottle') <= placing.SUCCESS).mean():.0f} %",
                f"{1e3 * outcome.executed(c, start, closed, 'tracking_error').mean():.1f}",
                int(outcome.executed(c, start, closed, "failed_plans").sum()),
            ]
            for start in STARTS
            for c in placing.CONTENDERS
        ]
        header = [f"{loop} loop", "keypoints [px²]", "bottle [px]", "success", "tracking [mrad]", "failed plans"]
        page.table(
            header, rows, f"Success: the bottle's middle ends within {placing.SUCCESS:g} px (31 mm) of its goal."
        )
    seed = outcome.seeds[0]
    for start in STARTS:
        columns = {"Demo": _demonstration(outcome, seed)} | {
            c.label: tuple(outcome.executed(c, start, True, key)[0] for key in ("images", "keypoints", "goal"))
            for c in (DEFAULT_MORE_STEPS, *MORE_STEPS)
        }
        page.figure(
            image_strips(columns, (0, 5, 10)),
            f"Start {start}, closed loop, seed {seed}: detected keypoints filled, goal keypoints hollow",
        )


def _demonstration(outcome: Outcome, seed: int) -> tuple[Array, Array, Array]:
    found = outcome.results[f"demonstration-{seed}"]
    return found["images"], found["keypoints"], found["goal"]


def _table_1(page: Page, outcome: Outcome) -> None:
    page.heading("Squared keypoint distance to the goal [px²], beside the paper's Table 1", 3)
    rows: list[list[Any]] = []
    for start in STARTS:
        for one_step, more_steps in _TABLE_1:
            paper, deviation = _PAPER[(start, one_step.label)]
            share = f"{paper / _PAPER[(start, 'Default')][0]:.2f}"
            rows.append([f"{one_step.label}, start {start}", f"{paper} ({deviation})", share])
            for contender, default in ((one_step, DEFAULT), (more_steps, DEFAULT_MORE_STEPS)):
                played, closed = (outcome.executed(contender, start, loop, "squared") for loop in (False, True))
                base = outcome.executed(default, start, False, "squared").mean()
                rows[-1] += [spread(played), f"{played.mean() / base:.2f}", spread(closed)]
    loops = [f"{steps}, {what}" for steps in ("one step", "more steps") for what in ("open", "/ Default", "closed")]
    header = ["cost, start", "paper", "paper / Default", *loops]
    page.table(header, rows, "The paper does not give the unit of its numbers; compare the ratios.")


def _effort(page: Page, outcome: Outcome) -> None:
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


def _robustness(page: Page, outcome: Outcome) -> None:
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


def spread(values: Sequence[Any] | Array) -> str:
    """Mean and standard deviation over seeds; tests of one seed are averaged first."""
    runs = _per_seed(values)
    return plus_minus(runs.mean(), (runs - runs[0]).std()) if len(runs) else "not learned"


def _per_seed(values: Sequence[Any] | Array) -> Array:
    return np.array([np.mean(value) for value in values])
