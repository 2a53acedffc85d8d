"""Pictures of keypoints: contact sheets, strips of images, paths, and videos with tracks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from kpirl_ocp.figures import COLOURS, save
from kpirl_ocp.perception.data.encoding import write_video
from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.perception.detector.keypoints import to_pixels
from kpirl_ocp.types import Array

_TRAIL = 15  # frames of the past that a track shows
_ZOOM = 2


def contact_sheet(path: Path, rows: Mapping[str, tuple[Frames, Array]], columns: int = 6) -> Path:
    """One row per clip, frames in the order of time: images (n, S, S, 3) with keypoints (n, K, 3).

    Filled dots are detected in the frame, rings are the clip's goal: the keypoints of its last frame.
    """
    figure = Figure(figsize=(1.7 * columns, 1.85 * len(rows) + 0.3), layout="constrained")
    axes = np.atleast_2d(figure.subplots(len(rows), columns))
    for line, (name, (images, keypoints)) in zip(axes, rows.items(), strict=True):
        size = images.shape[1]
        pixels = to_pixels(keypoints, size)
        for axis, index in zip(line, np.linspace(0, len(images) - 1, columns).round().astype(int), strict=True):
            axis.imshow(images[index], extent=(0, size, size, 0))
            for colour, here, goal in zip(COLOURS, pixels[index], pixels[-1], strict=False):
                axis.scatter(*goal, s=45, facecolors="none", edgecolors=colour, linewidths=1.2)
                axis.scatter(*here, s=14, color=colour)
            axis.set(xticks=[], yticks=[], title=f"t = {index}", xlim=(0, size), ylim=(size, 0))
            axis.title.set_fontsize(8)
        line[0].set_ylabel(name, fontsize=9)
    marks = [Line2D([], [], ls="", marker="o", color="k", label="detected")]
    marks += [Line2D([], [], ls="", marker="o", mfc="none", color="k", label="goal (last frame)")]
    figure.legend(handles=marks, loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    return save(figure, path)


def track_video(path: Path, images: Frames, keypoints: Array, rate: float) -> Path:
    """An .mp4 of images (n, S, S, 3), twice as large, with keypoints (n, K, 3) and their past paths."""
    return write_video(path, with_tracks(images, keypoints), rate, codec="h264")


def with_tracks(images: Frames, keypoints: Array) -> Frames:
    """The images (n, S, S, 3), twice as large, with keypoints (n, K, 3) and their past paths."""
    size = _ZOOM * images.shape[1]
    pixels = to_pixels(keypoints, size)
    drawn = []
    for index, image in enumerate(images):
        canvas = np.ascontiguousarray(cv2.resize(image, (size, size), interpolation=cv2.INTER_CUBIC))
        for number, colour in zip(range(pixels.shape[1]), COLOURS, strict=False):
            rgb = tuple(int(255 * value) for value in to_rgb(colour))
            trail = pixels[max(0, index - _TRAIL) : index + 1, number].round().astype(np.int32)
            cv2.polylines(canvas, [trail], isClosed=False, color=rgb, thickness=2, lineType=cv2.LINE_AA)
            cv2.circle(canvas, trail[-1].tolist(), 5, rgb, -1, cv2.LINE_AA)
        drawn.append(canvas)
    return np.array(drawn, np.uint8)


def image_strips(columns: Mapping[str, tuple[Frames, Array, Array]], times: Sequence[int]) -> Figure:
    """Columns of images (3, S, S, 3) with detected keypoints (3, K, 3), filled, and goal ones (n_z,), hollow."""
    figure = Figure(figsize=(1.9 * len(columns), 6.1), layout="constrained")
    axes = figure.subplots(3, len(columns))
    for column, (title, (images, keypoints, goal)) in enumerate(columns.items()):
        size = images.shape[1]
        for row, axis in enumerate(axes[:, column]):
            axis.imshow(images[row], extent=(0, size, size, 0))
            here, there = to_pixels(keypoints[row], size), to_pixels(np.reshape(goal, (-1, 2)), size)
            for colour, (x, y), (goal_x, goal_y) in zip(COLOURS, here, there, strict=False):
                axis.scatter(goal_x, goal_y, s=46, facecolors="none", edgecolors=colour, linewidths=1.3)
                axis.scatter(x, y, s=20, color=colour, edgecolors="white", linewidths=0.6)  # told apart where they meet
            axis.set(xticks=[], yticks=[], xlim=(0, size), ylim=(size, 0))
        axes[0, column].set_title(title, fontsize=9)
    for row, time in enumerate(times):
        axes[row, 0].set_ylabel(f"t = {time}")
    return figure


def keypoint_paths(axis: Axes, wanted: Array, done: Array, size: int) -> None:
    """Demonstrated paths of keypoints, dotted, and executed ones: z (T+1, 2 K) each, rings at the goals.

    size: side of the image [pixels].
    """
    for index, colour in zip(range(wanted.shape[1] // 2), COLOURS, strict=False):
        there, here = (to_pixels(z[:, 2 * index : 2 * index + 2], size) for z in (wanted, done))
        axis.plot(*there.T, ":", color=colour)
        axis.plot(*here.T, ".-", color=colour, linewidth=1)
        axis.scatter(*there[-1], s=60, facecolors="none", edgecolors=colour)
    axis.set(title="dotted: demonstrated", xlabel="x [pixels]", ylabel="y [pixels]", aspect="equal")
    axis.invert_yaxis()
    axis.grid(alpha=0.3)
