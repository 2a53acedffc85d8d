"""A controller as a folder of C99: generated functions, hand-written control flow, build files, example and test."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

import kpirl_ocp.ocp.export.manifest as manifest
from kpirl_ocp.errors import FileError, ProblemError
from kpirl_ocp.ocp.codegen import portable_c, templates
from kpirl_ocp.ocp.codegen.target import Target
from kpirl_ocp.ocp.codegen.templates import PREFIX
from kpirl_ocp.ocp.export.constants import configuration, data, dimensions
from kpirl_ocp.ocp.export.records import Record, header, record
from kpirl_ocp.ocp.export.targets import target_of
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Solver
from kpirl_ocp.ocp.problem.statement.checks import numbers, shown
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.types import Array, Status

_FACE = (".h", ".hpp", "_setup.c", "_solve.c", "_controller.h", "_controller.c", "_memory.h", "_dimensions.h")
# What every solver takes from the core.
_MATHEMATICS = ("_number.h", "_status.h", "_model.h", "_real.h", "_real.c", "_kernels.h", "_kernels.c")
_TESTS = [f"test/{name}.c" for name in ("test", "stress", "fuzz", "timing")]
_AROUND = ["CMakeLists.txt", "Makefile", "README.md", "example/main.c", *_TESTS]


def export_c(
    problem: OCP,
    solver: Solver,
    directory: str | Path,
    *,
    prefix: str = PREFIX,
    psi: ArrayLike | None = None,
    examples: Sequence[tuple[ArrayLike, ArrayLike]] | None = None,
    preview: ArrayLike | None = None,
) -> Path:
    """Write the controller into a directory, and return it. What an earlier export left there is removed.

    Args:
        problem: becomes C whole; its bounds, and for `Riccati` its schedule, can be changed at run time.
        solver: `Riccati`, `GradientDescent` or `SQP`.
        directory: created if it does not exist.
        prefix: of all names and files.
        psi: (n_psi,) the parameters of a new controller, by default ones. They can be changed at run time.
        examples: pairs of s0 (n_s,) and context (n_c,), by default one of zeros. They are solved in Python, the C test
            compares with them, and the C example starts from the first.
        preview: (m, n_d) rows that follow the schedule, where they are known. The C example, a closed loop, then has
            rows k .. k+T in period k; without them it has the same schedule in every period. `Riccati` alone.

    Raises:
        ProblemError: a solver that cannot be exported, with those that can; a problem that the solver does not handle,
            or for which CasADi generates no C; a wrong psi, example, preview or prefix; an example at which it is not
            finite.
        FileError: the directory cannot be written, or holds files of an earlier export that were changed since.
    """
    templates.check_prefix(prefix)
    portable_c.refuse_libraries(filter(None, manifest.functions_of(problem)))
    target = target_of(problem, solver)
    n_s, n_psi, n_c = problem.n_states, problem.n_parameters, problem.n_context
    _, parameters, _ = problem.inputs(np.zeros(n_s), np.ones(n_psi) if psi is None else psi, np.zeros(n_c))
    pairs = [(np.zeros(n_s), np.zeros(n_c))] if examples is None else examples
    _check_finite("psi", parameters)
    _check_pairs(pairs)
    for pair in pairs:
        _check_finite("an example", *map(np.asarray, pair))
    periods = _periods(problem, solver, preview)
    files = _sources(problem, solver, target, parameters)
    files |= _around(problem, solver, files)
    core = templates.core_files()  # which does not see the type of that name
    code = [text for name, text in files.items() if name.endswith((".c", ".h")) and name not in core]
    templates.check_names(prefix, code)
    records = [record(problem, solver, parameters, *pair) for pair in pairs]
    for each in records:
        _check_solved(each)
    files["test/records.h"] = header(records, target, periods)

    files = {templates.renamed(name, prefix): templates.renamed(text, prefix) for name, text in files.items()}
    out = Path(directory)
    described = manifest.write(problem, solver, target, prefix, parameters, files)
    try:
        manifest.remove_former(out, files)
        _write(out, files | {manifest.NAME: described})
    except OSError as error:
        raise FileError(f"cannot write a controller to {str(out)!r}: {error.strerror}.") from error
    return out


def _periods(problem: OCP, solver: Solver, preview: ArrayLike | None) -> Array:
    """The schedule and what follows it (T+1+m, n_d)."""
    schedule = np.asarray(problem.schedule, float)
    if preview is None:
        return schedule
    if not schedule.size:
        raise ProblemError("preview has rows that follow the schedule, and the problem has no schedule.")
    rows = numbers("preview", preview)
    if rows.ndim != 2 or rows.shape[1] != schedule.shape[1]:
        raise ProblemError(f"preview must be rows (m, {schedule.shape[1]}) of the schedule, got shape {rows.shape}.")
    if not isinstance(solver, Riccati):
        raise ProblemError(f"preview is for Riccati: {type(solver).__name__} has its schedule compiled in.")
    _check_finite("preview", rows)
    return np.vstack([schedule, rows])


def _check_pairs(examples: Sequence[object]) -> None:
    if not len(examples) or not all(isinstance(pair, list | tuple) and len(pair) == 2 for pair in examples):
        raise ProblemError(
            f"examples must be pairs of s0 and context, at least one, as in [([0, 0], [1])]; got {shown(examples)}."
        )


def _check_finite(what: str, *arrays: Array) -> None:
    if not all(np.isfinite(np.asarray(array, float)).all() for array in arrays):
        raise ProblemError(f"{what} must be finite; it holds NaN or infinity.")


def _check_solved(example: Record) -> None:
    solved = (example.cold, example.warm)
    if any(s.status is Status.NOT_FINITE or np.isnan(s.actions).any() or not np.isfinite(s.objective) for s in solved):
        raise ProblemError(
            f"the example with s0 = {example.s0.tolist()} meets NaN or infinity: check dynamics, costs, constraints "
            "and their derivatives there, or give another example."
        )


def _sources(problem: OCP, solver: Solver, target: Target, psi: Array) -> dict[str, str]:
    """Texts of the C files by name."""
    face, solving = [f"{PREFIX}{ending}" for ending in _FACE], [f"{PREFIX}_{name}" for name in target.sources]
    core = templates.core_files()
    kept = core if target.with_core else [f"{PREFIX}{ending}" for ending in _MATHEMATICS]
    return {
        **{name: templates.read(name) for name in face},
        **{name: templates.read(f"solver/{name}") for name in solving},
        **{name: core[name] for name in kept},
        f"{PREFIX}_config.h": configuration(problem, target),
        f"{PREFIX}_data.c": data(problem, solver, target, psi),
        f"{PREFIX}_functions.h": portable_c.declarations(target.functions, target.interfaces),
        f"{PREFIX}_functions.c": portable_c.definitions(target.functions, target.interfaces),
    }


def _around(problem: OCP, solver: Solver, code: Iterable[str]) -> dict[str, str]:
    """Build files, example and test; code: names of the C files."""
    words = {
        "SOURCES": " ".join(sorted(name for name in code if name.endswith(".c"))),
        "TITLE": PREFIX,
        "VERSION": version("kpirl-ocp"),
        "SOLVER": str(solver),
        **{key: str(value) for key, value in dimensions(problem).items()},
        "STATIC": str(len(problem.additions.static)),
        "END_SLACKS": str(problem.additions.end_slacks),
        "SLACKS": str(problem.additions.slacks),
    }
    files = {name: templates.read(name) for name in _AROUND}
    for word, replacement in words.items():
        files = {name: text.replace(f"@{word}@", replacement) for name, text in files.items()}
    return files


def _write(folder: Path, files: Mapping[str, str]) -> None:
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
