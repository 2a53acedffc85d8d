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
from kpirl_ocp.types import Array
from reproduction import beyond, checklist, drawing, meaning, placing, reaching, simulation
from reproduction.contenders import (
    APPRENTICE,
    DEFAULT,
    DEFAULT_MORE_STEPS,
    IMPLICIT,
    LITERAL,
    MORE_STEPS,
    PLACING,
    REACHING_EXECUTED,
    SMALL_START,
    UNROLLED,
    Contender,
)
from reproduction.outcome import Outcome, claims
from reproduction.page import Page
from reproduction.settings import PAPER_LOOP, STARTS
from reproduction.tables import demonstrations, per_seed, restlessness, spread

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
_TABLE_1 = tuple(zip((*UNROLLED, DEFAULT), (*LITERAL, DEFAULT), (*MORE_STEPS, DEFAULT_MORE_STEPS), strict=True))
_TABLE_1_NOTE = (
    "Mean ± standard deviation over seeds; over executions of the first seed's cost where it says so. The paper does "
    "not give the unit of its numbers; compare the ratios."
)
_LOSS = "IRL loss [(image half-widths)²]"
_SHOWN = (*UNROLLED, APPRENTICE)


def write(page: Page, outcome: Outcome, settings: Mapping[str, Any]) -> None:
    """All sections."""
    _findings(page, outcome)
    checklist.write(page, outcome)
    _choice(page, outcome)
    _simulation(page, outcome)
    _reaching(page, outcome)
    _placing(page, outcome)
    beyond.effort(page, outcome)
    beyond.robust(page, outcome)
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
        caption = f"{task}: training and test loss over outer iterations; to the letter every 50th is drawn"
        page.figure(drawing.curves(panels, "IRL loss [m²]"), caption)
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
    contenders = (*_SHOWN, *LITERAL, DEFAULT, *MORE_STEPS, DEFAULT_MORE_STEPS, *IMPLICIT)
    _reaching_curves(page, outcome)
    _reaching_distances(page, outcome, contenders)
    _reaching_weights(page, outcome)
    _reaching_table(page, outcome, contenders)
    meaning.x_and_y(page, outcome)
    meaning.red_keypoint(page, outcome)
    page.text("Played on the simulated arm, first seed:")
    rows = [
        [c.label, *(cell for loop in reaching.LOOPS for cell in _played(outcome, c, loop))] for c in REACHING_EXECUTED
    ]
    loops = ("open loop", "closed loop (MPC)", "closed, with a parallel detector at 30 Hz")
    page.table(["cost", *(head for loop in loops for head in (loop, "tracking [mrad]"))], rows)


def _reaching_curves(page: Page, outcome: Outcome) -> None:
    counts = outcome.preset.demonstrations
    panels = {
        f"{demonstrations(count)}, train": {c.label: outcome.reaching(c, count, "losses") for c in _SHOWN}
        for count in counts
    }
    page.figure(drawing.curves(panels, _LOSS), "IRL loss over training; bands from lowest to highest seed")
    panels = {
        f"{demonstrations(count)}, {name}": {c.cost: outcome.reaching(c, count, "losses") for c in group}
        for name, group in (("more steps", MORE_STEPS), ("converged", IMPLICIT))
        for count in counts
    }
    caption = "The same with more inner steps, and with the converged inner problem and the implicit gradient (L-BFGS)"
    page.figure(drawing.curves(panels, _LOSS), caption)


def _reaching_distances(page: Page, outcome: Outcome, contenders: Sequence[Contender]) -> None:
    both = {"all dimensions": "distance", "x of moving keypoints": "distance_x"}
    bars = {
        f"{demonstrations(count)}, test": {
            c.label: {name: per_seed(outcome.reaching(c, count, key)) for name, key in both.items()} for c in contenders
        }
        for count in outcome.preset.demonstrations
    }
    page.figure(drawing.bars(bars, "relative distance"), "Relative distance to the goal on test demonstrations")


def _reaching_weights(page: Page, outcome: Outcome) -> None:
    counts = outcome.preset.demonstrations
    most = max(counts)
    for name, group in (
        ("one step", UNROLLED),
        ("to the letter", LITERAL),
        ("more steps", MORE_STEPS),
        ("converged", IMPLICIT),
    ):
        caption = f"{name}: learned weights per keypoint (colour) and axis, {demonstrations(most)}, mean over time"
        meaning.figure(page, _learned(outcome, most), group, halves=False, caption=caption)
    for count in counts:
        meaning.known(page, _learned(outcome, count), f"reaching, {demonstrations(count)}")


def _learned(outcome: Outcome, count: int) -> meaning.Runs:
    return lambda contender, key: outcome.reaching(contender, count, key)


def _reaching_table(page: Page, outcome: Outcome, contenders: Sequence[Contender]) -> None:
    rows = [
        [
            f"{c.label}, {count}",
            spread([run.min() for run in outcome.reaching(c, count, "losses")]),
            *(spread(outcome.reaching(c, count, key)) for key in ("test", "distance", "distance_x")),
            f"{100 * restlessness(outcome.reaching(c, count, 'losses')):.0f} %",
            spread(outcome.reaching(c, count, "seconds")),
            _stopped(outcome.reaching(c, count, "losses"), outcome.reaching(c, count, "capped")),
        ]
        for count in outcome.preset.demonstrations
        for c in contenders
    ]
    header = ["cost, demonstrations", "train loss", "test loss", "rel. distance", "x of moving"]
    header += ["rises", "time [s]", "iterations"]
    page.table(header, rows, "Mean ± standard deviation over seeds, at the best iterate; * at the limit.")


def _stopped(losses: Sequence[Array], capped: Sequence[Any]) -> str:
    """Outer iterations of every seed, with a star where the limit ended them."""
    return ", ".join(f"{len(run) - 1}{'*' if cap else ''}" for run, cap in zip(losses, capped, strict=True))


def _played(outcome: Outcome, contender: Contender, loop: str) -> list[str]:
    found = outcome.results[f"reaching-executed/{contender.label}-{loop}"]
    return [spread(found["distance"]), f"{1e3 * found['tracking_error'].mean():.1f}"]


def _placing(page: Page, outcome: Outcome) -> None:
    page.heading("Experiment 2: placing from one human demonstration (paper, section 5.2)")
    panels = {
        "one step": {c.label: outcome.placing(c, "losses") for c in UNROLLED},
        "to the letter": {c.cost: outcome.placing(c, "losses") for c in LITERAL},
        "small start": {c.cost: outcome.placing(c, "losses") for c in SMALL_START},
        "more steps": {c.cost: outcome.placing(c, "losses") for c in MORE_STEPS},
        "converged": {c.cost: outcome.placing(c, "losses") for c in IMPLICIT},
    }
    page.figure(drawing.curves(panels, _LOSS), "IRL loss over training on one demonstration")
    for name, group in (("one step", UNROLLED), ("to the letter", LITERAL), ("more steps", MORE_STEPS)):
        caption = f"{name}: learned weights per keypoint (colour) and axis, in the first and (hatched) last five steps"
        meaning.figure(page, outcome.placing, group, halves=True, caption=caption)
    meaning.known(page, outcome.placing, "placing")
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
            for c in PLACING
        ]
        header = [f"{loop} loop", "keypoints [px²]", "bottle [px]", "success", "tracking [mrad]", "failed plans"]
        page.table(
            header, rows, f"Success: the bottle's middle ends within {placing.SUCCESS:g} px (31 mm) of its goal."
        )
    seed = outcome.seeds[0]
    shown = {f"start {s}": outcome.executed(DEFAULT, s, False, "images")[0][0] for s in STARTS}
    page.figure(drawing.starts(shown), f"The two starts, seed {seed}")
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
    page.heading("Squared keypoint distance to the goal [px²], and the paper's Table 1", 3)
    rows: list[list[Any]] = []
    for start in STARTS:
        for one_step, letter, more_steps in _TABLE_1:
            paper, deviation = _PAPER[(start, one_step.label)]
            share = f"{paper / _PAPER[(start, 'Default')][0]:.2f}"
            rows.append([f"{one_step.label}, start {start}", f"{paper} ({deviation})", share])
            pairs = ((one_step, DEFAULT), (letter, DEFAULT), (more_steps, DEFAULT_MORE_STEPS))
            for contender, default in pairs:
                played, closed = (outcome.executed(contender, start, loop, "squared") for loop in (False, True))
                base = outcome.executed(default, start, False, "squared").mean()
                again = spread(outcome.repeated(contender, start))
                rows[-1] += [spread(played), f"{played.mean() / base:.2f}", again, spread(closed)]
    columns = ("open", "/ Default", "one cost, executions", "closed")
    loops = [f"{steps}, {what}" for steps in ("one step", "to the letter", "more steps") for what in columns]
    header = ["cost, start", "paper", "paper / Default", *loops]
    page.table(header, rows, _TABLE_1_NOTE)
