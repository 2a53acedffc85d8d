"""Figures of the scripts: arrays in, one PNG out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kpirl_ocp.types import Array

# Okabe and Ito's palette, legible for colour-blind readers.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
GREY = "#888888"


def save(figure: Figure, path: Path) -> Path:
    """Write the PNG and give its path back."""
    figure.savefig(path, dpi=150)
    return path


def new_figure(rows: int, columns: int, width: float = 4.2, height: float = 3.3) -> tuple[Figure, list[Axes]]:
    """A figure with a grid of axes, row by row."""
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    return figure, list(np.atleast_1d(figure.subplots(rows, columns)).ravel())


def bands(axes: Axes, curves: Mapping[str, Sequence[Array]], log: bool = True) -> None:
    """One line per name, the mean over runs, with a band from lowest to highest; a curve that ended keeps its end."""
    for colour, (name, runs) in zip(COLOURS, curves.items(), strict=False):
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
    image = axes.imshow(values.T, aspect="auto", cmap="RdBu_r", vmin=-limit, vmax=limit)
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
