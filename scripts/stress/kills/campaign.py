"""Kill a program at a random moment, start it again, and compare what it leaves with a run that was left in peace."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from bench.part import Part, Table
from tqdm import tqdm

import kpirl_ocp
from stress.kills.programs import DATA, PROGRAMS, Program
from stress.settings import Profile

_HASH = re.compile(r"-[0-9a-f]{16}(?=\.npz$)")
QUICK = ("data collection", "cost learning")
_NOTE = (
    "The same bytes: of every file but those that hold times or paths, and of every array but measured seconds. "
    "Left: names that end in `.part`, and the like."
)


def measure(profile: Profile) -> Part:
    """Every program, at least `profile.kills` times."""
    programs = [program for program in PROGRAMS if profile.every_program or program.name in QUICK]
    with tempfile.TemporaryDirectory() as base:
        data = Path(base) / "data"
        if profile.every_program:
            for program in DATA:
                _run(program, data, data / program.name)
        found = {program.name: torment(program, data, Path(base), profile.kills) for program in programs}
    rows = [[name, profile.kills, *numbers.values()] for name, numbers in found.items()]
    header = ["program", "kills", "with work to go on from", "runs that ended", "other bytes", "left"]
    return Part(found, [Table("kill -9 at random moments", header, rows, _NOTE)])


def torment(program: Program, data: Path, base: Path, kills: int) -> dict[str, object]:
    """Count the kills that left work, the runs that ended, files other than those of a run in peace, and leftovers."""
    peaceful, out = base / f"{program.name} in peace", base / program.name
    started = time.monotonic()
    _run(program, data, peaceful)
    length, rng = program.share * (time.monotonic() - started), np.random.default_rng(0)
    kept, ended, different, left = 0, 0, set(), set()
    for number in tqdm(range(kills + 1), program.name, unit="kill"):
        while _ends(program, data, out, rng.uniform(0, length) if number < kills else None):
            ended += 1
            different |= _different(program, peaceful, out)
            left |= {path.name for path in _files(out).values() if ".part" in path.name}
            shutil.rmtree(out)
            if number == kills:
                break
        kept += any(Path(name).name not in program.volatile and ".part" not in name for name in _files(out))
    return {"kept": kept, "ended": ended, "different": sorted(different), "left": sorted(left)}


def _ends(program: Program, data: Path, out: Path, moment: float | None) -> bool:
    """Whether the program ended; False: it was killed at this moment [s], with its workers."""
    process = _start(program, data, out)
    try:
        _, errors = process.communicate(timeout=moment)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return False
    if process.returncode not in program.codes:
        raise RuntimeError(f"{program.name} did not go on: {errors}")
    return True


def _run(program: Program, data: Path, out: Path) -> None:
    if not _ends(program, data, out, 3600):
        raise RuntimeError(f"{program.name} did not end")


def _start(program: Program, data: Path, out: Path) -> subprocess.Popen:
    root = Path(kpirl_ocp.__file__).parents[1]  # that of this process, also where another lies beside the scripts
    environment = os.environ | {"PYTHONPATH": f"{root}:{os.environ.get('PYTHONPATH', '')}"}
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(program.command(data, out), env=environment, start_new_session=True, **pipes)


def _files(out: Path) -> dict[str, Path]:
    """By name, without the hash of what a result depends on, measured times among it."""
    return {_HASH.sub("", str(path.relative_to(out))): path for path in out.rglob("*") if path.is_file()}


def _different(program: Program, peaceful: Path, out: Path) -> set[str]:
    """Files that only one of them has, or that differ."""
    one, other = _files(peaceful), _files(out)
    names = {name for name in one.keys() | other.keys() if Path(name).name not in program.volatile}
    return {name for name in names if name not in one or name not in other or not _same(one[name], other[name])}


def _same(one: Path, other: Path) -> bool:
    if one.read_bytes() == other.read_bytes():
        return True
    return one.suffix == ".npz" and _arrays(one) == _arrays(other)


def _arrays(path: Path) -> dict[str, bytes]:
    with np.load(path, allow_pickle=False) as file:
        return {name: array.tobytes() for name, array in file.items() if not name.endswith("seconds")}
