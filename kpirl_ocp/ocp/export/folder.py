"""A controller as a folder of C99: generated functions, hand-written control flow, build files, example and test."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

import kpirl_ocp
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.export import generated, templates
from kpirl_ocp.ocp.export.records import Record, record
from kpirl_ocp.ocp.export.target import Target
from kpirl_ocp.ocp.export.targets import ExportableSolver, target_of
from kpirl_ocp.ocp.problem import OCP
from kpirl_ocp.types import Array

_COMMON = (".h", ".hpp", "_memory.h", ".c")
_BUILD = ("CMakeLists.txt", "Makefile", "README.md", "example/main.c", "test/test.c", "test/fuzz.c")
_FORMAT = 1  # of the folder; a Controller refuses others


def export_c(
    problem: OCP,
    solver: ExportableSolver,
    directory: str | Path,
    *,
    prefix: str = templates.PREFIX,
    psi: ArrayLike | None = None,
    examples: Iterable[tuple[ArrayLike, ArrayLike]] = (),
) -> Path:
    """Write the controller into a directory, and return it.

    psi: (n_psi,) the parameters of a new controller, by default ones. All can be changed at run time.
    examples: pairs of s0 (n_s,) and context (n_c,) that are solved in Python; the C test compares with them, and the
        example starts from the first.

    Raises ProblemError for a solver that cannot be exported, and names those that can; and if psi or an example does
    not fit the problem, or an example cannot be solved.
    """
    prefix, out = templates.check_prefix(prefix), Path(directory)
    target = target_of(problem, solver)
    parameters = _parameters(problem, psi)
    files = _sources(problem, target, parameters)
    files |= _records(problem, solver, parameters, examples)
    files = {templates.renamed(name, prefix): templates.renamed(text, prefix) for name, text in files.items()}
    files["manifest.json"] = json.dumps(manifest(problem, target, prefix, files), indent=2) + "\n"
    for name, text in files.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(text)
    return out
