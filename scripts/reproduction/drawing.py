"""The figures of the report; every function takes results and returns a figure."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kpirl_ocp.figures import bands, colours, new_figure, wrapped_figure
from kpirl_ocp.pictures import COLOURS
from kpirl_ocp.types import Array

Runs = Mapping[str, Sequence[Array]]


def curves(panels: Mapping[str, Runs], ylabel: str) -> Figure:
    """Lines with bands over seeds, one panel per title."""
    figure, axes = wrapped_figure(len(panels), width=4.6)
    for axis, (title, runs) in zip(axes, panels.items(), strict=True):
        bands(axis, {name: values for name, values in runs.items() if len(values)})
        axis.set(title=title, xlabel="outer iteration", ylabel=ylabel)
        axis.legend()
    return figure


def bars(panels: Mapping[str, Mapping[str, Mapping[str, Array]]], ylabel: str) -> Figure:
    """Grouped bars, mean and standard deviation: panel -> group along the axis -> colour -> values over seeds."""
    figure, axes = wrapped_figure(len(panels), width=10.0, height=3.4)
    for axis, (title, groups) in zip(axes, panels.items(), strict=True):
        names = list(dict.fromkeys(name for bars in groups.values() for name in bars))
        chosen, width = colours(names), 0.8 / len(names)
        for index, name in enumerate(names):
            places = np.arange(len(groups)) + (index - (len(names) - 1) / 2) * width
            values = [np.asarray(bars[name], float) for bars in groups.values()]
            values = [v if len(v) else np.full(1, np.nan) for v in values]  # not learned: no bar
            means, spreads = [v.mean() for v in values], [v.std() for v in values]
            axis.bar(places, means, 0.9 * width, yerr=spreads, color=chosen[name], label=name, capsize=2)
        axis.set_xticks(range(len(groups)), [name.replace(", ", ",\n") for name in groups], rotation=30, ha="right")
        axis.set(title=title, ylabel=ylabel)
        axis.grid(alpha=0.3, axis="y")
        axis.legend()
    return figure


def keypoint_weights(panels: Mapping[str, Sequence[Array]]) -> Figure:
    """Weights (T, n_z) over seeds, averaged over time: bars per coordinate, in the keypoints' colours."""
    figure, axes = wrapped_figure(len(panels), width=3.4, height=2.8)
    for axis, (title, runs) in zip(axes, panels.items(), strict=True):
        values = np.array([run.mean(axis=0) for run in runs])
        _weight_bars(axis, values, np.arange(values.shape[1]), 0.8, hatch=None)
        axis.set(title=title, ylabel="weight")
    return figure


def early_and_late_weights(panels: Mapping[str, Sequence[Array]], steps: int) -> Figure:
    """Weights (T, n_z) over seeds, in the mean over the first `steps`, plain, and the last `steps`, hatched."""
    figure, axes = wrapped_figure(len(panels), width=4.2, height=2.8)
    for axis, (title, runs) in zip(axes, panels.items(), strict=True):
        for side, hatch in ((-1, None), (1, "////")):
            values = np.array([(run[:steps] if side < 0 else run[-steps:]).mean(axis=0) for run in runs])
            _weight_bars(axis, values, np.arange(values.shape[1]) + 0.2 * side, 0.38, hatch)
        axis.set(title=f"{title}: first (plain), last {steps} steps", ylabel="weight")
    return figure


def _weight_bars(axis: Axes, values: Array, places: Array, width: float, hatch: str | None) -> None:
    """Bars of (seeds, n_z), one colour per keypoint."""
    colours = [COLOURS[i // 2] for i in range(values.shape[1])]
    means, spreads = values.mean(axis=0), values.std(axis=0)
    axis.bar(places, means, width, yerr=spreads, color=colours, hatch=hatch, edgecolor="white", linewidth=0, capsize=2)
    axis.set_xticks(range(values.shape[1]), [f"{'xy'[i % 2]}{i // 2 + 1}" for i in range(values.shape[1])], fontsize=8)
    axis.axhline(0.0, color="black", linewidth=0.6)
    axis.grid(alpha=0.3, axis="y")


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
    figure.legend(loc="outside lower center", ncols=len(names))
    return figure
