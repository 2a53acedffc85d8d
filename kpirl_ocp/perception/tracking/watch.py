"""A film, the part of it that is a demonstration, and the tracks of the object in it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from tqdm import tqdm

from kpirl_ocp.errors import DemonstrationError
from kpirl_ocp.perception.data.video import Frames, iterate_frames
from kpirl_ocp.perception.hands.landmarks import PALM, Hand, find_hands, hands_are_installed
from kpirl_ocp.perception.tracking import objects
from kpirl_ocp.perception.tracking.camera_motion import CameraMotion, camera_motion
from kpirl_ocp.perception.tracking.similarity import transform
from kpirl_ocp.perception.tracking.tracker import track
from kpirl_ocp.perception.tracking.tracks import Tracks, of_object, spread
from kpirl_ocp.types import Array, Mask

LONGEST = 640  # longer side of the frames in which an object is followed [pixels]
FEWEST = 4  # frames of a film in which a motion can be seen


@dataclass(frozen=True)
class Film:
    """A part of a video, or of a folder of pictures at `source_rate` [Hz], from `start` to `end` [s].

    camera: its motion by the times of the whole film; None if it is at rest.
    """

    path: str | Path
    source_rate: float | None = None
    start: float = 0.0
    end: float = np.inf
    camera: CameraMotion | None = None

    @property
    def name(self) -> str:
        """The file's name, without its folder."""
        return Path(self.path).name

    def frames(self) -> Iterator[tuple[float, Frames]]:
        """Times [s] from zero on, and images (H, W, 3) of at most `LONGEST` pixels, as a camera at rest sees them.

        Read again by every call.
        """
        frames = iterate_frames(self.path, source_rate=self.source_rate, longest=LONGEST, end=self.end)
        for time, image in self.camera.steady(frames) if self.camera else frames:
            if time >= self.start - 1e-6:
                yield time - self.start, image

    def first(self) -> Frames:
        """The first image. Raises DemonstrationError if the film ends before `start`."""
        for _, image in self.frames():
            return image
        raise DemonstrationError(f"{self.path} has nothing from {self.start:g} s on.")

    def times(self) -> Array:
        """Times (n,) of its frames [s], from zero on."""
        return np.array([time for time, _ in self.frames()])

    def steadied(self) -> Film:
        """The film with the motion of its camera, as seen in the background.

        Raises DemonstrationError if it has fewer than four frames, or its camera moves too much.
        """
        count = sum(1 for _ in islice(self.frames(), FEWEST))
        if count < FEWEST:
            raise DemonstrationError(
                f"{self.path} has {count} frame{'s' * (count != 1)} from {self.start:g} s to {self._ends}: that shows "
                f"no motion. A demonstration takes a second or more, at ten frames a second or more."
            )
        frames = tqdm(self.frames(), f"look for motion of the camera in {self.name}", unit="frame")
        found = camera_motion((self.start + time, image) for time, image in frames)
        return replace(self, camera=found)

    @property
    def _ends(self) -> str:
        return "its end" if np.isinf(self.end) else f"{self.end:g} s"


def find_object(film: Film, box: ArrayLike | None = None, points: ArrayLike | None = None) -> Mask:
    """The object (H, W) in the first frame: in a box, under clicks, or what moves.

    box, points: (left, top, right, bottom) or (n, 2) [pixels of frames of at most `LONGEST` pixels].
    """
    if box is not None:
        return objects.in_box(film.first(), box)
    if points is not None:
        return objects.around(film.first(), points)
    return objects.moving(film.frames(), _hands(film.first()))


def _hands(image: Frames) -> Mask | None:
    """The hands in an image (H, W); None without the extra `hands`, or where there is none."""
    if not hands_are_installed():
        return None
    found = [hand.mask(image.shape) for hand in find_hands(image)]
    return np.any(found, axis=0) if found else None


def follow_hand(film: Film, landmarks: Sequence[int] = PALM) -> Tracks:
    """Tracks of landmarks of the hand that is surest in the first frame, by default four points of its palm.

    Where it is not found the landmarks stay, with a confidence of zero.

    Raises:
        DependencyError: the extra `hands` or its networks are missing.
        DemonstrationError: the first frame shows no hand.
    """
    times, positions, confidence = [], [], []
    before: Array | None = None
    for time, image in tqdm(film.frames(), f"follow the hand in {film.name}", unit="frame"):
        found = find_hands(image)
        if before is None and not found:
            raise DemonstrationError(f"{film.path} shows no hand at {film.start + time:.2f} s: start where it does.")
        hand = _nearest(found, before)
        before = hand.landmarks if hand else before
        times.append(time)
        positions.append(np.asarray(before)[list(landmarks)])
        confidence.append(np.full(len(landmarks), hand.score if hand else 0.0))
        size = (image.shape[1], image.shape[0])
    return Tracks(np.array(times), np.array(positions), np.array(confidence), size)


def _nearest(found: list[Hand], before: Array | None) -> Hand | None:
    """The hand nearest to where one was, if that is less than a hand's width away; the surest at first."""
    if before is None or not found:
        return found[0] if found else None
    hand = min(found, key=lambda hand: float(np.linalg.norm(hand.landmarks - before, axis=1).mean()))
    width = float(np.ptp(before, axis=0).max())
    return hand if np.linalg.norm(hand.landmarks - before, axis=1).mean() < width else None


def seen_at_rest(film: Film, tracks: Tracks) -> Tracks:
    """Tracks in a film as it was taken, as a camera at rest sees them, in its part with times from zero on."""
    part = tracks.between(film.start, min(film.end, float(tracks.times[-1])))
    return _seen_by(film, part, -1)


def as_taken(film: Film, tracks: Tracks) -> Tracks:
    """Tracks from a part of a film, in the film as it was taken and at its times: the inverse of `seen_at_rest`."""
    return replace(_seen_by(film, tracks, 1), times=film.start + tracks.times)


def _seen_by(film: Film, tracks: Tracks, power: int) -> Tracks:
    """With the motion of the film's camera (1), or with its inverse (-1)."""
    if film.camera is None:
        return tracks
    poses = [np.linalg.matrix_power(film.camera.at(film.start + time), power) for time in tracks.times]
    positions = np.array([transform(pose, places) for pose, places in zip(poses, tracks.positions, strict=True)])
    return replace(tracks, positions=positions)


def follow_object(film: Film, mask: Mask, keypoints: Array | None = None) -> Tracks:
    """Tracks of keypoints (K, 2) [pixels of the first frame] on the object; by default four, spread over it."""
    height, width = mask.shape
    frames = tqdm(film.frames(), f"follow {film.name}", unit="frame")
    return of_object(track(frames, mask), spread(mask) if keypoints is None else keypoints, (width, height))


def extent(mask: Mask) -> float:
    """Length of the object along its longer axis [pixels]: of a rod with the same spread."""
    rows, columns = np.nonzero(mask)
    return float(np.sqrt(12 * np.linalg.eigvalsh(np.cov([columns, rows]))[-1]))
