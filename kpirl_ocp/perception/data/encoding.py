"""Writing videos: without loss for data, or as H.264, which every phone and browser plays."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import av
import av.error
import numpy as np

from kpirl_ocp.errors import FileError, ProblemError
from kpirl_ocp.perception.data.video import Frames

Codec = Literal["ffv1", "h264"]
_ENCODERS = {"ffv1": ("ffv1", "bgr0"), "h264": ("libx264", "yuv420p")}  # codec: encoder, pixel format


def write_video(
    path: str | Path, frames: Iterable[Frames], rate: float, codec: Codec = "ffv1", quality: int | None = None
) -> Path:
    """Write frames (n, H, W, 3) uint8 RGB, or one frame after another, at `rate` [Hz].

    codec: "ffv1" in .avi is lossless; "h264" in .mp4 is not, and leaves out an odd last row or column.
    quality: constant rate factor of H.264, from 0, the best, to 51; None for x264's own.

    Raises ProblemError for frames of another shape or type, and FileError if the file cannot be written.
    """
    path = Path(path)
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        _encode(part, path, frames, rate, codec, quality)
        part.replace(path)
    except (OSError, av.error.FFmpegError) as error:
        raise FileError(f"{path} cannot be written as {codec}; does the directory exist? ({error})") from error
    finally:
        with contextlib.suppress(OSError):  # where there is no such directory, there is no part
            part.unlink(missing_ok=True)
    return path


def _opened(part: Path, path: Path) -> Any:
    try:
        return av.open(str(part), "w")
    except ValueError as error:  # of PyAV, which knows containers by their endings
        raise FileError(f"{path} has no ending of a film: write it as .mp4 or .avi.") from error


def _encode(part: Path, path: Path, frames: Iterable[Frames], rate: float, codec: Codec, quality: int | None) -> None:
    encoder, pixels = _ENCODERS[codec]
    options = {} if quality is None else {"crf": str(quality)}
    shape: tuple[int, ...] = ()
    with _opened(part, path) as container:
        stream: Any = container.add_stream(encoder, rate=Fraction(rate).limit_denominator(1001), options=options)
        stream.pix_fmt = pixels
        for image in map(np.asarray, frames):
            if image.ndim != 3 or image.shape != (shape or (*image.shape[:2], 3)) or image.dtype != np.uint8:
                raise ProblemError(f"{path}: frames must be (n, H, W, 3) uint8, got {image.shape} {image.dtype}.")
            even = 2 if codec == "h264" else 1  # H.264 stores colours for squares of four pixels
            height, width = (side // even * even for side in image.shape[:2])
            if not shape:
                shape, stream.height, stream.width = image.shape, height, width
            whole = np.ascontiguousarray(image[:height, :width])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(whole, format="rgb24")))
        if not shape:
            raise ProblemError(f"{path}: there are no frames to write.")
        container.mux(stream.encode())
