"""The interior-point method as machine code in this process: the C of an export, compiled into the cache and loaded.

It takes the same steps as `riccati` in Python, and they differ by rounding alone. What is left for Python
is to hand over arrays.
"""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
import threading
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.ocp.codegen import compiler as native
from kpirl_ocp.ocp.codegen import portable_c as generated
from kpirl_ocp.ocp.codegen import templates
from kpirl_ocp.ocp.codegen.c_structures import GUESS, Structures, address
from kpirl_ocp.ocp.codegen.kernels import SOURCES
from kpirl_ocp.ocp.codegen.numpy_calls import worth_compiling
from kpirl_ocp.ocp.export.exported_solver import status_of
from kpirl_ocp.ocp.export.folder import dimensions, sources
from kpirl_ocp.ocp.export.riccati import target
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.scope import constant_bounds
from kpirl_ocp.ocp.problem.solver import Guess
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.types import Array, KKTResiduals, Multipliers, Solution, Trajectory

_MOST_ITERATIONS = 1000  # that the memory of a filter is made for, unless a solver wants more
_LARGEST = 50_000  # numbers in a trajectory; the C code keeps some of them on the stack


class Resident:
    """The compiled solver of one problem. Every thread has a controller, with memory, of its own."""

    def __init__(self, problem: OCP, library: Path) -> None:
        self.problem = problem
        self._structures = Structures.of({name.lower(): size for name, size in dimensions(problem).items()})
        self._library = ctypes.CDLL(str(library))
        self._library.kpirl_mpc_size.restype = ctypes.c_size_t
        self._thread = threading.local()
        self._bounds = [self._structures.array(bound) for bound in constant_bounds(problem)]

    def solve(self, solver: Riccati, s0: Array, psi: Array, context: Array, guess: Guess) -> Solution | None:
        """See `Solver.solve`; None if the C code refuses an argument, such as a guess with NaN in it."""
        make = self._structures
        if not hasattr(self._thread, "controller"):
            self._begin()
        controller, found, views = self._thread.controller, self._thread.solution, self._thread.views
        settings = make.settings(
            solver.max_iterations, solver.steps or 0, solver.tolerance, solver.barrier, 0, None, None
        )
        if self._library.kpirl_mpc_set_settings(controller, ctypes.byref(settings)) != 0:
            return None
        numbers = [make.array(value) for value in (s0, context, psi)]
        given, start = make.input(*map(address, numbers)), None
        if guess is not None:
            arrays = [make.array(part) for part in _parts(self.problem, guess)]
            start = ctypes.byref(make.guess(*map(address, arrays)))
        status = self._library.kpirl_mpc_solve(controller, ctypes.byref(given), start, ctypes.byref(found))
        if status < 0:
            return None
        arrays = [views[name].copy() for name in GUESS]
        return Solution(
            trajectory=Trajectory(*arrays[:2]),
            multipliers=Multipliers.of_given_start(*arrays[2:]),
            objective=found.objective,
            residuals=KKTResiduals(found.stationarity, found.feasibility, found.complementarity, 0.0, found.scale),
            status=status_of(status),
            iterations=found.iterations,
            psi=psi,
            context=context,
            barrier=solver.barrier,
        )

    def derivatives(self) -> list[Array] | None:
        """The `StageDerivatives` where the last solve of this thread ended; None if it did without them there."""
        here = self._thread
        if not self._library.kpirl_mpc_known(here.controller, *here.pointers):
            return None
        return [part.copy() for part in here.second]

    def _begin(self) -> None:
        """Memory for a thread."""
        here, library = self._thread, self._library
        size = library.kpirl_mpc_size()
        here.memory, here.controller = np.empty(size // 16 + 1, np.longdouble), ctypes.c_void_p()
        library.kpirl_mpc_init(
            ctypes.byref(here.controller), ctypes.c_void_p(here.memory.ctypes.data), ctypes.c_size_t(here.memory.nbytes)
        )
        library.kpirl_mpc_set_bounds(here.controller, *(ctypes.c_void_p(address(bound)) for bound in self._bounds))
        here.pointers = (ctypes.c_void_p * 4)(), (ctypes.c_void_p * 8)()
        library.kpirl_mpc_known(here.controller, *here.pointers)
        n_s, n_h, steps = self.problem.n_states, self.problem.n_path, self.problem.horizon
        n_x = n_s + self.problem.n_actions
        at = (steps + 1) * n_s, steps * self.problem.n_actions, steps * n_s, steps * n_h
        vectors, matrices = (n_s * steps, n_h * steps, n_x * steps, n_s), (n_s * n_x, n_h * n_x, n_x * n_x)
        sizes = *vectors, *(size * steps for size in matrices), n_s * n_s
        here.at, here.second = ([*map(_memory, *pair)] for pair in zip(here.pointers, (at, sizes), strict=True))
        here.solution = self._structures.solution()
        here.views = {
            name: np.ctypeslib.as_array(getattr(here.solution, name))[: rows * columns].reshape(rows, columns)
            for name, (rows, columns) in self._structures.shapes.items()
        }


def _memory(address: int, size: int) -> Array:
    """Numbers of the C code as an array."""
    return np.ctypeslib.as_array((ctypes.c_double * max(size, 1)).from_address(address))[:size]


def resident(problem: OCP, max_iterations: int) -> Resident | None:
    """The compiled solver; None without a compiler, and for problems too small to be worth it, or too large."""
    return _resident(problem, max(max_iterations, _MOST_ITERATIONS))


@lru_cache(maxsize=64)
def _resident(problem: OCP, max_iterations: int) -> Resident | None:
    length = problem.horizon * (problem.n_states + problem.n_actions + problem.n_path)
    command = native.compiler() if worth_compiling(problem) and length <= _LARGEST else None
    if command is None:
        return None
    try:
        return Resident(problem, _library(command, problem, Riccati(max_iterations=max_iterations)))
    except (OSError, subprocess.CalledProcessError) as error:
        native.warn_slow(f"{command} could not compile the solver: {error}")
        return None


def _library(command: str, problem: OCP, solver: Riccati) -> Path:
    """From the cache by what it is made of, so that C code is only generated to be compiled."""
    exported = target(problem, solver)
    texts = sources(_alike(problem), solver, exported, np.ones(problem.n_parameters))
    functions = [function.serialize() for function in exported.functions]
    key = [*texts.values(), *functions, SOURCES, ca.__version__, command, native.identity(command), *native.FLAGS]

    def build(library: Path) -> None:
        files = texts | {f"{templates.PREFIX}_functions.c": generated.definitions(exported.functions, fast=True)}
        with tempfile.TemporaryDirectory() as scratch:
            for name, text in files.items():
                (Path(scratch) / name).write_text(text)
            native.link(command, native.FLAGS, sorted(Path(scratch).glob("*.c")), library)

    return native.cached("riccati", "\0".join(key), build)


def _alike(problem: OCP) -> OCP:
    """The problem with other bounds of the same kind, so that problems that differ in them share a library."""

    def kinds(pair: tuple[ArrayLike, ArrayLike]) -> tuple[Array, Array]:
        lower, upper = (np.asarray(bound, float) for bound in pair)
        fixed = lower == upper
        low, high = (np.where(np.isfinite(bound), 1.0, np.inf) * sign for bound, sign in ((lower, -1), (upper, 1)))
        return np.where(fixed, 0.0, low), np.where(fixed, 0.0, high)

    return replace(problem, state_bounds=kinds(problem.state_bounds), action_bounds=kinds(problem.action_bounds))


def _parts(problem: OCP, guess: Solution | Trajectory) -> list[Array]:
    parts = [problem.as_states(guess.states), problem.as_actions(guess.actions)]
    if isinstance(guess, Solution):
        multipliers = guess.multipliers
        parts += [multipliers.dynamics, multipliers.state[1:], multipliers.action, multipliers.path]
    return parts
