"""Figures of the scripts: arrays in, one picture out, in the style of `kpirl_ocp.pictures`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kpirl_ocp.episodes import atomic_write
from kpirl_ocp.pictures import COLOURS, GREY, PAGE, STYLE, figure_class, write_out_numbers
from kpirl_ocp.types import Array

# What has a colour of its own in every figure.
_KNOWN = dict(zip(("weighted", "timedep", "rbf", "apprenticeship"), COLOURS, strict=False)) | {"default": GREY}


def save(figure: Figure, path: Path) -> Path:
    """Write the figure, whole or not at all, as PNG or SVG by the path's suffix, and give its path back."""
    write_out_numbers(figure)
    with atomic_write(path) as file:
        figure.savefig(file, dpi=150, format=path.suffix[1:])
    return path


def new_figure(rows: int, columns: int, width: float = 4.2, height: float = 3.3) -> tuple[Figure, list[Axes]]:
    """A figure with a grid of axes, row by row; no wider than a page, so that nobody shrinks its text."""
    size = (min(width * columns, PAGE), height * rows)
    with matplotlib.rc_context(dict(STYLE)):
        figure = figure_class()(figsize=size, layout="constrained")
        return figure, list(np.atleast_1d(figure.subplots(rows, columns)).ravel())


def wrapped_figure(count: int, width: float = 4.6, height: float = 3.3) -> tuple[Figure, list[Axes]]:
    """A figure with `count` axes of about this width [inch], in as many rows as a page needs."""
    columns = min(count, max(1, round(PAGE / width)))
    figure, axes = new_figure(-(-count // columns), columns, width, height)
    for spare in axes[count:]:
        spare.set_visible(False)
    return figure, axes[:count]


def colours(names: Iterable[str]) -> dict[str, str]:
    """A colour for each name: the one it has in every figure, or one that is left."""
    names = list(names)
    fixed = {name: _KNOWN[name.lower()] for name in names if name.lower() in _KNOWN}
    left = [colour for colour in COLOURS if colour not in fixed.values()]
    others = [name for name in names if name not in fixed]
    return fixed | {name: left[index % len(left)] for index, name in enumerate(others)}


def panels_of_bands(axes: Sequence[Axes], panels: Mapping[str, Mapping[str, Sequence[Array]]], ylabel: str) -> None:
    """One panel per title, of losses over outer iterations; a name has one colour in all, and one legend is below."""
    chosen = colours(dict.fromkeys(name for curves in panels.values() for name in curves))
    for axis, (title, curves) in zip(axes, panels.items(), strict=True):
        bands(axis, curves, chosen)
        axis.set(title=title, xlabel="outer iteration", ylabel=ylabel)
    shared_legend(axes)


def shared_legend(axes: Sequence[Axes], columns: int = 4) -> None:
    """One legend below all axes of a figure, where it hides no line; a name is listed once."""
    pairs = [pair for axis in axes for pair in zip(*reversed(axis.get_legend_handles_labels()), strict=True)]
    handles = dict(pairs[::-1])  # of the first axes with the name
    names = list(dict.fromkeys(name for name, _ in pairs))
    figure = axes[0].figure
    figure.legend(
        [handles[n] for n in names], names, loc="outside lower center", ncols=min(len(names), columns), frameon=False
    )


def bands(axes: Axes, curves: Mapping[str, Sequence[Array]], chosen: Mapping[str, str], log: bool = True) -> None:
    """One line per name, the mean over runs, with a band from lowest to highest; a curve that ended keeps its end.

    chosen: name -> colour.
    """
    for name, runs in curves.items():
        colour = chosen[name]
        length = max(map(len, runs))
        values = np.array([np.concatenate([run, np.full(length - len(run), run[-1])]) for run in runs])
        axes.plot(values.mean(axis=0), color=colour, label=name, linewidth=1.5)
        axes.fill_between(np.arange(length), values.min(axis=0), values.max(axis=0), color=colour, alpha=0.15, lw=0)
    if log:
        axes.set_yscale("log")
    axes.grid(alpha=0.3, which="both")


def weights(axes: Axes, values: Array, title: str, dimensions: int = 3) -> None:
    """Weights (T, dimensions K) over time as an image: rows are keypoint coordinates, columns time steps."""
    limit = float(np.abs(values).max()) or 1.0
    lowest, colours_of = (-limit, "RdBu_r") if (values < 0).any() else (0.0, "Reds")
    image = axes.imshow(values.T, aspect="auto", cmap=colours_of, vmin=lowest, vmax=limit)
    axes.set(title=title, xlabel="time step t")
    axes.set_xticks(range(len(values)), [str(t) for t in range(1, len(values) + 1)])
    names = [f"keypoint {i // dimensions} {'xyz'[i % dimensions]}" for i in range(values.shape[1])]
    axes.set_yticks(range(values.shape[1]), names)
    axes.figure.colorbar(image, ax=axes, label="weight")


def arm(axes: Axes, skeletons: Array, keypoints: Array, colour: str, name: str) -> None:
    """Side view (x, z) of an arm's motion: skeletons (T+1, n, 3) faint to solid, keypoints (T+1, K, 3) as dots."""
    for index, (joints, points) in enumerate(zip(skeletons, keypoints, strict=True)):
        skeleton = np.vstack([joints, points.mean(axis=0)])  # the last line is the object in the gripper
        alpha = 0.15 + 0.85 * (index / (len(skeletons) - 1)) ** 2
        axes.plot(skeleton[:, 0], skeleton[:, 2], color=colour, alpha=alpha, linewidth=2, solid_capstyle="round")
        axes.scatter(points[:, 0], points[:, 2], color=colour, alpha=alpha, s=10)
    axes.set(title=name, xlabel="x [m]", aspect="equal")
    axes.grid(alpha=0.3)


def paths(axes: Axes, keypoints: Sequence[Array], names: Sequence[str], across: int, up: int) -> None:
    """Paths of the first keypoint in a plane: keypoints (T+1, K, 3) per path, a ring where it ends."""
    for index, (points, name) in enumerate(zip(keypoints, names, strict=True)):
        colour = COLOURS[index % len(COLOURS)]
        axes.plot(points[:, 0, across], points[:, 0, up], ".-", color=colour, label=name, linewidth=1, markersize=4)
        axes.scatter(points[-1, 0, across], points[-1, 0, up], s=60, facecolors="none", edgecolors=colour)
    axes.set(xlabel=f"{'xyz'[across]} [m]", ylabel=f"{'xyz'[up]} [m]")
    axes.grid(alpha=0.3)
