"""The report on what the weights mean: which ones the data determine, x against y, and a background keypoint."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from kpirl_ocp.reporting import digits, plus_minus
from kpirl_ocp.types import Array
from reproduction import axes, background, drawing
from reproduction.contenders import IMPLICIT, LITERAL, MORE_STEPS, SMALL_START, UNROLLED, Contender
from reproduction.drawing import Bars
from reproduction.identification import HALF
from reproduction.outcome import Outcome
from reproduction.page import Page
from reproduction.tables import spread

Runs = Callable[[Contender, str], list[Array]]
"""A result of learning from every seed in which the cost was learned."""
_GROUPS = {
    "one step": UNROLLED,
    "to the letter": LITERAL,
    "small start": SMALL_START,
    "more steps": MORE_STEPS,
    "converged": IMPLICIT,
}


def figure(page: Page, runs: Runs, group: Sequence[Contender], halves: bool, caption: str) -> None:
    """Learned weights with intervals, over all steps or early and late, of costs learned in at least one seed."""
    panels = {}
    for contender in group:
        found = runs(contender, "weights")
        if not found:
            continue
        parts = {0: [w.mean(0) for w in found]}
        if halves:
            parts = {1: [w[:HALF].mean(0) for w in found], 2: [w[-HALF:].mean(0) for w in found]}
        panels[contender.label] = [_bars(weights, runs, contender, part) for part, weights in parts.items()]
    if panels:
        note = "; 90 % intervals, grey where the data do not determine the weight"
        page.figure(drawing.keypoint_weights(panels), caption + note)


def _bars(weights: Sequence[Array], runs: Runs, contender: Contender, part: int) -> Bars:
    """Means over seeds; a weight counts as determined if it is in most of them."""
    halfwidths, determined = (
        np.mean([run[part] for run in runs(contender, key)], axis=0) for key in ("halfwidths", "determined")
    )
    return Bars(np.mean(weights, axis=0), halfwidths, determined > 0.5)


def known(page: Page, runs: Runs, title: str) -> None:
    """The share of every cost that was learned, in a sentence each."""
    rows = []
    for name, group in _GROUPS.items():
        for contender in group:
            parameters = runs(contender, "parameters")
            if not parameters:
                continue
            counts = [f"{np.mean(runs(contender, key)):.1f}" for key in ("known", "known_in_stiffness")]
            noise = np.mean(runs(contender, "noise"))
            share = np.mean([run[0] for run in runs(contender, "determined")], axis=0) > 0.5
            below = f"{100 * np.mean([np.mean(w < 0) for w in runs(contender, 'weights')]):.0f} %"
            first = [f"{contender.cost}, {name}", int(parameters[0]), *counts, f"{noise:.3f}", below]
            rows.append([*first, *_axis_intervals(runs, contender), _sentence(share)])
    known = ("known directions", "in units of stiffness")
    header = [
        title,
        "parameters",
        *known,
        "noise",
        "negative weights",
        "x, all keypoints",
        "y, all keypoints",
        "of single keypoints",
    ]
    note = (
        "Mean over seeds. A direction is known when the data confine it to less than weights are large (or their "
        "stiffness); noise in image half-widths, misfit included. The other directions kept their start. Weights are "
        "means over time with 90 % intervals, in brackets where the data do not determine them."
    )
    page.table(header, rows, note)


def _axis_intervals(runs: Runs, contender: Contender) -> list[str]:
    """Mean weight of x and of y over keypoints and time, with its interval."""
    cells = []
    for axis in (0, 1):
        value = np.mean([w[:, axis::2].mean() for w in runs(contender, "weights")])
        reach = np.mean([run[axis] for run in runs(contender, "axis_halfwidths")])
        known = np.mean([run[axis] for run in runs(contender, "axes_determined")]) > 0.5
        text = plus_minus(float(value), float(reach))
        cells.append(text if known else f"({text})")
    return cells


def _sentence(determined: Array) -> str:
    names = [f"{'xy'[i % 2]}{i // 2 + 1}" for i in range(len(determined))]
    learned = ", ".join(name for name, yes in zip(names, determined, strict=True) if yes) or "nothing"
    left = ", ".join(name for name, yes in zip(names, determined, strict=True) if not yes)
    return f"learned: {learned}" + (f"; not determined: {left}" if left else "")


def x_and_y(page: Page, outcome: Outcome) -> None:
    """Weights on y and on x in reaching, and what each axis is worth."""
    page.text(
        "The object moves along x alone, and the paper's costs give y little weight. How large weights end depends on "
        "where they start; how firmly an axis is held is weight times squared gain. Test loss as learned, and with the "
        "weights of one axis set to zero:"
    )
    rows = []
    for count in outcome.preset.demonstrations:
        for name, group in _GROUPS.items():
            for contender in group:
                found = outcome.reaching(contender, count, "weights")
                if found:
                    rows.append([f"{contender.cost}, {name}, {count}", *_axes(outcome, contender, count, found)])
    header = ["cost, demonstrations", "weight x", "weight y", "stiffness y / x", "test loss", "without y", "without x"]
    page.table(header, rows)


def _axes(outcome: Outcome, contender: Contender, count: int, found: list[Array]) -> list[str]:
    gains = outcome.reaching(contender, count, "gains")
    pairs = [(w[:, 0::2].mean(), w[:, 1::2].mean()) for w in found]
    held = [w.mean(axis=0) * g for w, g in zip(found, gains, strict=True)]
    with np.errstate(divide="ignore"):  # infinite where x is not held at all
        ratio = np.mean([np.abs(h[1::2]).sum() / np.abs(h[0::2]).sum() for h in held])
    losses = [spread(outcome.without_axis(contender, count, key)) for key in axes.KEYS]
    return [spread([x for x, _ in pairs]), spread([y for _, y in pairs]), digits(float(ratio), 3), *losses]


def red_keypoint(page: Page, outcome: Outcome) -> None:
    """The weights of a fifth keypoint that never moves."""
    page.text("The paper's red keypoint stands still in the background. A fifth keypoint that no action moves:")
    rows = []
    for task in background.TASKS:
        for contender in background.CONTENDERS:
            found = outcome.results[background.name_of(task, contender)]
            if found["failure"]:
                continue
            weights = found["weights"].mean(axis=0)
            still = f"{weights[-2]:.4f}, {weights[-1]:.4f}"
            start = "0.01" if contender in (*LITERAL, *SMALL_START) else "0.5 to 1.5"
            known = "yes" if found["determined"][0, -2:].any() else "no"
            rows.append([f"{task}: {contender.label}", still, start, known, f"{np.mean(weights[:-2]):.3g}"])
    header = ["cost", "weights of the background keypoint", "start", "determined", "mean of the others"]
    page.table(header, rows, "Mean over time, first seed. It has no gradient, and keeps its start exactly.")
