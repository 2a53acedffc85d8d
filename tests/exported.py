"""Exported folders for tests, each written once, and how their C is built and run."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import tempfile
from functools import lru_cache
from pathlib import Path

import pytest
from problems import TABLE, Case

from kpirl_ocp.ocp.export import export_c

WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Werror")
STRICT = ("-std=c99", "-O1", *WARNINGS)
PLAIN = ("-std=c99", "-O0", *WARNINGS)  # takes half the time to compile, where only numbers and refusals count
COMPILERS = [
    pytest.param(name, marks=pytest.mark.skipif(shutil.which(name) is None, reason=f"there is no {name}"))
    for name in ("gcc", "clang")
]
C = Path(__file__).parent / "c"
_SCRATCH = tempfile.TemporaryDirectory()


@lru_cache
def folder(name: str, solver, prefix: str = "kpirl_mpc") -> tuple[Path, Case]:
    """The exported problem `name` of the table."""
    case = TABLE[name]()
    out = Path(_SCRATCH.name) / f"{len(list(Path(_SCRATCH.name).iterdir()))}"
    seen = case.demonstration
    return export_c(case.problem, solver, out, prefix=prefix, psi=case.psi, examples=[(seen.s0, seen.context)]), case


def built(out: Path, source: Path, *flags: str, compiler: str = "gcc", suffix: str = "*.c") -> str:
    """What a program made of a source and a folder prints; its compiler must be silent."""
    program = out / f"{source.stem}.out"
    command = (compiler, *flags, f"-I{out}")
    objects = [object_of(command, path) for path in (source, *sorted(out.glob(suffix)))]
    _silent(*command, *objects, "-o", str(program), "-lm", "-lpthread")
    return ran(program)


def object_of(command: tuple[str, ...], source: Path) -> str:
    """The object file of a source; folders have many sources in common, down to their headers: each is made once."""
    text = _silent(*command, "-E", "-P", str(source))
    made = Path(_SCRATCH.name) / f"{hashlib.sha256(repr((command[:-1], text)).encode()).hexdigest()}.o"
    if not made.exists():
        _silent(*command, "-c", str(source), "-o", str(made))
    return str(made)


def _silent(*command: str) -> str:
    """What a compiler writes to its output; it must succeed without a warning."""
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr[:3000]
    return done.stdout


def ran(program: Path, *arguments: str) -> str:
    """What it prints; it must succeed."""
    done = subprocess.run([str(program), *arguments], capture_output=True, text=True)
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]
    return done.stdout
