"""A film, the part of it that is a demonstration, and the tracks of the object in it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from tqdm import tqdm

from kpirl_ocp.errors import DemonstrationError
from kpirl_ocp.perception.data.video import Frames, iterate_frames
from kpirl_ocp.perception.tracking import objects
from kpirl_ocp.perception.tracking.tracker import track
from kpirl_ocp.perception.tracking.tracks import Tracks, of_object, spread
from kpirl_ocp.types import Array, Mask

LONGEST = 640  # longer side of the frames in which an object is followed [pixels]


@dataclass(frozen=True)
class Film:
    """A part of a video, or of a folder of pictures at `source_rate` [Hz], from `start` to `end` [s]."""

    path: Path
    source_rate: float | None = None
    start: float = 0.0
    end: float = np.inf

    def frames(self) -> Iterator[tuple[float, Frames]]:
        """Times [s] from zero on, and images (H, W, 3) of at most `LONGEST` pixels; read again by every call."""
        for time, image in iterate_frames(self.path, source_rate=self.source_rate, longest=LONGEST, end=self.end):
            if time >= self.start - 1e-6:
                yield time - self.start, image

    def first(self) -> Frames:
        """The first image. Raises DemonstrationError if the film ends before `start`."""
        for _, image in self.frames():
            return image
        raise DemonstrationError(f"{self.path} has nothing from {self.start:g} s on.")


def find_object(film: Film, box: ArrayLike | None = None, points: ArrayLike | None = None) -> Mask:
    """The object (H, W) in the first frame: in a box, under clicks, or what moves.

    box, points: (left, top, right, bottom) or (n, 2) [pixels of frames of at most `LONGEST` pixels].
    """
    if box is not None:
        return objects.in_box(film.first(), box)
    if points is not None:
        return objects.around(film.first(), points)
    return objects.moving(film.frames())


def follow_object(film: Film, mask: Mask, keypoints: Array | None = None) -> Tracks:
    """Tracks of keypoints (K, 2) [pixels of the first frame] on the object; by default four, spread over it."""
    height, width = mask.shape
    frames = tqdm(film.frames(), f"follow {film.path.name}", unit="frame")
    return of_object(track(frames, mask), spread(mask) if keypoints is None else keypoints, (width, height))


def extent(mask: Mask) -> float:
    """Length of the object along its longer axis [pixels]: of a rod with the same spread."""
    rows, columns = np.nonzero(mask)
    return float(np.sqrt(12 * np.linalg.eigvalsh(np.cov([columns, rows]))[-1]))
