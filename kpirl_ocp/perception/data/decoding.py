"""Video files decoded by FFmpeg (PyAV), one frame at a time: upright, with square pixels, at the file's own times."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from shlex import quote

import av
import av.error
import av.logging
import numpy as np
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray

from kpirl_ocp.errors import FileError

VIDEO_SUFFIXES = (
    *(".mp4", ".m4v", ".mov", ".3gp", ".3g2", ".avi", ".webm", ".mkv", ".mts"),
    *(".m2ts", ".ts", ".mpg", ".mpeg", ".wmv", ".flv", ".ogv", ".gif"),
)
_MOST_PIXELS = 89_478_485  # of a frame, as Pillow reads pictures; 8K has 33 million


def decode(path: Path, end: float = np.inf) -> Iterator[tuple[float, NDArray[np.uint8]]]:
    """Time [s] since the first frame and image (H, W, 3) RGB of every frame up to the time `end`.

    The rotation that a phone writes into the file is applied. The file may be damaged or missing after `end`.

    Raises:
        FileError: the file is missing, no video, of an unknown codec, damaged or incomplete, its times fall, or its
            frames have more than 89 million pixels, which is checked before memory is allocated.
    """
    if not path.is_file():
        raise FileError(f"there is no video {path}.")
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        raise FileError(f"{path} is not a video: expected one of {', '.join(VIDEO_SUFFIXES)}, or a folder of pictures.")
    container, stream = _open(path)
    convert = VideoReformatter()  # one of its own for every frame would start its threads anew
    first: float | None = None
    time = longest = 0.0  # of the last frame, and the longest pause between two frames [s]
    with container:
        stream.thread_type = "AUTO"
        period = float(1 / stream.average_rate) if stream.average_rate else 0.0  # of a film with one frame
        promised = _promised_seconds(container, stream)
        try:
            for frame in container.decode(stream):
                stamp = float(frame.time or 0.0)
                first = stamp if first is None else first
                if stamp - first < time:
                    raise FileError(f"{path}: the times of its frames do not rise. {_conversion(path)}")
                period, time = stamp - first - time or period, stamp - first
                longest = max(longest, period)
                if time > end + 1e-6:
                    return
                yield time, _upright(frame, path, stream, convert)
        except av.error.FFmpegError as error:
            if not stream.codec_context.width:  # only the frame's own header has its size
                raise FileError(
                    f"{path} is damaged, or its frames have more than {_MOST_PIXELS / 1e6:.0f} million pixels."
                ) from error
            raise FileError(
                f"{path} is damaged or incomplete after {time:.2f} of {promised:.2f} s: copy it again, or end before "
                "that (--end)."
            ) from error
    if first is None:
        raise FileError(f"{path} cannot be decoded as a video; is it complete?")
    if time + period < end:
        _check_complete(path, time + period, promised, longest)


def _check_complete(path: Path, lasted: float, promised: float, longest: float) -> None:
    """Raise FileError if a film that lasted so long [s] is shorter than promised by more than its `longest` pause."""
    if promised - lasted > max(2 * longest, min(0.25, 0.1 * promised)):
        raise FileError(
            f"{path} is incomplete: it ends after {lasted:.2f} of {promised:.2f} s. Copy it again, or end before that "
            "(--end)."
        )


def _open(path: Path) -> tuple[av.container.InputContainer, av.VideoStream]:
    """The file and its first video stream. Raises FileError if there is none that can be decoded."""
    level = av.logging.get_level()
    with av.logging.Capture() as log:
        av.logging.set_level(av.logging.WARNING)
        try:
            container = av.open(str(path))
        except av.error.FFmpegError as error:
            raise FileError(f"{path} cannot be decoded as a video; is it complete? ({error.strerror})") from error
        finally:
            av.logging.set_level(level)
    streams = container.streams.video
    if not streams:
        raise FileError(f"{path} holds no video, only sound or subtitles.")
    if streams[0].codec_context is None:
        found = re.search(r"Video: (\S+)(?: \((\S+))?", " ".join(text for _, _, text in log))
        codec = next((name for name in reversed(found.groups()) if name), "?") if found else "?"
        raise FileError(f"{path}: its codec {codec!r} cannot be decoded here. {_conversion(path)}")
    context = streams[0].codec_context
    _square_size(path, context.width, context.height, streams[0])
    context.options = {"max_pixels": str(_MOST_PIXELS)}  # frames may be larger than the header says
    return container, streams[0]


def _conversion(path: Path) -> str:
    """The advice to convert a film, with the command on a line of its own."""
    written = path.with_name(f"{path.stem}-h264.mp4")
    command = f"ffmpeg -i {quote(str(path))} -c:v libx264 -pix_fmt yuv420p {quote(str(written))}"
    return f"Convert it with\n    {command}\nand take the film that this writes."


def _promised_seconds(container: av.container.InputContainer, stream: av.VideoStream) -> float:
    """Duration that the file states [s]; 0 if it states none."""
    counted = stream.frames / stream.average_rate if stream.average_rate else 0
    timed = stream.duration * stream.time_base if stream.duration and stream.time_base else 0
    alone = len(container.streams.get()) == 1  # sound may be longer than the picture
    whole = container.duration / av.time_base if container.duration and alone else 0
    return float(max(counted, timed, whole))


def _square_size(path: Path, width: int, height: int, stream: av.VideoStream) -> tuple[int, int]:
    """Width and height of a frame after its pixels are made square by stretching it.

    Raises FileError if it is too large.
    """
    aspect = float(stream.sample_aspect_ratio or stream.codec_context.sample_aspect_ratio or 1)
    wide, high = round(width * max(1.0, aspect)), round(height * max(1.0, 1 / aspect))
    if wide * high > _MOST_PIXELS:
        raise FileError(
            f"{path} has frames of {wide} x {high} pixels; at most {_MOST_PIXELS / 1e6:.0f} million pixels are read."
        )
    return wide, high


def _upright(frame: av.VideoFrame, path: Path, stream: av.VideoStream, convert: VideoReformatter) -> NDArray[np.uint8]:
    """The frame as (H, W, 3) RGB, with square pixels, and turned upright."""
    width, height = _square_size(path, frame.width, frame.height, stream)
    image = convert.reformat(frame, width, height, "rgb24").to_ndarray()
    return np.ascontiguousarray(np.rot90(image, round(frame.rotation / 90)))
