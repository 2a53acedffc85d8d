"""Videos and folders of pictures, read frame by frame at the size and rate that is needed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.errors import FileError
from kpirl_ocp.perception.data.decoding import decode
from kpirl_ocp.perception.data.pictures import PICTURE_SUFFIXES, iterate_pictures, pictures_in
from kpirl_ocp.sizes import LARGEST
from kpirl_ocp.types import Indices

Frames = NDArray[np.uint8]  # (n, H, W, 3) RGB

_REPEATED = 0.1  # largest share of the samples that may show the same frame as the one before
_PAUSE = 1000  # samples that may do so in any case, while frames are read: the times in a file may be wrong

T = TypeVar("T")


def iterate_frames(
    path: str | Path, *, source_rate: float | None = None, longest: int | None = None, end: float = np.inf
) -> Iterator[tuple[float, Frames]]:
    """Time [s] since the first frame and image (H, W, 3) RGB of every frame, one at a time.

    Args:
        path: a video, or a folder of PNG or JPEG pictures in the order of the numbers in their names.
        source_rate: [Hz] of a folder of pictures; a video has times of its own.
        longest: larger frames are scaled down until their longer side has this many pixels.
        end: [s] of the last frame; the file may be damaged after it.

    Raises:
        FileError: the file is missing, no video, of an unknown codec or incomplete.
    """
    path = Path(path)
    if path.is_dir() and source_rate is None:
        pictures_in(path)  # refuses a folder without any
        raise FileError(f"{path} is a folder of images: give its frame rate with source_rate (--source-rate).")
    if path.is_file() and path.suffix.lower() in PICTURE_SUFFIXES:
        raise FileError(f"{path} is one picture, which shows no motion: give a video, or a folder of pictures.")
    if not path.is_dir() and source_rate is not None:
        raise FileError(f"{path} is no folder of images; source_rate is for those, a video has times of its own.")
    frames = decode(path, end) if source_rate is None else _paced(iterate_pictures(path), source_rate)
    for time, image in frames:
        if time > end + 1e-6:
            return
        yield time, _shrunk(image, longest)


def sampled(items: Iterable[tuple[float, T]], rate: float, start: float = 0.0) -> Iterator[tuple[float, T]]:
    """Of items at rising times [s], the nearest ones to start + k / rate, k = 0, 1, ...; two items in memory."""
    count = 0
    before: tuple[float, T] | None = None
    gap = 0.0
    for time, item in items:
        while before is not None and start + count / rate < (before[0] + time) / 2:
            yield before
            count += 1
        gap = 0.0 if before is None else time - before[0]
        before = time, item
    while before is not None and start + count / rate < before[0] + max(gap / 2, 1e-9):
        yield before
        count += 1


def sampled_frames(
    path: str | Path,
    rate: float,
    *,
    source_rate: float | None = None,
    start: float = 0.0,
    end: float = np.inf,
) -> Iterator[tuple[float, Frames]]:
    """The frames of `iterate_frames` nearest to start + k / rate, k = 0, 1, ... [s].

    Raises FileError as it does, and if the source has fewer frames per second than `rate`, or ends before `start`.
    """
    if not rate > 0:
        raise FileError(f"{path} cannot be read at {rate:g} frames per second.")
    times: list[float] = []
    last, count, repeated = -1.0, 0, 0
    frames = _noting(iterate_frames(path, source_rate=source_rate, end=end), times)
    for time, image in sampled(frames, rate, start):
        count, repeated, last = count + 1, repeated + (time == last), time
        if repeated > max(_PAUSE, _REPEATED * count):
            break
        yield time, image
    if not count:
        raise FileError(f"{path} ends after {times[-1]:.2f} s; there is nothing from {start:g} s on.")
    if repeated > _REPEATED * count:
        found = (len(times) - 1) / times[-1] if len(times) > 1 else 0.0
        raise FileError(f"{path} has {found:.4g} frames per second; {rate:g} cannot be taken from it.")


def read_demonstration(
    path: str | Path, *, rate: float = 5.0, size: int = 240, source_rate: float | None = None
) -> Frames:
    """Frames (n, size, size, 3) of a video or a folder of pictures at `rate` [Hz], cropped to a square in the middle.

    source_rate: [Hz] of a folder of pictures. Raises FileError as `sampled_frames`, and for more than 2 GiB of frames.
    """
    frames: list[Frames] = []
    for _, image in sampled_frames(path, rate, source_rate=source_rate):
        frames.append(_square(image, size))
        if len(frames) * frames[0].nbytes > LARGEST:
            raise FileError(f"{path} is too long: its frames take more than 2 GiB. Use a part of it, or a lower rate.")
    return np.array(frames)


def sample_indices(count: int, source_rate: float, rate: float) -> Indices:
    """Indices of the frames to take at `rate` [Hz] from `count` frames recorded at source_rate [Hz]."""
    return np.array([index for _, index in sampled(((i / source_rate, i) for i in range(count)), rate)], np.intp)


def _paced(images: Iterable[Frames], rate: float) -> Iterator[tuple[float, Frames]]:
    return ((index / rate, image) for index, image in enumerate(images))


def _noting(items: Iterable[tuple[float, T]], times: list[float]) -> Iterator[tuple[float, T]]:
    """The same items; their times are appended to `times`."""
    for item in items:
        times.append(item[0])
        yield item


def _shrunk(image: Frames, longest: int | None) -> Frames:
    """The image with a longer side of at most `longest` pixels, by area averaging."""
    height, width = image.shape[:2]
    if longest is None or max(height, width) <= longest:
        return image
    scale = longest / max(height, width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _square(frame: Frames, size: int) -> Frames:
    """The largest square in the middle, resized; area averaging when it shrinks."""
    height, width = frame.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    square = frame[top : top + side, left : left + side]
    if side == size:
        return square.copy()
    method = cv2.INTER_AREA if size < side else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(square, (size, size), interpolation=method), np.uint8)
