"""Figures of an imitation: the paths, the learned weights, and a film of the person and the robot, side by side."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from kpirl_ocp import figures
from kpirl_ocp.cli.imitation.arm import Arm
from kpirl_ocp.cli.imitation.execution import Executed
from kpirl_ocp.irl.visual.camera_learning import CameraLearning
from kpirl_ocp.perception.data.encoding import write_video
from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.perception.tracking.pictures import at_times, overlay, zoomed
from kpirl_ocp.perception.tracking.tracks import Tracks
from kpirl_ocp.perception.tracking.watch import Film
from kpirl_ocp.pictures import PAGE, STYLE, figure_class
from kpirl_ocp.types import Array


def draw_paths(path: Path, runs: list[Executed]) -> Path:
    """The demonstrated paths, broad, and those of the arm's keypoints, in its image at the end; one panel per start."""
    figure, axes = figures.new_figure(1, len(runs), height=4.0)
    for number, (axis, run) in enumerate(zip(axes, runs, strict=True)):
        size = run.images.shape[2], run.images.shape[1]
        axis.imshow(run.images[-1], extent=(0, size[0], size[1], 0), alpha=0.6)
        for index in range(run.keypoints.shape[1]):
            colour = figures.COLOURS[index % len(figures.COLOURS)]
            axis.plot(*run.wanted[:, index].T, color=colour, linewidth=5, alpha=0.35)
            axis.plot(*run.keypoints[:, index].T, ".-", color=colour, linewidth=1, markersize=4)
        axis.plot([], [], "k", linewidth=5, alpha=0.35, label="demonstrated")
        axis.plot([], [], "k.-", linewidth=1, markersize=4, label="executed, step by step")
        axis.set_title(f"start {number + 1}: {run.reached:.1%} off the path", fontsize=10)
        axis.set(xlabel="x in the arm's camera [pixels]", ylabel="y [pixels]")
    figures.shared_legend(axes)
    return figures.save(figure, path)


def draw_learning(path: Path, learning: CameraLearning) -> Path:
    """Training loss, and learned weights of keypoints and effort."""
    figure, axes = figures.new_figure(1, 3)
    _loss(axes[0], learning.history.losses)
    cost = learning.cost
    weights, efforts = cost.cost.weights(cost.psi, cost.horizon, len(cost.displacement))
    figures.weights(axes[1], weights, "learned weights", dimensions=2)
    for index, name in enumerate(axes[1].get_yticklabels()):
        name.set_color(figures.COLOURS[index // 2 % len(figures.COLOURS)])  # that of the keypoint in the other pictures
    axes[2].bar(np.arange(1, len(efforts) + 1), efforts, color=figures.COLOURS[0])
    axes[2].set(title="learned effort weights", xlabel="step", ylabel="weight of |u|², u in rad")
    return figures.save(figure, path)


def _loss(axis: Axes, losses: Array) -> None:
    axis.semilogy(losses, color=figures.COLOURS[0])
    axis.set(xlabel="outer iteration", ylabel="IRL loss [(half images)²]", title="training loss")
    axis.grid(alpha=0.3, which="both")


def draw_imitation(path: Path, tracks: Tracks, run: Executed) -> Path:
    """The object's tracks without the film, and the robot with its keypoints at the start, half-way and at the end."""
    width, height = tracks.size
    ratios = [width / height, 1, 1, 1]
    with matplotlib.rc_context(dict(STYLE)):
        figure = figure_class()(figsize=(PAGE, 1.15 * PAGE / sum(ratios)), layout="constrained")
        first, *others = figure.subplots(1, 4, width_ratios=ratios)
    _draw_tracks(first, tracks)
    last = len(run.images) - 1
    for axis, title, step in zip(others, ("start", "half-way", "end"), (0, last // 2, last), strict=True):
        axis.imshow(run.images[step], extent=(0, run.images.shape[2], run.images.shape[1], 0))
        for index, colour in zip(range(run.keypoints.shape[1]), cycle(figures.COLOURS), strict=False):
            axis.plot(*run.keypoints[: step + 1, index].T, color=colour, linewidth=1)
            axis.scatter(*run.keypoints[step, index], s=12, color=colour, zorder=3)
        axis.set_title(f"the arm: {title}")
        axis.set_axis_off()
    return figures.save(figure, path)


def _draw_tracks(axis: Axes, tracks: Tracks) -> None:
    """Rings where the tracks (n, K, 2) begin, dots where they end, and the quadrilateral that they make there."""
    places, (width, height) = tracks.positions, tracks.size
    for end in (0, -1):
        around = places[end] - places[end].mean(axis=0)
        order = np.argsort(np.arctan2(around[:, 1], around[:, 0]))
        axis.fill(*places[end, order].T, color=figures.GREY, alpha=0.2, linewidth=0)
    for index in range(places.shape[1]):
        colour = figures.COLOURS[index % len(figures.COLOURS)]
        axis.plot(*places[:, index].T, color=colour)
        axis.scatter(*places[0, index], facecolors="white", edgecolors=colour, zorder=3)
        axis.scatter(*places[-1, index], color=colour, zorder=3)
    axis.set(title="the film: tracks", xlabel="x [pixels]", ylabel="y [pixels]")
    axis.set(xlim=(0, width), ylim=(height, 0), aspect="equal")


def side_by_side(path: Path, film: Film, tracks: Tracks, arm: Arm, run: Executed) -> Path:
    """An .mp4 of the person with tracks, beside the arm with its keypoints at the same share of the way."""
    return write_video(path, _pairs(film, tracks, arm, run), rate=run.film_rate, codec="h264")


def _pairs(film: Film, tracks: Tracks, arm: Arm, run: Executed) -> Iterator[Frames]:
    times = np.linspace(0.0, float(tracks.times[-1]), len(run.postures))
    theirs, ours = tracks.places_at(times), arm.keypoints(run.postures)
    images = at_times(film.frames(), times)
    for index, (image, seen) in enumerate(zip(images, arm.images(run.postures), strict=True)):
        zoom = image.shape[0] / seen.shape[0]
        pair = overlay(np.hstack([image, zoomed(seen, zoom)]), theirs[: index + 1])
        yield overlay(pair, [image.shape[1], 0] + zoom * ours[: index + 1])
