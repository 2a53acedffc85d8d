"""Random surroundings for rendered clips (domain randomisation, Tobin et al., 2017); only the object stays as it is.

Level 0 is the white wall. Level 1 is a plain wall of any colour. Level 2 has all at once: a cluttered wall, other
colours of all bodies, a light gradient and another colour of light, another size, camera shake, noise and H.264.
Level 3 draws one of the other levels for every clip.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.perception.data.decoding import decode
from kpirl_ocp.perception.data.encoding import write_video
from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.perception.scene.frame import Frame
from kpirl_ocp.types import Array

_SHARES = (0.2, 0.3, 0.5)  # of the levels 0, 1 and 2 at level 3
_SHAPES = 40  # on a cluttered wall
_TINTS, _OBJECT_TINT = 0.5, 0.15  # largest change of a body's colour, and of the object's
_LIGHT, _WARMTH = 0.35, 0.1  # largest change of brightness across the image, and of its colours
_JPEG, _GRAIN, _STRENGTH = (25, 95), (0.5, 3.0), 40.0  # quality; grain's size [pixels] and deviation [grey levels]
_ZOOM, _SHAKE, _NOISE = 0.1, 1.5, 8.0  # of the size, [pixels] and [grey levels], at most


def filmed(frames: Sequence[Frame], level: int, rng: np.random.Generator) -> list[Frame]:
    """The frames of a clip in surroundings of a level. Raises ProblemError unless it is 0, 1, 2 or 3."""
    if level not in range(4):
        raise ProblemError(f"surroundings must be 0, 1, 2 or 3, got {level}.")
    level = int(rng.choice(3, p=_SHARES)) if level == 3 else level
    if level == 0:
        return list(frames)
    shape = frames[0].rgb.shape
    if level == 1:
        return _in_front_of(frames, np.broadcast_to(rng.integers(0, 256, 3), shape).astype(np.uint8))
    frames = _tinted(_in_front_of(frames, clutter(rng, *shape[:2])), rng)
    return _compressed(_noisy(_lit(_shaken(frames, rng), rng), rng), int(rng.integers(20, 34)))


def random_view(frame: Frame, rng: np.random.Generator) -> Frame:
    """One frame in surroundings of its own, compressed as a picture; its `place` may be several points."""
    level = int(rng.choice(3, p=_SHARES))
    if level < 2:
        return filmed([frame], level, rng)[0]
    wall = textured(clutter(rng, *frame.rgb.shape[:2]), rng)
    view = _noisy(_lit(_shaken(_tinted(_in_front_of([frame], wall), rng), rng), rng), rng)[0]
    _, data = cv2.imencode(".jpg", view.rgb, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(*_JPEG))])
    return _with(view, np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), np.uint8))


def without_bottle(frame: Frame) -> Frame:
    """The frame with white wall in the place of the bottle and its edge."""
    there = cv2.dilate(frame.bottle.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    rgb = np.where(there[..., None], np.uint8(255), frame.rgb)
    return Frame(rgb, np.zeros_like(frame.bottle), frame.place, np.where(there, -1, _parts(frame)))


def textured(wall: Frames, rng: np.random.Generator) -> Frames:
    """The wall (height, width, 3) with grain of a random size and strength, grey or coloured."""
    height, width, colours = wall.shape
    noise = rng.normal(0, 1, (height, width, int(rng.choice([1, colours]))))
    grain = np.asarray(cv2.GaussianBlur(noise, (0, 0), rng.uniform(*_GRAIN)), float).reshape(height, width, -1)
    strength = rng.uniform(0, _STRENGTH) / grain.std()
    return np.clip(wall + strength * grain, 0, 255).astype(np.uint8)


def clutter(rng: np.random.Generator, height: int, width: int) -> Frames:
    """A wall (height, width, 3) of coloured boxes, discs and lines on blurred blobs."""
    small = rng.integers(0, 256, (5, 5, 3), np.uint8)
    wall = np.array(cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)
    size = max(height, width)
    for _ in range(int(rng.integers(_SHAPES // 2, _SHAPES))):
        (x, y), (dx, dy) = rng.integers(0, size, 2).tolist(), rng.integers(3, size // 4, 2).tolist()
        colour = tuple(rng.integers(0, 256, 3).tolist())
        kind = rng.integers(3)
        if kind == 0:
            cv2.rectangle(wall, (x, y), (x + dx, y + dy), colour, -1)
        elif kind == 1:
            cv2.circle(wall, (x, y), dx // 2 + 2, colour, -1, cv2.LINE_AA)
        else:
            cv2.line(wall, (x, y), (x + dx, y - dy), colour, int(rng.integers(1, 5)), cv2.LINE_AA)
    return wall


def _in_front_of(frames: Sequence[Frame], wall: Frames) -> list[Frame]:
    """The frames with another wall behind everything."""
    return [_with(frame, np.where((_parts(frame) < 0)[..., None], wall, frame.rgb)) for frame in frames]


def _tinted(frames: Sequence[Frame], rng: np.random.Generator) -> list[Frame]:
    """Every body in another colour, the object in nearly its own."""
    bodies = np.unique(np.concatenate([np.unique(_parts(frame)) for frame in frames]))
    tints = {int(body): rng.uniform(1 - _TINTS, 1 + _TINTS, 3) for body in bodies if body >= 0}
    own = rng.uniform(1 - _OBJECT_TINT, 1 + _OBJECT_TINT, 3)
    tinted = []
    for frame in frames:
        gain = np.ones(frame.rgb.shape)
        for body, tint in tints.items():
            gain[_parts(frame) == body] = tint
        gain[frame.bottle] = own
        tinted.append(_with(frame, frame.rgb * gain))
    return tinted


def _lit(frames: Sequence[Frame], rng: np.random.Generator) -> list[Frame]:
    """A gradient of brightness in a random direction, and light of another colour."""
    height, width = frames[0].rgb.shape[:2]
    angle = rng.uniform(0, 2 * np.pi)
    along = np.linspace(-1, 1, width) * np.cos(angle) + np.linspace(-1, 1, height)[:, None] * np.sin(angle)
    light = (1 + rng.uniform(-_LIGHT, _LIGHT) * along + rng.uniform(-_LIGHT, _LIGHT / 2))[..., None]
    light = light * rng.uniform(1 - _WARMTH, 1 + _WARMTH, 3)
    return [_with(frame, frame.rgb * light) for frame in frames]


def _shaken(frames: Sequence[Frame], rng: np.random.Generator) -> list[Frame]:
    """Another size, and a camera that shakes; masks and places follow."""
    height, width = frames[0].rgb.shape[:2]
    zoom, middle = rng.uniform(1 - _ZOOM, 1 + _ZOOM), np.array([width, height]) / 2
    shaken = []
    for frame in frames:
        offset = middle - zoom * middle + rng.uniform(-_SHAKE, _SHAKE, 2)
        # Pixel centres are at half coordinates, where OpenCV has them at whole ones.
        motion = np.column_stack([zoom * np.eye(2), offset + (zoom - 1) / 2])
        rgb = cv2.warpAffine(frame.rgb, motion, (width, height), borderMode=cv2.BORDER_REFLECT)
        mask = cv2.warpAffine(frame.bottle.astype(np.uint8), motion, (width, height), flags=cv2.INTER_NEAREST)
        shaken.append(Frame(np.asarray(rgb, np.uint8), mask > 0, zoom * frame.place + offset))
    return shaken


def _noisy(frames: Sequence[Frame], rng: np.random.Generator) -> list[Frame]:
    deviation = rng.uniform(0, _NOISE)
    return [_with(frame, frame.rgb + rng.normal(0, deviation, frame.rgb.shape)) for frame in frames]


def _compressed(frames: Sequence[Frame], quality: int) -> list[Frame]:
    """The frames after H.264 at a constant rate factor."""
    with tempfile.TemporaryDirectory() as folder:
        path = write_video(Path(folder) / "clip.mp4", (f.rgb for f in frames), 30, codec="h264", quality=quality)
        return [_with(frame, image) for frame, (_, image) in zip(frames, decode(path), strict=True)]


def _parts(frame: Frame) -> NDArray[np.int32]:
    if frame.parts is None:
        raise ProblemError("surroundings need frames with `parts`, which say what each pixel shows.")
    return frame.parts


def _with(frame: Frame, image: Array | Frames) -> Frame:
    rgb = np.clip(np.round(image), 0, 255).astype(np.uint8)
    return Frame(rgb, frame.bottle, frame.place, frame.parts)
