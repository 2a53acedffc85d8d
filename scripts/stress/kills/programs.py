"""Programs that are killed: every one that works for long and can go on, at a tiny size."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import kpirl_ocp

_SCRIPTS = Path(__file__).parents[2]
_KPIRL = str(Path(kpirl_ocp.__file__).with_name("cli"))  # -m: of the working directory


@dataclass(frozen=True)
class Program:
    """name; words: the command, with {data} and {out}; needs: programs that make {data} first.

    codes: exit codes of a run that ended. volatile: files that hold times, or paths, and differ from run to run.
    share: of its length, within which it is killed; it goes on, so that later starts reach the rest.
    """

    name: str
    words: Sequence[str]
    codes: tuple[int, ...] = (0,)
    volatile: tuple[str, ...] = ("metrics.json", "config.yaml")
    share: float = 1.0

    def command(self, data: Path, out: Path) -> list[str]:
        """To be run."""
        return [sys.executable, *(word.format(scripts=_SCRIPTS, data=data, out=out) for word in self.words)]


def _kpirl(name: str, *words: str, **more) -> Program:
    return Program(name, [_KPIRL, *words, "--out", "{out}"], **more)


DATA = (
    _kpirl("keypoints", "collect", "keypoints", "--frames", "6", "--episodes", "2", "--jobs", "1"),
    _kpirl("sines", "collect", "sines", "--steps", "6", "--episodes", "4", "--jobs", "1"),
    _kpirl(
        "detector",
        *("train-keypoints", "--data", "{data}/keypoints", "--preset", "tiny", "--steps", "3", "--threads", "1"),
        codes=(0, 2),
    ),
)
PROGRAMS = (
    _kpirl("data collection", "collect", "keypoints", "--frames", "2", "--episodes", "60"),
    _kpirl("cost learning", "learn", "--iterations", "600", "--task", "reaching"),
    _kpirl(
        "detector training",
        *("train-keypoints", "--data", "{data}/keypoints", "--preset", "tiny", "--steps", "300", "--threads", "1"),
        codes=(0, 2),  # a detector of so few steps is not good
    ),
    _kpirl(
        "dynamics training",
        *("train-dynamics", "--detector", "{data}/detector/rejected.json", "--epochs", "300", "--ahead", "3"),
        *("--data", "{data}/sines", "--test", "{data}/sines"),
    ),
    Program(
        "reproduction of the paper",
        ["{scripts}/reproduce_paper.py", "--preset", "tiny", "--jobs", "1", "--out", "{out}"],
        volatile=("metrics.json", "config.yaml", "report.html"),
        share=0.2,
    ),
)
