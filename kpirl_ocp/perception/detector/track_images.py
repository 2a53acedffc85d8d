"""Pictures of keypoints: contact sheets and videos with tracks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
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
    """An .mp4 of images (n, S, S, 3), twice as large, with keypoints (n, K, 3) and where they came from."""
    return write_video(path, with_tracks(images, keypoints), rate, codec="h264")


def with_tracks(images: Frames, keypoints: Array) -> Frames:
    """The images (n, S, S, 3), twice as large, with keypoints (n, K, 3) and where they came from."""
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
