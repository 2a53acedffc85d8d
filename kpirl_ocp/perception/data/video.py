"""Videos: written without loss, read from whatever a user has, and brought to the size and rate of a demonstration."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.errors import EpisodeError
from kpirl_ocp.types import Indices

Frames = NDArray[np.uint8]  # (n, H, W, 3) RGB

_SUFFIXES = (".mp4", ".avi", ".webm", ".mkv", ".mov")


def write_video(path: str | Path, frames: Frames, rate: float, codec: str = "FFV1") -> Path:
    """Write frames (n, H, W, 3) uint8 RGB at `rate` [Hz]; FFV1 in .avi is lossless, "mp4v" in .mp4 is not.

    Raises EpisodeError for frames of another kind, or if the file cannot be written.
    """
    path, frames = Path(path), np.asarray(frames)
    if frames.ndim != 4 or frames.shape[3] != 3 or frames.dtype != np.uint8 or not len(frames):
        raise EpisodeError(f"{path}: frames must be (n, H, W, 3) uint8, got {frames.shape} {frames.dtype}.")
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    writer = cv2.VideoWriter(str(part), cv2.VideoWriter.fourcc(*codec), rate, (frames.shape[2], frames.shape[1]))
    if not writer.isOpened():
        raise EpisodeError(f"{path} cannot be written with the codec {codec}; does the directory exist?")
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    writer.release()
    part.replace(path)
    return path


def read_demonstration(
    path: str | Path, *, rate: float = 5.0, size: int = 240, source_rate: float | None = None
) -> Frames:
    """Frames (n, size, size, 3) of a video file or a folder of PNGs, at `rate` [Hz], cropped to a square in the middle.

    source_rate: [Hz] of the source; a video file says it itself, a folder of PNGs must be told.

    Raises EpisodeError, naming the file and the reason.
    """
    path = Path(path)
    if path.is_dir():
        if source_rate is None:
            raise EpisodeError(f"{path} is a folder of images: say its frame rate with source_rate.")
        frames = _read_images(path)
    else:
        frames, recorded = _read_file(path)
        source_rate = source_rate or recorded
    if not 0 < rate <= source_rate:
        raise EpisodeError(f"{path} has {source_rate:g} frames per second; {rate:g} cannot be taken from it.")
    return np.array([_square(frames[index], size) for index in every(len(frames), source_rate, rate)])


def every(count: int, source_rate: float, rate: float) -> Indices:
    """Which of `count` frames recorded at source_rate [Hz] to take for `rate` [Hz]."""
    chosen = np.arange(0, count, source_rate / rate).round().astype(int)
    return chosen[chosen < count]


def _read_file(path: Path) -> tuple[list[Frames], float]:
    if not path.is_file():
        raise EpisodeError(f"there is no video {path}.")
    if path.suffix.lower() not in _SUFFIXES:
        raise EpisodeError(f"{path} is not a video: expected one of {', '.join(_SUFFIXES)}, or a folder of PNGs.")
    capture = cv2.VideoCapture(str(path))
    frames, rate = [], capture.get(cv2.CAP_PROP_FPS)
    while (found := capture.read())[0]:
        frames.append(_rgb(found[1]))
    capture.release()
    if not frames or not rate > 0:
        raise EpisodeError(f"{path} cannot be decoded as a video; is it complete?")
    return frames, rate


def _read_images(folder: Path) -> list[Frames]:
    paths = sorted(folder.glob("*.png"))
    if not paths:
        raise EpisodeError(f"the folder {folder} holds no PNG images.")
    images = []
    for path in paths:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            raise EpisodeError(f"{path} cannot be read as an image.")
        images.append(_rgb(image))
    if len({image.shape for image in images}) > 1:
        raise EpisodeError(f"the images in {folder} differ in size.")
    return images


def _rgb(image: cv2.typing.MatLike) -> Frames:
    """OpenCV's BGR as RGB."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def _square(frame: Frames, size: int) -> Frames:
    """The largest square in the middle, resized; area averaging when it shrinks."""
    height, width = frame.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    square = frame[top : top + side, left : left + side]
    if side == size:
        return square
    method = cv2.INTER_AREA if size < side else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(square, (size, size), interpolation=method), np.uint8)
