"""Memory and handles of one process over very many solves, and over very many different problems.

Compiled and built functions are cached for 512 problems; until then memory grows, and not after.
"""

from __future__ import annotations

import multiprocessing
import os
import warnings
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from bench.part import Part, Table
from problems import pendulum
from tqdm import tqdm

from kpirl_ocp import Implicit, Riccati
from kpirl_ocp.errors import KpirlError
from stress.certificates.families import draw
from stress.settings import Profile

_OPENED = 100  # runs after which everything that stays open is open
_FULL = 0.6  # share of the run after which all caches are full, in the full profile


def measure(profile: Profile) -> Part:
    """Each in a process of its own."""
    tasks = {
        "solves of one problem": (_solve, profile.solves),
        "different problems, solved and differentiated": (_problem, profile.problems),
    }
    found = {name: _alone(_grow, name, *task) for name, task in tasks.items()}
    rows = [
        [name, tasks[name][1], *(f"{found[name][key]:.1f}" for key in ("middle", "end")), found[name]["handles"]]
        for name in tasks
    ]
    header = ["", "how many", f"memory after {100 * _FULL:.0f} % [MB]", "at the end [MB]", "more open files"]
    return Part(found, [Table("Long lives of one process", header, rows)])


def _alone(work: Callable[..., dict[str, float]], *arguments: object) -> dict[str, float]:
    """The result of a function in a new process."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(work, *arguments).result()


def _grow(name: str, act: Callable[[int], None], count: int) -> dict[str, float]:
    """Resident memory [MB] in the middle and at the end, and how many more files are open at the end."""
    middle, at_start = int(_FULL * count), 0
    found = {}
    for index in tqdm(range(count), name, unit=""):
        act(index)
        if index == min(_OPENED, middle - 1):
            at_start = _handles()
        if index == middle - 1:
            found["middle"] = _resident()
    return found | {"end": _resident(), "handles": _handles() - at_start}


def _solve(index: int) -> None:
    case = pendulum()
    start = case.demonstration.s0 + 0.1 * np.sin(index + np.arange(len(case.demonstration.s0)))
    Riccati().solve(case.problem, start, case.psi, case.demonstration.context)


def _problem(index: int) -> None:
    case = draw(index)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            Implicit(Riccati(), case.loss, "flag")(case.problem, case.demonstration, case.psi, case.guess)
        except KpirlError:  # refused: some cases are meant to be
            return


def _resident() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def _handles() -> int:
    return len(os.listdir("/proc/self/fd"))
