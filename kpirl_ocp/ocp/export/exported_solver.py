"""An exported controller in Python: the compiled library behind the same call as any solver."""

from __future__ import annotations

import ctypes
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import FileError, ProblemError
from kpirl_ocp.ocp.codegen.c_structures import Structures, address
from kpirl_ocp.ocp.codegen.compiler import EXPORT_FLAGS_NATIVE, compile_folder
from kpirl_ocp.ocp.export.folder import FORMAT, dimensions, fingerprint
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.scope import constant_bounds, refuse_features
from kpirl_ocp.ocp.problem.solver import Guess
from kpirl_ocp.ocp.sensitivity.implicit_function import ByParameters
from kpirl_ocp.types import Array, KKTResiduals, Multipliers, Solution, Status, Trajectory


class ExportedSolver:
    """A solver (`Solver`) whose work is done by an exported folder, for the problem that was exported.

    Bounds are those of the problem that `solve` is called with. Not for use in several threads at once.
    """

    def __init__(
        self, folder: str | Path, flags: Sequence[str] = EXPORT_FLAGS_NATIVE, compiler: str | None = None
    ) -> None:
        """Build, unless the cache has it, and load.

        Raises:
            FileError: the folder is no exported controller, or one of another format.
            CompilerError: it cannot be built.
        """
        self.folder = Path(folder)
        self.manifest = _manifest(self.folder)
        self.structures = Structures.of(self.manifest["problem"], any("_FLOAT" in flag for flag in flags))
        self._prefix = self.manifest["prefix"]
        self._library = ctypes.CDLL(str(compile_folder(self.folder, flags, compiler)))
        self._function("size").restype = ctypes.c_size_t
        for name in ("message", "version"):
            self._function(name).restype = ctypes.c_char_p
        size = self._function("size")()
        self._memory = (ctypes.c_longdouble * (size // ctypes.sizeof(ctypes.c_longdouble) + 1))()
        self._controller = ctypes.c_void_p()
        self._call("init", ctypes.byref(self._controller), self._memory, ctypes.c_size_t(ctypes.sizeof(self._memory)))
        self._known: dict[OCP, bool] = {}

    def solve(
        self, problem: OCP, s0: ArrayLike, psi: ArrayLike = (), context: ArrayLike = (), guess: Guess = None
    ) -> Solution:
        """Solve; see `Solver.solve`. A `Solution` as guess also hands over its multipliers."""
        self._use(problem)
        start, kept = self._input(problem, s0, psi, context)
        found, result = self.structures.solution(), None
        if guess is not None:
            result, more = self._guess(problem, guess)
            kept += more
        self._call(
            "solve",
            self._controller,
            ctypes.byref(start),
            None if result is None else ctypes.byref(result),
            ctypes.byref(found),
        )
        return self._solution(found, *problem.inputs(s0, psi, context)[1:])

    def gradient(
        self,
        problem: OCP,
        s0: ArrayLike,
        psi: ArrayLike,
        context: ArrayLike,
        solution: Solution,
        by_states: ArrayLike,
        by_actions: ArrayLike,
        guess: Guess = None,
    ) -> tuple[ByParameters, bool]:
        """Gradients of a function of the plan with these derivatives, and whether they are to be believed.

        by_states: (T+1, n_s). by_actions: (T, n_u). guess: what `solve` was called with; gradient descent needs it.
        """
        self._use(problem)
        start, kept = self._input(problem, s0, psi, context)
        plan = self._plain(solution)
        slopes = [
            self.structures.array(slope) for slope in (problem.as_states(by_states), problem.as_actions(by_actions))
        ]
        first = None
        if guess is not None:
            first, more = self._guess(problem, guess)
            kept += more
        found = self.structures.gradients()
        status = self._call(
            "gradient",
            self._controller,
            ctypes.byref(start),
            None if first is None else ctypes.byref(first),
            ctypes.byref(plan),
            *(ctypes.c_void_p(address(slope)) for slope in slopes),
            ctypes.byref(found),
        )
        by_psi, by_start, by_context = (
            np.array(getattr(found, name), float)[:length]
            for name, length in zip(
                ("psi", "state", "context"), (problem.n_parameters, problem.n_states, problem.n_context), strict=True
            )
        )
        return ByParameters(by_psi, by_start, by_context), status == 0

    def shift(self, problem: OCP, solution: Solution, psi: ArrayLike = ()) -> Solution:
        """The guess for the next period: all one step earlier, the last action again, the last multipliers kept."""
        plan, parameters = self._plain(solution), self.structures.array(psi).ravel()
        self._call("shift", self._controller, ctypes.c_void_p(address(parameters)), ctypes.byref(plan))
        arrays = self._arrays(plan)
        return replace(
            solution, trajectory=Trajectory(*arrays[:2]), multipliers=Multipliers.of_given_start(*arrays[2:])
        )

    def set(self, **settings: Any) -> None:
        """Change settings of `kpirl_mpc_settings`, such as tolerance, barrier or steps."""
        current = self.structures.settings()
        self._call("get_settings", self._controller, ctypes.byref(current))
        for name, value in settings.items():
            setattr(current, name, value)
        self._call("set_settings", self._controller, ctypes.byref(current))

    @property
    def version(self) -> str:
        """Of the exported library."""
        return str(self._function("version")().decode())

    @property
    def size(self) -> int:
        """Bytes of memory of a controller."""
        return int(self._function("size")())

    def _function(self, name: str) -> Any:
        return getattr(self._library, f"{self._prefix}_{name}")

    def _call(self, name: str, *arguments: Any) -> int:
        """Its status. Raises ProblemError for an error of the caller."""
        status = int(self._function(name)(*arguments))
        if status < 0:
            raise ProblemError(f"{self.folder}: {self._function('message')(status).decode()}")
        return status

    def _use(self, problem: OCP) -> None:
        """Check that the problem is the exported one, and take over its bounds."""
        if problem not in self._known:
            refuse_features(problem, "the exported C")
            _check(self.folder, self.manifest, problem)
            self._known[problem] = True
        bounds = [self.structures.array(bound) for bound in constant_bounds(problem)]
        self._call("set_bounds", self._controller, *(ctypes.c_void_p(address(bound)) for bound in bounds))

    def _input(self, problem: OCP, s0: ArrayLike, psi: ArrayLike, context: ArrayLike) -> tuple[Any, list[Array]]:
        """The structure, and the arrays that it points to."""
        start, parameters, goal = problem.inputs(s0, psi, context)
        arrays = [self.structures.array(value) for value in (start, goal, parameters)]
        return self.structures.input(*map(address, arrays)), arrays

    def _guess(self, problem: OCP, guess: Solution | Trajectory) -> tuple[Any, list[Array]]:
        parts = [problem.as_states(guess.states), problem.as_actions(guess.actions)]
        if isinstance(guess, Solution):
            multipliers = guess.multipliers
            parts += [multipliers.dynamics, multipliers.state[1:], multipliers.action, multipliers.path]
        arrays = [self.structures.array(part) for part in parts]
        return self.structures.guess(*map(address, arrays)), arrays

    def _plain(self, solution: Solution) -> Any:
        multipliers = solution.multipliers
        parts = (
            solution.states,
            solution.actions,
            multipliers.dynamics,
            multipliers.state[1:],
            multipliers.action,
            multipliers.path,
        )
        plan = self.structures.solution()
        for name, part in zip(self.structures.shapes, parts, strict=True):
            if part.size:
                np.ctypeslib.as_array(getattr(plan, name))[:] = part.ravel()
        return plan

    def _arrays(self, plan: Any) -> list[Array]:
        """Trajectory and multipliers, in the order of the structure."""
        return [
            np.array(getattr(plan, name), float)[: shape[0] * shape[1]].reshape(shape)
            for name, shape in self.structures.shapes.items()
        ]

    def _solution(self, found: Any, psi: Array, context: Array) -> Solution:
        arrays = self._arrays(found)
        residuals = KKTResiduals(
            stationarity=found.stationarity,
            feasibility=found.feasibility,
            complementarity=found.complementarity,
            sign=0.0,
            scale=found.scale,
        )
        current = self.structures.settings()
        self._call("get_settings", self._controller, ctypes.byref(current))
        return Solution(
            trajectory=Trajectory(*arrays[:2]),
            multipliers=Multipliers.of_given_start(*arrays[2:]),
            objective=found.objective,
            residuals=residuals,
            status=status_of(found.status),
            iterations=found.iterations,
            psi=psi,
            context=context,
            barrier=current.barrier,
            message=f"{self._prefix}: {self._function('message')(found.status).decode()}",
        )


def status_of(code: int) -> Status:
    """The C enum begins with Python's members, in their order; beyond them a solve has the time limit."""
    known = list(Status)
    return known[code] if code < len(known) else Status.ITERATION_LIMIT


def _manifest(folder: Path) -> dict[str, Any]:
    path = folder / "manifest.json"
    try:
        manifest = json.loads(path.read_text())
    except FileNotFoundError:
        raise FileError(f"{path} does not exist: export a controller with export_c or scripts/export_mpc.py.") from None
    if manifest.get("format") != FORMAT:
        raise FileError(f"{path} has format {manifest.get('format')!r}, this version reads {FORMAT}: export it again.")
    return dict(manifest)


def _check(folder: Path, manifest: dict[str, Any], problem: OCP) -> None:
    exported = manifest["problem"]
    found = {name.lower(): value for name, value in dimensions(problem).items()}
    for name, value in found.items():
        if exported[name] != value:
            raise ProblemError(f"{folder} was exported with {name} = {exported[name]}; this problem has {value}.")
    if exported["fingerprint"] != fingerprint(problem):
        raise ProblemError(
            f"{folder} was exported from another problem (its functions or schedule differ): export this one."
        )
