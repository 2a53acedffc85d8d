"""Clips to train on: directories of recordings, and any videos without labels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from kpirl_ocp.episodes import episode_path, iterate_episodes, read_meta
from kpirl_ocp.errors import FileError
from kpirl_ocp.perception.data.decoding import VIDEO_SUFFIXES
from kpirl_ocp.perception.data.pictures import files_in
from kpirl_ocp.perception.data.recordings import Recording, read_hand
from kpirl_ocp.perception.data.video import Frames, read_demonstration

_RATE = 5.0  # [Hz] at which a person's video is read


def read_recordings(directory: str | Path) -> list[Recording]:
    """The clips of a directory made by `kpirl collect`; those of a hand at 5 Hz."""
    directory = Path(directory)
    meta = read_meta(directory)
    if meta.get("robot") is None:
        return [read_hand(episode_path(directory, i), _RATE) for i in range(meta["episodes"])]
    return list(iterate_episodes(directory, meta["episodes"], Recording))


def read_videos(paths: Sequence[str | Path]) -> list[Frames]:
    """Frames at 5 Hz of videos, or of all videos in directories. Raises FileError if a directory has none."""
    clips = []
    for path in map(Path, paths):
        videos = files_in(path, VIDEO_SUFFIXES) if path.is_dir() else [path]
        if not videos:
            raise FileError(f"{path} holds no video ({', '.join(VIDEO_SUFFIXES)}).")
        clips += [read_demonstration(video, rate=_RATE) for video in videos]
    return clips
