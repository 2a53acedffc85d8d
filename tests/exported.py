"""Exported folders for tests, each written once, and how their C is built and run."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path

import pytest
from object_files import library_of, objects_of, silent
from problems import TABLE, Case

from kpirl_ocp.ocp.export import ExportedSolver, export_c, exported_solver

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


def built(out: Path, source: Path, *flags: str, compiler: str = "gcc", names: Iterable[str] | None = None) -> str:
    """What a program made of a source and a folder's sources prints; its compiler must be silent."""
    program = out / f"{source.stem}.out"
    objects = objects_of((compiler, *flags), out, names)
    silent(compiler, *flags, f"-I{out}", str(source), *objects, "-o", str(program), "-lm", "-lpthread")
    return ran(program)


def loaded(out: Path, flags: tuple[str, ...] = PLAIN, compiler: str = "gcc") -> ExportedSolver:
    """The solver of a folder, whose library is linked of objects that are made once."""

    def linked(folder: Path, flags: Sequence[str], compiler: str, names: Iterable[str]) -> Path:
        sources = [name for name in names if "/" not in name and name.endswith(".c")]
        return library_of((compiler, *flags), folder, sources)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exported_solver, "compile_folder", linked)
        return ExportedSolver(out, flags, compiler)


def ran(program: Path, *arguments: str) -> str:
    """What it prints; it must succeed."""
    done = subprocess.run([str(program), *arguments], capture_output=True, text=True)
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]
    return done.stdout
