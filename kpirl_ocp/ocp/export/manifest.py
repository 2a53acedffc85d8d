"""The manifest of an exported folder: its problem, solver and files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import FileError, ProblemError
from kpirl_ocp.ocp.codegen.target import Target
from kpirl_ocp.ocp.export.constants import dimensions, number
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Solver
from kpirl_ocp.ocp.problem.statement.checks import shown
from kpirl_ocp.sizes import LONGEST, read_json
from kpirl_ocp.types import Array

FORMAT = 2  # of the folder and its C interface
NAME = "manifest.json"
_SIZES = (
    *("horizon", "n_states", "n_actions", "n_parameters", "n_context", "n_schedule", "n_path", "n_path_equality"),
    *("n_terminal", "n_terminal_equality", "n_free"),
)
_KINDS: dict[str, type] = {
    **{"prefix": str, "solver.kind": str, "sha256": dict, "problem.free_start": list},
    **{f"problem.{name}": str for name in ("fingerprint", "schedule")},
    **{f"problem.{name}": int for name in _SIZES},
}


def write(problem: OCP, solver: Solver, target: Target, prefix: str, psi: Array, texts: Mapping[str, str]) -> str:
    """The manifest: what identifies the folder to an ExportedSolver, and a description for readers.

    texts: of the other files, by name.
    """
    content = {
        "format": FORMAT,
        "prefix": prefix,
        "solver": {"kind": target.kind, "described": str(solver)},
        "problem": {
            **{name.lower(): value for name, value in dimensions(problem).items()},
            "fingerprint": fingerprint(problem),
            "schedule": schedule_hash(problem),
            "free_start": np.flatnonzero(problem.free_start).tolist(),
            "bounds": {
                name: [_shown(bound) for bound in pair]
                for name, pair in (("state", problem.limits), ("action", problem.action_bounds))
            },
        },
        "psi": psi.tolist(),
        "versions": {name: version(name) for name in ("kpirl-ocp", "casadi", "numpy")},
        "sha256": {name: hashlib.sha256(text.encode()).hexdigest() for name, text in sorted(texts.items())},
    }
    return json.dumps(content, indent=2) + "\n"


def read(folder: Path) -> dict[str, Any]:
    """The manifest of a folder that this version reads. Raises FileError for anything else."""
    path = folder / NAME
    try:
        manifest = read_json(path)
    except FileNotFoundError:
        raise FileError(f"{path} does not exist: export a controller with export_c or `kpirl export`.") from None
    except (OSError, ValueError) as error:
        raise FileError(f"{path} cannot be read: {error}.") from error
    found = manifest.get("format") if isinstance(manifest, dict) else None
    if found != FORMAT:
        raise FileError(f"{path} has format {found!r}, this version reads {FORMAT}: export it again.")
    for name, kind in _KINDS.items():
        _check_entry(path, name, _entry(manifest, name), kind)
    return dict(manifest)


def _entry(manifest: Any, name: str) -> Any:
    """The value under a name with dots; None where there is none."""
    for key in name.split("."):
        manifest = manifest.get(key) if isinstance(manifest, dict) else None
    return manifest


def _check_entry(path: Path, name: str, value: Any, kind: type) -> None:
    fits = isinstance(value, kind) and not isinstance(value, bool)
    if not fits or (isinstance(value, int) and not 0 <= value <= LONGEST):
        expected = {str: "a text", int: "a whole number", dict: "an object", list: "a list"}[kind]
        raise FileError(f"{path}: {name} must be {expected}, got {shown(value)}: export it again.")


def remove_former(folder: Path, kept: Mapping[str, str]) -> None:
    """Delete the files that an earlier export left in a folder, but for those that are about to be written.

    Raises FileError for one that was changed since.
    """
    for name, expected in _listed(folder).items():
        path = folder / name
        inside = path.resolve().is_relative_to(folder.resolve())
        if name in kept or not inside or not path.is_file():
            continue
        if hashlib.sha256(path.read_bytes()).hexdigest() != expected:
            raise FileError(f"{path} is of an earlier export and was changed since: move it away, and export again.")
        path.unlink()
    (folder / NAME).unlink(missing_ok=True)  # until all of the next are there


def _listed(folder: Path) -> dict[str, str]:
    """Hashes by name, of whatever format."""
    try:
        hashes = read_json(folder / NAME)["sha256"]
        return {str(name): str(value) for name, value in hashes.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def check(folder: Path, manifest: Mapping[str, Any], problem: OCP) -> None:
    """Raise ProblemError unless the folder was exported from a problem like this one, which may have other bounds."""
    exported = manifest["problem"]
    found: dict[str, object] = {name.lower(): value for name, value in dimensions(problem).items()}
    found["free_start"] = np.flatnonzero(problem.free_start).tolist()
    for name, value in found.items():
        if exported[name] != value:
            raise ProblemError(f"{folder} was exported with {name} = {exported[name]}; this problem has {value}.")
    same = exported["fingerprint"] == fingerprint(problem)
    if not same or (not takes_schedules(manifest) and exported["schedule"] != schedule_hash(problem)):
        raise ProblemError(
            f"{folder} was exported from another problem (its functions or schedule differ): export this one."
        )


def takes_schedules(manifest: Mapping[str, Any]) -> bool:
    """True if the schedule of a folder may change at run time."""
    return bool(manifest["solver"]["kind"] == "riccati")


def functions_of(problem: OCP) -> list[ca.Function | None]:
    """The functions that are compiled in."""
    return [
        problem.dynamics,
        problem.stage_cost,
        problem.terminal_cost,
        problem.path_constraint,
        problem.path_equality,
        problem.terminal_constraint,
        problem.terminal_equality,
    ]


def fingerprint(problem: OCP) -> str:
    """A hash of the problem's functions and horizon, which are compiled in."""
    parts = ["" if function is None else function.serialize() for function in functions_of(problem)]
    return _hash("\0".join([*parts, str(problem.horizon), ca.__version__]).encode())


def schedule_hash(problem: OCP) -> str:
    """A hash of the schedule's numbers."""
    return _hash(np.ascontiguousarray(problem.schedule, float).tobytes())


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _shown(bound: ArrayLike) -> list[Any]:
    """A bound (rows, n) as JSON, which has no infinity; one row where all from the second on are the same."""
    rows = np.asarray(bound, float)
    same = len(rows) > 1 and (rows[1:] == rows[1]).all()
    shown = [rows[1]] if same else rows
    return [[number(x) for x in row] for row in shown]
