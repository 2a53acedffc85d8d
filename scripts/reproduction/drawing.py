"""The figures of the report; every function takes results and returns a figure."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kpirl_ocp.figures import colours, new_figure, panels_of_bands, shared_legend, wrapped_figure
from kpirl_ocp.pictures import COLOURS
from kpirl_ocp.types import Array, Mask

Runs = Mapping[str, Sequence[Array]]


def curves(panels: Mapping[str, Runs], ylabel: str) -> Figure:
    """Lines with bands over seeds, one panel per title."""
    figure, axes = wrapped_figure(len(panels), width=4.8)
    learned = {title: {name: runs for name, runs in lines.items() if len(runs)} for title, lines in panels.items()}
    panels_of_bands(axes, learned, ylabel)
    return figure


def bars(panels: Mapping[str, Mapping[str, Mapping[str, Array]]], xlabel: str) -> Figure:
    """Grouped bars, mean and standard deviation: panel -> group, one below the other -> colour -> values over seeds."""
    most = max(map(len, panels.values()))
    figure, axes = wrapped_figure(len(panels), width=4.8, height=1.4 + 0.3 * most)
    for axis, (title, groups) in zip(axes, panels.items(), strict=True):
        names = list(dict.fromkeys(name for bars in groups.values() for name in bars))
        chosen, width = colours(names), 0.8 / len(names)
        for index, name in enumerate(names):
            places = np.arange(len(groups)) + (index - (len(names) - 1) / 2) * width
            values = [np.asarray(bars[name], float) for bars in groups.values()]
            values = [v if len(v) else np.full(1, np.nan) for v in values]  # not learned: no bar
            means, spreads = [v.mean() for v in values], [v.std() for v in values]
            axis.barh(places, means, 0.9 * width, xerr=spreads, color=chosen[name], label=name, capsize=2)
        axis.set_yticks(range(len(groups)), list(groups))
        axis.invert_yaxis()  # the first on top
        axis.set(title=title, xlabel=xlabel)
        axis.grid(alpha=0.3, axis="x")
    shared_legend(axes)
    return figure


class Bars(NamedTuple):
    """Weights (n_z,) of one cost with half-widths (n_z,) of their intervals, and whether the data determine them."""

    weights: Array
    halfwidths: Array
    determined: Mask


def keypoint_weights(panels: Mapping[str, Sequence[Bars]]) -> Figure:
    """One panel per cost; several sets of bars (early, late) stand side by side, the second hatched.

    Bars are in the keypoints' colours, and grey where the data do not determine them.
    """
    figure, axes = wrapped_figure(len(panels), width=3.6, height=2.8)
    for axis, (title, sets) in zip(axes, panels.items(), strict=True):
        for index, bars in enumerate(sets):
            _weight_bars(axis, bars, (index + 0.5) / len(sets) - 0.5, 0.8 / len(sets), "////" if index else None)
        names = [f"{'xy'[i % 2]}{i // 2 + 1}" for i in range(len(sets[0].weights))]
        axis.set_xticks(range(len(names)), names, fontsize=8)
        axis.set(title=title, ylabel="weight")
        axis.axhline(0.0, color="black", linewidth=0.6)
        axis.grid(alpha=0.3, axis="y")
    return figure


def _weight_bars(axis: Axes, bars: Bars, shift: float, width: float, hatch: str | None) -> None:
    places = np.arange(len(bars.weights)) + 0.8 * shift
    colours = [COLOURS[i // 2] if known else "#cccccc" for i, known in enumerate(bars.determined)]
    axis.bar(places, bars.weights, width, color=colours, hatch=hatch, edgecolor="white", linewidth=0)
    axis.errorbar(places, bars.weights, bars.halfwidths, fmt="none", ecolor="#555555", elinewidth=0.8, capsize=2)


def starts(images: Mapping[str, Array]) -> Figure:
    """One image (H, W, 3) per start."""
    figure = Figure(figsize=(2.4 * len(images), 2.7), layout="constrained")
    for axis, (title, image) in zip(np.atleast_1d(figure.subplots(1, len(images))), images.items(), strict=True):
        axis.imshow(image)
        axis.set(xticks=[], yticks=[], title=title)
    return figure


def success(table: Mapping[str, Mapping[str, float]], threshold: str) -> Figure:
    """Success rates: condition -> contender -> share."""
    figure, (axis,) = new_figure(1, 1, width=10.0, height=4.0)
    names = list(next(iter(table.values())))
    chosen, width = colours(names), 0.84 / len(names)
    for index, name in enumerate(names):
        places = np.arange(len(table)) + (index - (len(names) - 1) / 2) * width
        rates = [100 * row[name] for row in table.values()]
        drawn = axis.bar(places, rates, 0.9 * width, color=chosen[name], label=name)
        axis.bar_label(drawn, fmt="%.0f", fontsize=7, rotation=90, padding=2)
    axis.set_xticks(range(len(table)), [textwrap.fill(name, 16) for name in table])
    axis.set(ylabel=f"success: {threshold} [%]", ylim=(0, 115))
    axis.grid(alpha=0.3, axis="y")
    shared_legend([axis], columns=3)
    return figure
