"""The figure: one panel per part that was run, two side by side, so that their text is legible on a page."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from bench.contenders import JAX, OURS, PLAIN, TORCH
from bench.control import EXPORTED, GRADIENT, PEERS, WITHOUT
from bench.control import OURS as OUR_SOLVER
from bench.part import Numbers
from bench.settings import Preset
from kpirl_ocp import figures

_CONTENDERS = {TORCH: "s-", PLAIN: "^-", JAX[0]: "v:", JAX[1]: "v-", OURS: "o-"}
Results = Mapping[str, Numbers]
Panel = Callable[[Axes], None]


def draw(results: Results, preset: Preset, path: Path) -> Path:
    """Write the PNG."""
    panels = _panels(results, preset)
    columns = min(2, len(panels))
    figure, axes = figures.new_figure(-(-len(panels) // columns), columns, width=5.0, height=3.8)
    for axis, panel in zip(axes, panels, strict=False):
        panel(axis)
    for axis in axes[len(panels) :]:
        axis.set_axis_off()
    return figures.save(figure, path)


def _panels(results: Results, preset: Preset) -> list[Panel]:
    panels: list[Panel] = []
    if "hypergradients" in results:
        grid = results["hypergradients"]["grid"]
        panels += [lambda axis, steps=steps: _over_horizons(axis, grid, steps, preset) for steps in preset.steps]
    drawn: dict[str, Callable[[Axes, Numbers], None]] = {
        "control": _control,
        "solvers": _solvers,
        "growth": _growth,
        "memory": _memory,
        "ceilings": _ceilings,
        "iiwa": _iiwa,
    }
    panels += [lambda axis, name=name: drawn[name](axis, results[name]) for name in drawn if name in results]
    return panels or [lambda axis: axis.text(0.5, 0.5, "nothing to draw", ha="center")]


def _over_horizons(axis: Axes, grid: Numbers, steps: int, preset: Preset) -> None:
    for colour, (name, style) in zip(figures.COLOURS, _CONTENDERS.items(), strict=False):
        cells = [(T, grid[f"T = {T}, N = {steps}"][name]) for T in preset.horizons]
        done = [(T, cell["median_ms"]) for T, cell in cells if "median_ms" in cell]
        if done:
            axis.plot(*zip(*done, strict=True), style, color=colour, label=name, markersize=4)
    axis.set(xscale="log", yscale="log", xlabel="horizon T", ylabel="loss and gradient [ms]")
    axis.set_title(f"unrolled hypergradient, N = {steps}, ReLU")
    axis.set_xticks(preset.horizons, list(map(str, preset.horizons)))
    axis.minorticks_off()
    axis.grid(alpha=0.3)
    axis.set_ylim(top=20 * axis.get_ylim()[1])  # room for the legend
    axis.legend(fontsize=7, loc="upper left")


def _control(axis: Axes, numbers: Numbers) -> None:
    """Medians over the problems, one mark per contender."""
    names = list(numbers)
    for index, who in enumerate((OUR_SOLVER, WITHOUT, EXPORTED, GRADIENT, *PEERS)):
        places = [(numbers[name][who]["median_ms"], y) for y, name in enumerate(names) if who in numbers[name]]
        if places:
            marker, colour = "ov^D<>ps"[index % 8], figures.COLOURS[index % len(figures.COLOURS)]
            axis.plot(*zip(*places, strict=True), marker, color=colour, label=who, markersize=5)
    axis.set_yticks(range(len(names)), names, fontsize=7)
    axis.set(xscale="log", xlabel="time [ms]", title="control problems, cold starts to 1e-8")
    axis.set_ylim(len(names) + 3.5, -0.5)  # room for the legend
    axis.grid(alpha=0.3, axis="x")
    axis.legend(fontsize=6, loc="lower left", ncols=2)


def _solvers(axis: Axes, numbers: Numbers) -> None:
    names = list(next(iter(numbers.values())))
    for index, (weights, results) in enumerate(numbers.items()):
        times = [np.mean([start["median_ms"] for start in results[name]]) for name in names]
        axis.barh(np.arange(len(names)) + 0.38 * index, times, 0.36, color=figures.COLOURS[index], label=weights)
    axis.set_yticks(np.arange(len(names)) + 0.19, names, fontsize=8)
    axis.set(xscale="log", xlabel="time of a solve [ms]", title="bounded OCP, tanh, to 1e-6 or as said")
    axis.invert_yaxis()
    axis.grid(alpha=0.3, axis="x")
    axis.legend(fontsize=8)


def _growth(axis: Axes, numbers: Numbers) -> None:
    horizons = [int(horizon) for horizon in numbers]
    curves = {
        "solve to 1e-10": [row["solve"]["median_ms"] for row in numbers.values()],
        "one iteration of it": [row["iteration_ms"] for row in numbers.values()],
        "implicit gradient and certificate": [row["gradient"]["median_ms"] for row in numbers.values()],
    }
    for colour, (name, times) in zip(figures.COLOURS, curves.items(), strict=False):
        axis.loglog(horizons, times, "o-", color=colour, label=name)
        axis.loglog(horizons, times[0] * np.array(horizons) / horizons[0], ":", color=figures.GREY, linewidth=1)
    axis.set(xlabel="horizon T", ylabel="time [ms]", title="growth, tanh (dotted: proportional to T)")
    axis.set_xticks(horizons, list(map(str, horizons)))
    axis.minorticks_off()
    axis.grid(alpha=0.3)
    axis.set_ylim(top=5 * axis.get_ylim()[1])
    axis.legend(fontsize=8, loc="upper left")


def _memory(axis: Axes, numbers: Numbers) -> None:
    for colour, (name, row) in zip(figures.COLOURS, numbers["iterations"].items(), strict=False):
        axis.loglog(list(map(int, row)), list(row.values()), "o-", color=colour, label=name)
    axis.set(xlabel="inner iterations", ylabel="peak memory [MB]", title="memory of ours, tanh")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)


def _ceilings(axis: Axes, numbers: Numbers) -> None:
    achieved = {name: row["gflop_per_s"] for name, row in numbers["achieved"].items()}
    axis.barh(list(achieved), list(achieved.values()), color=figures.COLOURS[0])
    for colour, (name, value) in zip(figures.COLOURS[1:], numbers["ceilings_gflop_per_s"].items(), strict=False):
        axis.axvline(value, color=colour, label=f"{name} ceiling")
    axis.set(xlabel="GFLOP/s in products", title="unrolled: weights, demonstrations")
    axis.invert_yaxis()
    axis.set_xlim(right=1.05 * max(numbers["ceilings_gflop_per_s"].values()))
    axis.legend(fontsize=8, loc="lower center")


def _iiwa(axis: Axes, numbers: Numbers) -> None:
    names, rows = list(numbers), list(numbers.values())
    low, middle, high = (np.array([row[key] for row in rows]) for key in ("p10_ms", "median_ms", "p90_ms"))
    axis.errorbar(middle, range(len(names)), xerr=[middle - low, high - middle], fmt="o", color=figures.COLOURS[0])
    axis.set_yticks(range(len(names)), names, fontsize=7)
    axis.set(xscale="log", xlabel="loss and gradient [ms]", title="iiwa, ground-truth keypoints, T = 9")
    axis.invert_yaxis()
    axis.grid(alpha=0.3, axis="x")
