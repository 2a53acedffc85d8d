"""A controller as a folder of C99: generated functions, hand-written control flow, build files, example and test."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.ocp.codegen import portable_c as generated
from kpirl_ocp.ocp.codegen import templates
from kpirl_ocp.ocp.codegen.target import Target
from kpirl_ocp.ocp.codegen.templates import LICENCE, PREFIX
from kpirl_ocp.ocp.export.records import header, number, numbers, record
from kpirl_ocp.ocp.export.targets import target_of
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.scope import constant_bounds, refuse_features
from kpirl_ocp.ocp.problem.solver import Solver
from kpirl_ocp.types import Array

FORMAT = 1  # of the folder and its C interface
_COMMON = [f"{PREFIX}{ending}" for ending in (".h", ".hpp", ".c", "_memory.h")]
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
) -> Path:
    """Write the controller into a directory, and return it.

    psi: (n_psi,) the parameters of a new controller, by default ones. They can be changed at run time.
    examples: pairs of s0 (n_s,) and context (n_c,), by default one of zeros. They are solved in Python, the C test
        compares with them, and the C example starts from the first.

    Raises ProblemError for a solver that cannot be exported, and names those that can; and when psi, an example or the
    prefix is not what it should be.
    """
    templates.check_prefix(prefix)
    refuse_features(problem, "the exported C")
    target = target_of(problem, solver)
    n_s, n_psi, n_c = problem.n_states, problem.n_parameters, problem.n_context
    _, parameters, _ = problem.inputs(np.zeros(n_s), np.ones(n_psi) if psi is None else psi, np.zeros(n_c))
    pairs = [(np.zeros(n_s), np.zeros(n_c))] if examples is None else examples
    files = sources(problem, solver, target, parameters)
    files[f"{PREFIX}_functions.c"] = generated.definitions(target.functions)
    files |= _around(problem, solver, files)
    files["test/records.h"] = header([record(problem, solver, parameters, *pair) for pair in pairs], target.counts)

    files = {templates.renamed(name, prefix): templates.renamed(text, prefix) for name, text in files.items()}
    files["manifest.json"] = _manifest(problem, solver, target, prefix, parameters, files)
    out = Path(directory)
    for name, text in files.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(text)
    return out


def sources(problem: OCP, solver: Solver, target: Target, psi: Array) -> dict[str, str]:
    """Texts of the C files by name, without the generated functions themselves."""
    hand_written = [*_COMMON, *(f"{PREFIX}_{name}" for name in target.sources)]
    return {name: templates.read(name) for name in hand_written} | {
        f"{PREFIX}_config.h": _config(problem, target),
        f"{PREFIX}_data.c": _data(problem, solver, target, psi),
        f"{PREFIX}_functions.h": generated.declarations(target.functions),
    }


def _around(problem: OCP, solver: Solver, code: Iterable[str]) -> dict[str, str]:
    """Build files, example and test; code: names of the C files."""
    words = {
        "SOURCES": " ".join(sorted(name for name in code if name.endswith(".c"))),
        "TITLE": PREFIX,
        "VERSION": version("kpirl-ocp"),
        "SOLVER": str(solver),
        **{key: str(value) for key, value in dimensions(problem).items()},
    }
    files = {name: templates.read(name) for name in _AROUND}
    for word, replacement in words.items():
        files = {name: text.replace(f"@{word}@", replacement) for name, text in files.items()}
    return files


def dimensions(problem: OCP) -> dict[str, int]:
    """By their names in the C configuration."""
    return {
        "HORIZON": problem.horizon,
        "N_STATES": problem.n_states,
        "N_ACTIONS": problem.n_actions,
        "N_PARAMETERS": problem.n_parameters,
        "N_CONTEXT": problem.n_context,
        "N_PATH": problem.n_path,
    }


def _config(problem: OCP, target: Target) -> str:
    upper = PREFIX.upper()
    macros: dict[str, int | str] = {**dimensions(problem), **target.macros} | {"MAX_ITERATIONS": target.max_iterations}
    defined = "\n".join(f"#define {upper}_{name} {value}" for name, value in macros.items())
    return f"""{LICENCE}
/* Fixed when this controller was exported. */
#ifndef {upper}_CONFIG_H
#define {upper}_CONFIG_H

{defined}

#define {upper}_WORKSPACE "{PREFIX}_{target.workspace}" /* where the solver's memory is declared */

#endif
"""


def _data(problem: OCP, solver: Solver, target: Target, psi: Array) -> str:
    """The settings, bounds, psi and version that a new controller has."""
    bounds = ",\n    ".join(numbers(bound) for bound in constant_bounds(problem))
    sizes = ", ".join(f"{name} = {value}" for name, value in dimensions(problem).items())
    described = f"kpirl_ocp {version('kpirl-ocp')}; {solver}; {sizes}".replace('"', "'")
    settings = f"{target.max_iterations}, {target.steps}, {number(target.tolerance)}, {number(target.barrier)}"
    floor = f"{number(max(target.tolerance, target.single_tolerance))}"
    single = f"{target.max_iterations}, {target.steps}, (float){floor}, (float){number(target.barrier)}"
    return f"""{LICENCE}
/* What a new controller starts with. */
#include "{PREFIX}_memory.h"

#include <math.h>

/* max_iterations, steps, tolerance, barrier, no time limit */
#ifdef {PREFIX.upper()}_FLOAT
const {PREFIX}_settings {PREFIX}_exported_settings = {{{single}, 0, NULL, NULL}};
#else
const {PREFIX}_settings {PREFIX}_exported_settings = {{{settings}, 0, NULL, NULL}};
#endif

/* lower and upper bounds of a state, lower and upper bounds of an action */
const {PREFIX}_bounds {PREFIX}_exported_bounds = {{
    {bounds}}};

const {PREFIX}_real {PREFIX}_exported_psi[] = {numbers(psi)};

const char {PREFIX}_exported_version[] = "{described}";
"""


def _manifest(problem: OCP, solver: Solver, target: Target, prefix: str, psi: Array, files: Mapping[str, str]) -> str:
    """The manifest: what identifies the folder to an ExportedSolver, and a description for readers."""
    bounds = constant_bounds(problem)
    content = {
        "format": FORMAT,
        "prefix": prefix,
        "solver": {"kind": target.kind, "described": str(solver)},
        "problem": {
            **{name.lower(): value for name, value in dimensions(problem).items()},
            "fingerprint": fingerprint(problem),
            "bounds": {
                name: [[number(x) for x in bound] for bound in pair]
                for name, pair in (("state", bounds[:2]), ("action", bounds[2:]))
            },
        },
        "psi": psi.tolist(),
        "versions": {name: version(name) for name in ("kpirl-ocp", "casadi", "numpy")},
        "sha256": {name: hashlib.sha256(text.encode()).hexdigest() for name, text in sorted(files.items())},
    }
    return json.dumps(content, indent=2) + "\n"


def fingerprint(problem: OCP) -> str:
    """A hash of everything that is compiled in: functions, horizon and schedule; not of the bounds."""
    functions = [problem.dynamics, problem.stage_cost, problem.terminal_cost, problem.path_constraint]
    parts = ["" if function is None else function.serialize() for function in functions]
    parts += [str(problem.horizon), np.asarray(problem.schedule).tobytes().hex(), ca.__version__]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()
