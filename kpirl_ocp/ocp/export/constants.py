"""The constants of an exported folder: dimensions, and the settings and parameters of a new controller."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.metadata import version

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.ocp.codegen.portable_c import work_sizes
from kpirl_ocp.ocp.codegen.target import Target
from kpirl_ocp.ocp.codegen.templates import LICENCE, PREFIX
from kpirl_ocp.ocp.interior_point.core import point_bounds
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Solver
from kpirl_ocp.types import Array

_UPPER = PREFIX.upper()


def dimensions(problem: OCP) -> dict[str, int]:
    """Dimensions of a problem, by their names in the C configuration."""
    return {
        "HORIZON": problem.horizon,
        "N_STATES": problem.n_states,
        "N_ACTIONS": problem.n_actions,
        "N_PARAMETERS": problem.n_parameters,
        "N_CONTEXT": problem.n_context,
        "N_SCHEDULE": np.asarray(problem.schedule).shape[1],
        "N_PATH": problem.n_path,
        "N_PATH_EQUALITY": problem.n_path_equality,
        "N_TERMINAL": problem.n_terminal,
        "N_TERMINAL_EQUALITY": problem.n_terminal_equality,
        "N_FREE": int(problem.free_start.sum()),
    }


def configuration(problem: OCP, target: Target) -> str:
    """The header `.._config.h`."""
    macros: dict[str, int | str] = {
        **dimensions(problem),
        "MAX_ITERATIONS": target.max_iterations,
        **work_sizes(target.functions),
        **target.macros,
    }
    defined = "\n".join(f"#define {_UPPER}_{name} {value}" for name, value in macros.items())
    return f"""{LICENCE}
/* Fixed when this controller was exported. N_FREE: entries of s_0 that are not given. WORK: of generated functions. */
#ifndef {_UPPER}_CONFIG_H
#define {_UPPER}_CONFIG_H

{defined}

#define {_UPPER}_WORKSPACE "{PREFIX}_{target.workspace}" /* where the solver's memory is declared */
#define {_UPPER}_TRANSITION {PREFIX}_{target.transition} /* the generated function with the dynamics */

#endif
"""


def data(problem: OCP, solver: Solver, target: Target, psi: Array) -> str:
    """The file `.._data.c`."""
    sizes = ", ".join(f"{name} = {value}" for name, value in dimensions(problem).items())
    described = f"kpirl_ocp {version('kpirl-ocp')}; {solver}; {sizes}".replace('"', "'")
    lower, upper, free = point_bounds(problem)
    real, schedule = f"const {PREFIX}_real {PREFIX}_exported", np.asarray(problem.schedule, float).ravel()
    return f"""{LICENCE}
/* What a new controller starts with. */
#include "{PREFIX}_{"interface" if target.with_core else "controller"}.h"

#ifdef {_UPPER}_FLOAT
#define TOLERANCE (float){number(max(target.tolerance, target.single_tolerance))}
#else
#define TOLERANCE {number(target.tolerance)}
#endif

const {PREFIX}_settings {PREFIX}_exported_settings = {{
    .max_iterations = {target.max_iterations},
    .steps = {target.steps},
    .tolerance = TOLERANCE,
    .barrier = {number(target.barrier)}}};

/* of x = (s_0, u_0, s_1, .., u_{{T-1}}, s_T) */
{real}_lower[] = {_wrapped(lower)};
{real}_upper[] = {_wrapped(upper)};
const int {PREFIX}_exported_free[] = {{{", ".join(map(str, free)) or "0"}}};

{real}_psi[] = {_wrapped(psi)};

{real}_schedule[] = {_wrapped(schedule)};

const char {PREFIX}_exported_version[] = "{described}";
{target.data}"""


def numbers(values: Iterable[float]) -> str:
    """A C initialiser; one zero for an empty array, because C has none."""
    return "{" + (", ".join(number(value) for value in values) or "0") + "}"


def number(value: float) -> str:
    """A C expression of a number that is not NaN."""
    if np.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return repr(float(value))


def _wrapped(values: ArrayLike, row: int = 12) -> str:
    """`numbers`, a few on every line."""
    array = np.asarray(values, float)
    lines = [", ".join(number(value) for value in array[i : i + row]) for i in range(0, len(array), row)]
    return "{" + (",\n    ".join(lines) or "0") + "}"
