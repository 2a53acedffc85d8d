"""Tracks on top of the film: a contact sheet and a video, for a person to judge what was followed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from kpirl_ocp.episodes import atomic_write
from kpirl_ocp.errors import DemonstrationError
from kpirl_ocp.figures import COLOURS, save
from kpirl_ocp.perception.data.encoding import write_video
from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.perception.tracking.tracks import Tracks
from kpirl_ocp.types import Array, Mask

_TRAIL = 1.0  # of the past that a track shows [s]
_COLUMNS, _PANEL, _EDGE, _LINE = 4, 450, 4, 24  # of a sheet: width, edge and caption of a frame in it [pixels]
_WHITE, _BLACK = (255, 255, 255), (0, 0, 0)


def overlay(image: Frames, trails: Array, confidence: Array | None = None) -> Frames:
    """An image (H, W, 3) with the paths (t, K, 2) [pixels] of keypoints up to now; a ring is one that is not seen."""
    canvas = np.ascontiguousarray(image).copy()
    thickness, radius = (max(least, round(max(image.shape[:2]) / share)) for least, share in ((2, 320), (3, 105)))
    seen = np.ones(trails.shape[1], bool) if confidence is None else confidence > 0
    colours = [tuple(int(255 * value) for value in to_rgb(colour)) for colour in COLOURS]
    lines = [np.ascontiguousarray(line) for line in trails.round().astype(np.int32).swapaxes(0, 1)]
    rims = [(number, rim) for rim in (1, 0) for number in range(len(lines))]  # white ones below: seen on any ground
    for number, rim in rims:
        rgb, width = _WHITE if rim else colours[number % len(colours)], thickness + 2 * rim
        cv2.polylines(canvas, [lines[number]], isClosed=False, color=rgb, thickness=width, lineType=cv2.LINE_AA)
    for number, rim in rims:
        rgb = _WHITE if rim else colours[number % len(colours)]
        filled = -1 if seen[number] else thickness + 2 * rim
        cv2.circle(canvas, lines[number][-1].tolist(), radius + rim, rgb, filled, cv2.LINE_AA)
    return canvas


def captioned(image: Frames, text: str) -> Frames:
    """An image (H, W, 3) with a line of text on a white label in its upper left corner."""
    canvas = np.ascontiguousarray(image).copy()
    size = max(0.45, max(canvas.shape[:2]) / 1000)
    bold, edge = max(1, round(2 * size)), round(12 * size)
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, bold)
    canvas[: height + 2 * edge, : width + 2 * edge] = _WHITE
    place = (edge, height + edge)
    cv2.putText(canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, _BLACK, bold, cv2.LINE_AA)
    return canvas


def zoomed(image: Frames, factor: float) -> Frames:
    """The image (H, W, 3), `factor` times as large."""
    height, width = image.shape[:2]
    return np.asarray(cv2.resize(image, (round(factor * width), round(factor * height))), np.uint8)


def at_times(frames: Iterable[tuple[float, Frames]], times: Array) -> Iterator[Frames]:
    """The frame that is nearest to each of the rising times [s], whatever the rates of the film and of the times.

    Raises DemonstrationError for times that go on for more than two steps behind the film's end.
    """
    stream, step = iter(frames), float(np.diff(times).max(initial=0.0))
    now, following = next(stream), next(stream, None)
    for time in times:
        while following is not None and abs(following[0] - time) <= abs(now[0] - time):
            step = max(step, following[0] - now[0])
            now, following = following, next(stream, None)
        if following is None and time > now[0] + 2 * step:
            raise DemonstrationError(
                f"the tracks go on until {times[-1]:.2f} s, but the film ends at {now[0]:.2f} s: "
                "say the rate of the tracks (--source-rate)."
            )
        yield now[1]


def overlays(frames: Iterable[tuple[float, Frames]], tracks: Tracks) -> Iterator[Frames]:
    """The frames of the tracks, one by one, with the paths of the last second drawn into them, and captions."""
    begins = np.searchsorted(tracks.times, tracks.times - _TRAIL - 1e-9)
    for index, image in enumerate(at_times(frames, tracks.times)):
        trails = tracks.positions[begins[index] : index + 1]
        yield captioned(overlay(image, trails, tracks.confidence[index]), _caption(tracks, index))


def _caption(tracks: Tracks, index: int) -> str:
    """The time of a frame and the mean confidence in it."""
    return f"{tracks.times[index]:.2f} s, seen {tracks.confidence[index].mean():.0%}"


def track_film(path: Path, frames: Iterable[tuple[float, Frames]], tracks: Tracks) -> Path:
    """Write an .mp4 of the frames (time [s], image (H, W, 3)) of the tracks with their paths and captions."""
    return write_video(path, overlays(frames, tracks), round(tracks.rate, 2), codec="h264")


def track_sheet(path: Path, frames: Iterable[tuple[float, Frames]], tracks: Tracks, chosen: Sequence[int]) -> Path:
    """Write a .png of the chosen frames, each with the keypoints' way so far, its time and the mean confidence."""
    images = at_times(frames, tracks.times[list(chosen)])
    panels = [_panel(image, tracks, index) for index, image in zip(chosen, images, strict=True)]
    columns = min(_COLUMNS, len(panels))
    panels += [np.full_like(panels[0], 255)] * (-len(panels) % columns)
    sheet = np.vstack([np.hstack(panels[first : first + columns]) for first in range(0, len(panels), columns)])
    with atomic_write(path) as file:
        quick = [cv2.IMWRITE_PNG_COMPRESSION, 3]
        file.write(cv2.imencode(".png", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR), quick)[1].tobytes())
    return path


def _panel(image: Frames, tracks: Tracks, index: int) -> Frames:
    """A frame of a sheet, with a white edge around it and its caption above."""
    width = _PANEL - 2 * _EDGE
    drawn = overlay(
        zoomed(image, width / image.shape[1]),
        width / tracks.size[0] * tracks.positions[: index + 1],
        tracks.confidence[index],
    )
    framed = cv2.copyMakeBorder(drawn, 0, _EDGE, _EDGE, _EDGE, cv2.BORDER_CONSTANT, value=_WHITE)
    return np.vstack([captioned(np.full((_LINE, _PANEL, 3), 255, np.uint8), _caption(tracks, index)), framed])


def draw_object(path: Path, image: Frames, mask: Mask) -> Path:
    """Write a picture of an image (H, W, 3) with the outline of an object (H, W), and its pixels along the sides."""
    height, width = mask.shape
    figure = Figure(figsize=(8.0, 7.4 * height / width + 0.5), layout="constrained")
    axis = figure.subplots()
    axis.imshow(image, extent=(0, width, height, 0))
    for colour, thickness in (("white", 3.0), (COLOURS[0], 1.2)):  # seen on any ground
        axis.contour(np.arange(width) + 0.5, np.arange(height) + 0.5, mask, [0.5], colors=colour, linewidths=thickness)
    axis.set(xlabel="x [pixels]", ylabel="y [pixels]")
    axis.locator_params(nbins=16)
    return save(figure, path)


def evenly(count: int, of: int) -> list[int]:
    """At most `count` indices spread evenly over 0 .. of - 1."""
    return sorted(set(np.linspace(0, of - 1, count).round().astype(int).tolist()))
