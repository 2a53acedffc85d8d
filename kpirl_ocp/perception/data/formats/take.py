"""One recorded episode as plain arrays, whatever file it came from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kpirl_ocp.episodes import Episode
from kpirl_ocp.errors import EpisodeError, KpirlError
from kpirl_ocp.perception import data  # its names need packages for videos, which a table of numbers does not
from kpirl_ocp.pictures import Brief
from kpirl_ocp.sizes import check_bytes
from kpirl_ocp.types import Array, Demonstration

if TYPE_CHECKING:
    from kpirl_ocp.perception.data import Frames

# What readers of files, numpy and Python raise where something else stands than was expected.
_UNLIKE = (OSError, ValueError, TypeError, AttributeError, LookupError, ArithmeticError, RuntimeError, EOFError)


@contextmanager
def read_as(kind: str, place: object) -> Iterator[None]:
    """A block that reads a foreign file. Raises EpisodeError, with the place, for whatever is not of its kind."""
    try:
        yield
    except KpirlError:
        raise
    except KeyError as error:
        raise EpisodeError(f"{place} is no {kind}: there is no {error.args[0]!r}.") from error
    except _UNLIKE as error:
        raise EpisodeError(f"{place} is no {kind}: {one_line(error)}") from error


def one_line(error: Exception) -> str:
    """The words of an exception of another package."""
    return " ".join("".join(c if c.isprintable() else " " for c in str(error)).split())


def checked_rate(rate: object) -> float:
    """Steps per second [Hz]. Raises EpisodeError unless they are a positive number."""
    if isinstance(rate, bool) or not isinstance(rate, int | float | np.number) or not 0 < float(rate) < np.inf:
        raise EpisodeError(f"rate must be a positive number of steps per second [Hz], got {rate!r}.")
    return float(rate)


@dataclass(frozen=True)
class VideoPart:
    """`count` frames of a video from the time `start` [s] on, recorded at `rate` [Hz]; decoded on demand."""

    path: Path
    start: float
    count: int
    rate: float

    def read(self) -> Frames:
        """Frames (count, H, W, 3) RGB. Raises EpisodeError if it is no video, holds fewer, or more than 2 GiB."""
        images: list[Frames] = []
        end = self.start + (self.count - 1) / self.rate
        for time, image in data.iterate_frames(self.path, end=end + 0.5 / self.rate):
            if time >= self.start - 0.5 / self.rate and len(images) < self.count:
                images.append(image)
                with read_as("video of bounded size", self.path):
                    check_bytes(len(images) * image.nbytes)
        if len(images) != self.count:
            raise EpisodeError(
                f"{self.path} holds {len(images)} frames from {self.start:.3f} s on, for {self.count} steps."
            )
        return np.array(images)


@dataclass(frozen=True, eq=False, repr=False)
class Take(Brief):
    """One episode of n steps.

    arrays: by name, each (n, ...) numbers, e.g. "observation.state" (n, n_joints) and "action" (n, n_u).
    times: (n,) since its start [s].
    videos: by name, frames (n, H, W, 3) uint8 RGB, or where to read them.
    task: what was done, in words.

    Raises EpisodeError for lengths that differ, for NaN or infinity, and for times that do not rise.
    """

    arrays: Mapping[str, NDArray[Any]]
    times: Array
    videos: Mapping[str, Frames | VideoPart] = field(default_factory=dict)
    task: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "arrays", {name: np.asarray(array) for name, array in self.arrays.items()})
        for name, array in [("times", np.asarray(self.times)), *self.arrays.items()]:
            if array.dtype.kind not in "bifu":
                raise EpisodeError(f"{name} must hold numbers, not {array.dtype}.")
            if not np.isfinite(array).all():
                raise EpisodeError(f"{name} holds NaN or infinity.")
            if not array.ndim:
                raise EpisodeError(f"{name} must be an array of steps, not one number.")
        object.__setattr__(self, "times", np.asarray(self.times, float))
        lengths = {name: len(array) for name, array in self.arrays.items()}
        lengths |= {name: v.count if isinstance(v, VideoPart) else len(v) for name, v in self.videos.items()}
        if self.times.ndim != 1 or not len(self.times) or set(lengths.values()) - {len(self.times)}:
            raise EpisodeError(f"all arrays of an episode need {self.times.shape} steps as its times; got {lengths}.")
        falls = np.diff(self.times) <= 0
        if falls.any():
            raise EpisodeError(f"times do not rise from step {int(np.argmax(falls)) + 1} on.")

    def __len__(self) -> int:
        """Number of steps n."""
        return len(self.times)

    def __getitem__(self, name: str) -> NDArray[Any]:
        """The array of this name (n, ...). Raises EpisodeError, with the names there are."""
        if name not in self.arrays:
            raise EpisodeError(f"the episode has no {name!r}; it has {', '.join(self.arrays)}.")
        return self.arrays[name]

    def frames(self, name: str) -> Frames:
        """The frames (n, H, W, 3) of the camera of this name. Raises EpisodeError, with the names there are."""
        if name not in self.videos:
            raise EpisodeError(f"the episode has no camera {name!r}; it has {', '.join(self.videos) or 'none'}.")
        video = self.videos[name]
        return video.read() if isinstance(video, VideoPart) else video

    def frame_size(self, name: str) -> tuple[int, int]:
        """Height and width of the frames of a camera [pixels]."""
        video = self.videos[name]
        first = replace(video, count=1).read() if isinstance(video, VideoPart) else video
        return int(first.shape[1]), int(first.shape[2])

    def demonstration(
        self, state: str = "observation.state", observation: str | None = None, context: ArrayLike = ()
    ) -> Demonstration:
        """The take as a demonstration of T = n - 1 steps.

        Args:
            state: name of the array whose first row is s_0.
            observation: name of the array that the loss compares with the planned observations; default: `state`.
            context: (n_c,) known beforehand, e.g. the goal.
        """
        observations = np.asarray(self[observation or state], float).reshape(len(self), -1)
        return Demonstration(np.asarray(self[state][0], float).ravel(), np.asarray(context, float), observations)


def take_of_episode(episode: Episode, task: str = "") -> Take:
    """An episode of this package, whose T+1 states become T+1 steps; the last action is a displacement of zero."""
    still = np.zeros((1, episode.actions.shape[1]))
    arrays = {
        "observation.state": episode.joints,
        "observation.keypoints": episode.keypoints.reshape(len(episode.joints), -1),
        "action": np.vstack([episode.actions, still]),
    }
    return Take(arrays, episode.times, task=task)


def episode_of_take(take: Take) -> Episode:
    """The way back from `take_of_episode`."""
    n = len(take)
    joints, actions = (np.asarray(take[name], float) for name in ("observation.state", "action"))
    keypoints = np.asarray(take["observation.keypoints"], float).reshape(n, -1, 3)
    return Episode(joints, keypoints, actions[:-1], take.times)
