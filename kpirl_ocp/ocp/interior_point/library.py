"""The core's shared library, and its structures in ctypes (`c/kpirl_mpc_core.h`, `c/library/kpirl_mpc_library.h`)."""

from __future__ import annotations

import ctypes
import platform
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.errors import CompilerError
from kpirl_ocp.types import Array

POINTER, INT, REAL = ctypes.c_void_p, ctypes.c_int, ctypes.c_double
_NOTHING = np.zeros(1)  # in place of empty arrays: NULL stands for what is not given
_address, _begin = ctypes.addressof, ctypes.c_char.from_buffer


def _structure(name: str, **fields: object) -> type[ctypes.Structure]:
    return type(name, (ctypes.Structure,), {"_fields_": list(fields.items())})


_DIMENSIONS = (
    "horizon",
    "n_states",
    "n_actions",
    "n_path",
    "n_equality",
    "n_terminal",
    "n_terminal_equality",
    "n_parameters",
    "n_context",
    "n_schedule",
)
Dimensions = _structure("Dimensions", **dict.fromkeys(_DIMENSIONS, INT))
Function = _structure("Function", evaluate=POINTER, self=POINTER)
Pattern = _structure("Pattern", count=INT, entries=POINTER)
# Names of the pointers that functions are called with: arguments, then results.
STAGE = (
    ("x", "psi", "context", "schedule", "costates", "z", "nu"),
    ("cost", "successor", "path", "equality", "cost_gradient", "gradient", "F", "G", "E", "H"),
)
HORIZON = (
    ("states", "actions", "psi", "context", "costates", "z", "nu", "z_last", "nu_last"),
    (
        *("cost", "successor", "path", "equality", "path_last", "equality_last"),
        *("cost_gradient", "cost_gradient_last", "gradient", "gradient_last"),
        *("F", "G", "E", "H", "G_last", "E_last", "H_last"),
    ),
)
Model = _structure(
    "Model",
    by_stage=INT,
    quadratic=INT,
    stage=Function * 3,
    last=Function * 3,
    horizon=Function * 3,
    dynamics=Function,
    **dict.fromkeys(("F", "G", "E", "H", "G_last", "E_last", "H_last"), Pattern),
)
Bounds = _structure("Bounds", lower=POINTER, upper=POINTER, free_entries=POINTER, n_free=INT)
Numbers = _structure("Numbers", s0=POINTER, psi=POINTER, context=POINTER, schedule=POINTER)
Options = _structure(
    "Options",
    max_iterations=INT,
    steps=INT,
    tolerance=REAL,
    barrier=REAL,
    time_limit=REAL,
    now=POINTER,
    clock=POINTER,
    log=POINTER,
    log_to=POINTER,
)
Count = _structure("Count", **dict.fromkeys(("head", "reals", "integers", "arrays"), ctypes.c_size_t))
Start = _structure("Start", x=POINTER, costates=POINTER, bounds=POINTER, path=POINTER, equality=POINTER)
Residuals = _structure("Residuals", stationarity=REAL, feasibility=REAL, complementarity=REAL, scale=REAL)
Result = _structure("Result", residuals=Residuals, objective=REAL, iterations=INT, status=INT)
Iteration = _structure(
    "Iteration",
    iteration=INT,
    trials=INT,
    restoring=INT,
    objective=REAL,
    infeasibility=REAL,
    dual_infeasibility=REAL,
    complementarity=REAL,
    tau=REAL,
    step=REAL,
    regularisation=REAL,
    primal_length=REAL,
    dual_length=REAL,
)
Buffered = _structure(
    "Buffered",
    evaluate=POINTER,
    status=POINTER,
    buffer=POINTER,
    n_in=INT,
    n_out=INT,
    places_in=POINTER,
    places_out=POINTER,
    size_in=POINTER,
    size_out=POINTER,
    arguments=POINTER,
    results=POINTER,
)
CompiledFunction = _structure(
    "CompiledFunction",
    evaluate=POINTER,
    n_in=INT,
    n_out=INT,
    places_in=POINTER,
    places_out=POINTER,
    arguments=POINTER,
    results=POINTER,
    integers=POINTER,
    reals=POINTER,
)
Tape = _structure("Tape", operations=POINTER, constants=POINTER, n_operations=INT)
Tapes = _structure(
    "Tapes", stage=Tape, last=Tape, dimensions=Dimensions, schedule=POINTER, slots=POINTER, costs=POINTER
)
Members = _structure("Members", **dict.fromkeys(("kind", "constant", "output", "input", "release"), POINTER))
Factors = _structure("Factors", **dict.fromkeys(("P", "W", "Y", "pivots", "free_W", "free_pivots"), POINTER))
System = _structure(
    "System",
    **dict.fromkeys(("horizon", "n_states", "n_actions"), INT),
    **dict.fromkeys(("n_path", "n_equality", "n_terminal", "n_terminal_equality"), INT),
    **dict.fromkeys(("n_free", "n_bounds", "n_decisions"), INT),
    **dict.fromkeys(("free", "entries", "decisions", "signs", "F", "G", "E", "H"), POINTER),
    **dict.fromkeys(("sigma", "active", "sizes", "roots", "lengths", "moved", "stiffness"), POINTER),
    factors=Factors,
    scratch=POINTER,
    scale=REAL,
)
Triple = _structure("Triple", x=POINTER, costates=POINTER, forces=POINTER, start=POINTER)
Rows = _structure(
    "Rows",
    **dict.fromkeys(("n_free", "n_bounds", "n_decisions", "quadratic"), INT),
    **dict.fromkeys(("free", "entries", "decisions", "inequality", "equality", "other"), POINTER),
    **dict.fromkeys(("signs", "limits", "largest_bound", "normal", "uniform", "spread"), POINTER),
)
KKT = _structure(
    "KKT",
    system=System,
    rows=POINTER,
    dimensions=Dimensions,
    numbers=Numbers,
    point=Triple,
    adjoint=Triple,
    move=Triple,
    barrier=REAL,
    objective=REAL,
    **dict.fromkeys(("gradient", "defects", "slack", "pushing", "curvature", "row_sizes", "lowest_mode"), POINTER),
    row_factors=Factors,
    **dict.fromkeys(("origin", "slope", "shares", "tangent", "derivatives", "work"), POINTER),
    **dict.fromkeys(("lowest", "qualification", "step", "margin", "distance"), REAL),
    **dict.fromkeys(("evaluated", "factored", "immovable", "conditioned", "stepped", "reached"), INT),
    **dict.fromkeys(("borrowed", "stale"), INT),
)
Evidence = _structure(
    "Evidence",
    **dict.fromkeys(
        ("curvature", "qualification", "distance", "step", "margin", "change", "kink", "linear_residual"), REAL
    ),
)
ByParameters = _structure("ByParameters", psi=POINTER, s0=POINTER, context=POINTER)
Questions = _structure("Questions", solutions=POINTER, slopes=POINTER, barriers=POINTER)
Answers = _structure("Answers", answers=POINTER, active=POINTER, finite=POINTER)
_OF_SYSTEMS = {
    "rows_transposed_times": 3,
    "kkt_init": 4,
    "kkt_linearise": 4,
    "kkt_renew": 2,
    "kkt_condition": 1,
    "kkt_solve": 3,
    "weigh": 7,
    "certify": 7,
    "point_sizes": 4,
    "kink_in_parameters": 5,
    "kink_of_loss": 9,
}  # functions of `c/kpirl_mpc_system.h` and `c/kpirl_mpc_kkt.h` that Python calls, and how many pointers they take
LOG = ctypes.CFUNCTYPE(None, POINTER, ctypes.POINTER(Iteration))


@lru_cache(maxsize=1)
def library() -> ctypes.CDLL:
    """The build of the core for this processor.

    Raises CompilerError when the package was installed without it, or was changed since.
    """
    folder = Path(__file__).parent
    for level in _levels():
        path = folder / f"_core{level}.so"
        if path.exists():
            core = ctypes.CDLL(str(path))
            if not hasattr(core, "kpirl_mpc_layout") or core.kpirl_mpc_layout() != _layout():
                raise CompilerError(f"{path} was built from other sources than these: install the package again.")
            return _declared(core)
    raise CompilerError(
        f"{folder} holds no compiled core (_core.so): install the package again on a machine with a C compiler, "
        "or from a wheel."
    )


def symbol(name: str) -> int:
    """The address of a function of the library."""
    return address_in(library(), name)


def address_in(loaded: ctypes.CDLL, name: str) -> int:
    """The address of a function of any library."""
    address = ctypes.cast(getattr(loaded, name), ctypes.c_void_p).value
    assert address is not None
    return address


def view(address: int, size: int) -> Array:
    """Numbers of the C code, to be used no longer than their memory."""
    if not size:
        return np.zeros(0)
    return np.frombuffer((ctypes.c_double * size).from_address(address))  # type: ignore[call-overload]


def read(address: int, size: int) -> Array:
    """A copy of numbers of the C code."""
    return view(address, size).copy()


def all_finite(array: Array) -> bool:
    """True without NaN and infinity; a third of the time that numpy takes."""
    numbers = np.ascontiguousarray(array, float)
    return bool(library().kpirl_mpc_all_finite(address_of(numbers), numbers.size))


def address_of(array: NDArray[Any]) -> int:
    """Of the first number; faster than `array.ctypes.data`, but for structured arrays. Empty ones share one."""
    try:
        return _address(_begin(array if array.size else _NOTHING))  # type: ignore[arg-type]
    except (TypeError, ValueError, BufferError):  # read only, or not contiguous
        return int(array.ctypes.data)


def _layout() -> int:
    """The sizes of all structures that cross over."""
    crossing = (Dimensions, Model, Bounds, Numbers, Options, Start, Residuals, Iteration)
    functions, systems = (Buffered, CompiledFunction, Tapes, Members), (System, Triple, Rows, KKT)
    kinds = (*crossing, *functions, *systems, Evidence, ByParameters, Result, Questions, Answers)
    return sum((i + 1) * ctypes.sizeof(kind) for i, kind in enumerate(kinds))


def _levels() -> list[str]:
    """The builds that this processor runs, fastest first (x86-64 levels of the psABI)."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return [""]
    cpu, levels = _cpu_flags(), [""]
    if {"avx2", "fma", "bmi2"} <= cpu:
        levels.insert(0, "_v3")
        if {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"} <= cpu:
            levels.insert(0, "_v4")
    return levels


def _cpu_flags() -> set[str]:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return set()
    lines = [line for line in text.splitlines() if line.startswith("flags")]
    return set(lines[0].split()) if lines else set()


def _declared(core: ctypes.CDLL) -> ctypes.CDLL:
    core.kpirl_mpc_count_core.argtypes = [POINTER] * 4
    core.kpirl_mpc_core_size.restype = core.kpirl_mpc_kkt_init.restype = ctypes.c_size_t
    core.kpirl_mpc_core_init.restype = POINTER
    for name in ("n_point", "n_inequalities", "n_equalities"):
        getattr(core, f"kpirl_mpc_{name}").argtypes = [POINTER]
    core.kpirl_mpc_solve_each.argtypes = [POINTER, INT, *[POINTER] * 5]
    core.kpirl_mpc_solve_each.restype = None
    for name in ("core_set_model", "core_gradient", "put_derivatives"):
        getattr(core, f"kpirl_mpc_{name}").argtypes = [POINTER] * 2
    for name, count in _OF_SYSTEMS.items():
        getattr(core, f"kpirl_mpc_{name}").argtypes = [POINTER] * count
    core.kpirl_mpc_read_operations.argtypes = [POINTER, POINTER, INT, INT, POINTER, POINTER]
    core.kpirl_mpc_all_finite.argtypes = [POINTER, INT]
    core.kpirl_mpc_certify_each.argtypes = [*[POINTER] * 4, INT, *[POINTER] * 2]
    core.kpirl_mpc_certify_each.restype = None
    for name in ("kkt_solve", "kink_in_parameters", "kink_of_loss"):
        getattr(core, f"kpirl_mpc_{name}").restype = REAL
    return core
