"""An exported controller in Python: the compiled library behind the same call as any solver."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import CompilerError, FileError, ProblemError
from kpirl_ocp.ocp.codegen.c_structures import SETTINGS, Structures, address
from kpirl_ocp.ocp.codegen.compiler import EXPORT_FLAGS_NATIVE, compile_folder
from kpirl_ocp.ocp.export.manifest import check, read, takes_schedules
from kpirl_ocp.ocp.export.records import STATUS
from kpirl_ocp.ocp.problem.layout import check_multipliers
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Guess, check_guess
from kpirl_ocp.ocp.sensitivity.implicit_function import ByParameters
from kpirl_ocp.types import Array, KKTResiduals, Multipliers, Solution, Status, Trajectory

_INPUT = -2  # KPIRL_MPC_ERROR_INPUT
# Where the parts of `Multipliers` stand in the C structures.
_MULTIPLIERS = {
    "dynamics": "dynamics",
    "state": "state_bounds",
    "action": "action_bounds",
    "path": "path",
    "path_equality": "path_equality",
    "terminal": "terminal",
    "terminal_equality": "terminal_equality",
}


class ExportedSolver:
    """A solver (`Solver`) whose work is done by an exported folder, for the problem that was exported.

    Bounds, and for an interior-point method the schedule, are those of the problem that `solve` is called with. Use one
    object per thread.
    """

    def __init__(
        self, folder: str | Path, flags: Sequence[str] = EXPORT_FLAGS_NATIVE, compiler: str | None = None
    ) -> None:
        """Load the compiled folder; it is built unless the cache has it.

        Raises:
            FileError: the folder is no exported controller, or one of another format.
            CompilerError: it cannot be built.
        """
        self.folder, self._build = Path(folder), (tuple(flags), compiler)
        self.manifest = read(self.folder)
        self.structures = Structures.of(self.manifest["problem"], any("_FLOAT" in flag for flag in flags))
        self._prefix = self.manifest["prefix"]
        path = compile_folder(self.folder, flags, compiler, self.manifest["sha256"])
        try:
            self._library = ctypes.CDLL(str(path))
        except OSError as error:
            raise CompilerError(f"the compiler made a library that cannot be loaded: {error}.") from error
        self._function("size").restype = ctypes.c_size_t
        for name in ("message", "version"):
            self._function(name).restype = ctypes.c_char_p
        size = self._function("size")()
        self._memory = (ctypes.c_longdouble * (size // ctypes.sizeof(ctypes.c_longdouble) + 1))()
        self._controller = ctypes.c_void_p()
        init = "init_single" if self.structures.real is np.float32 else "init"
        self._call(init, ctypes.byref(self._controller), self._memory, ctypes.c_size_t(ctypes.sizeof(self._memory)))
        self._known: dict[OCP, bool] = {}

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.folder)!r})"

    def solve(
        self, problem: OCP, s0: ArrayLike, psi: ArrayLike = (), context: ArrayLike = (), guess: Guess = None
    ) -> Solution:
        """Solve; see `Solver.solve`. A `Solution` as guess also hands over its multipliers."""
        self._use(problem)
        numbers = problem.inputs(s0, psi, context)
        given, kept = self._input(problem, *numbers)
        first, more = self._guess(problem, guess)
        found = self.structures.solution()
        status = self._status("solve", self._controller, ctypes.byref(given), first, ctypes.byref(found))
        del kept, more
        if status == _INPUT:
            return self._not_finite(numbers)
        return self._solution(self._checked(status), found, *numbers[1:])

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
        """Gradients of a function of the plan with these derivatives, and whether they can be trusted.

        by_states: (T+1, n_s). by_actions: (T, n_u). guess: that of the call of `solve`; gradient descent needs it.
        """
        self._use(problem)
        given, kept = self._input(problem, *problem.inputs(s0, psi, context))
        plan = self._plain(problem, solution)
        slopes = [
            self.structures.array(slope) for slope in (problem.as_states(by_states), problem.as_actions(by_actions))
        ]
        first, more = self._guess(problem, guess)
        found = self.structures.gradients()
        addresses = (ctypes.c_void_p(address(slope)) for slope in slopes)
        arguments = (ctypes.byref(given), first, ctypes.byref(plan), *addresses, ctypes.byref(found))
        status = self._call("gradient", self._controller, *arguments)
        del kept, more
        lengths = {"psi": problem.n_parameters, "state": problem.n_states, "context": problem.n_context}
        parts = [np.array(getattr(found, name), float)[:length] for name, length in lengths.items()]
        return ByParameters(*parts), status == 0

    def shift(
        self, problem: OCP, solution: Solution, psi: ArrayLike | None = None, context: ArrayLike | None = None
    ) -> Solution:
        """The guess for the next period: all one step earlier, the last action again, the last multipliers kept.

        psi, context: those of the solution, unless others are given.
        """
        self._use(problem)
        psi, context = (solution.psi if psi is None else psi), (solution.context if context is None else context)
        plan = self._plain(problem, solution)
        given, kept = self._input(problem, *problem.inputs(solution.states[0], psi, context))
        self._call("shift", self._controller, ctypes.byref(given), ctypes.byref(plan))
        del kept
        arrays = self._arrays(plan)
        return replace(solution, trajectory=_trajectory(arrays), multipliers=_multipliers(arrays))

    def set(self, **settings: Any) -> None:
        """Change settings of `kpirl_mpc_settings`, such as tolerance, barrier or steps.

        Raises ProblemError for an unknown name, and for a value that the solver does not accept.
        """
        unknown = sorted(set(settings) - set(SETTINGS))
        if unknown:
            raise ProblemError(f"{', '.join(unknown)}: no such setting; there are {', '.join(SETTINGS)}.")
        current = self._settings()
        for name, value in settings.items():
            try:
                setattr(current, name, value)
            except (TypeError, ctypes.ArgumentError) as error:
                raise ProblemError(f"{name} cannot be {value!r}: {error}.") from error
        self._call("set_settings", self._controller, ctypes.byref(current))

    def __reduce__(self) -> tuple[Any, ...]:
        """The folder and the settings. Raises ProblemError with a time limit, whose clock belongs to this process."""
        current = self._settings()
        if current.time_limit > 0:
            raise ProblemError("the clock of a time limit stays in its process: set time_limit=0 before pickling.")
        kept = {name: getattr(current, name) for name in SETTINGS if name not in ("time_limit", "now", "clock")}
        return ExportedSolver, (self.folder, *self._build), kept

    def __setstate__(self, settings: Mapping[str, Any]) -> None:
        self.set(**settings)

    @property
    def version(self) -> str:
        """Version of the exported library."""
        return str(self._function("version")().decode())

    @property
    def size(self) -> int:
        """Bytes of memory of a controller."""
        return int(self._function("size")())

    def _settings(self) -> Any:
        current = self.structures.settings()
        self._call("get_settings", self._controller, ctypes.byref(current))
        return current

    def _function(self, name: str) -> Any:
        try:
            return getattr(self._library, f"{self._prefix}_{name}")
        except AttributeError:
            raise FileError(f"{self.folder} has no {self._prefix}_{name} in its sources: export it again.") from None

    def _status(self, name: str, *arguments: Any) -> int:
        return int(self._function(name)(*arguments))

    def _call(self, name: str, *arguments: Any) -> int:
        """Its status. Raises ProblemError for an error of the caller."""
        return self._checked(self._status(name, *arguments))

    def _checked(self, status: int) -> int:
        if status < 0:
            raise ProblemError(f"{self.folder}: {self._message(status)}")
        return status

    def _message(self, status: int) -> str:
        return str(self._function("message")(status).decode())

    def _use(self, problem: OCP) -> None:
        """Check that the problem is the exported one, and take over its bounds."""
        if problem not in self._known:
            check(self.folder, self.manifest, problem)
            self._known[problem] = True
        bounds = [self.structures.array(bound) for bound in (*problem.limits, *problem.action_bounds)]
        self._call("set_stage_bounds", self._controller, *(ctypes.c_void_p(address(bound)) for bound in bounds))

    def _input(self, problem: OCP, s0: Array, psi: Array, context: Array) -> tuple[Any, list[Array]]:
        """The structure, and the arrays that it points to."""
        arrays = [self.structures.array(value) for value in (s0, context, psi)]
        if takes_schedules(self.manifest):
            arrays.append(self.structures.array(problem.schedule))
        return self.structures.input(*map(address, arrays)), arrays

    def _guess(self, problem: OCP, guess: Guess) -> tuple[Any, list[Array]]:
        """A reference to the structure, None without a guess; and the arrays that it points to."""
        check_guess(guess)
        if guess is None:
            return None, []
        parts = {"states": problem.as_states(guess.states), "actions": problem.as_actions(guess.actions)}
        if isinstance(guess, Solution):
            parts |= _parts(problem, guess.multipliers)
        arrays = {name: self.structures.array(part) for name, part in parts.items()}
        made = self.structures.guess(**{name: address(array) for name, array in arrays.items()})
        return ctypes.byref(made), [*arrays.values()]

    def _plain(self, problem: OCP, solution: Solution) -> Any:
        parts = {"states": problem.as_states(solution.states), "actions": problem.as_actions(solution.actions)}
        plan = self.structures.solution()
        for name, part in (parts | _parts(problem, solution.multipliers)).items():
            if part.size:
                np.ctypeslib.as_array(getattr(plan, name))[:] = np.ravel(part)
        plan.residual = solution.residuals.worst
        return plan

    def _arrays(self, plan: Any) -> dict[str, Array]:
        """Trajectory and multipliers."""
        return {
            name: np.array(getattr(plan, name), float)[: int(np.prod(shape))].reshape(shape)
            for name, shape in self.structures.shapes.items()
        }

    def _solution(self, status: int, found: Any, psi: Array, context: Array) -> Solution:
        arrays = self._arrays(found)
        residuals = KKTResiduals(
            stationarity=found.stationarity,
            feasibility=found.feasibility,
            complementarity=found.complementarity,
            sign=0.0,
            scale=found.scale,
        )
        return Solution(
            trajectory=_trajectory(arrays),
            multipliers=_multipliers(arrays),
            objective=found.objective,
            residuals=residuals,
            status=STATUS[status],
            iterations=found.iterations,
            psi=psi,
            context=context,
            barrier=self._settings().barrier,
            message=f"{self._prefix}: {self._message(status)}",
        )

    def _not_finite(self, numbers: tuple[Array, Array, Array]) -> Solution:
        """The answer to an input with NaN or infinity in it: nothing was solved."""
        arrays = {name: np.full(shape, np.nan) for name, shape in self.structures.shapes.items()}
        arrays["states"][0] = numbers[0]
        return Solution(
            trajectory=_trajectory(arrays),
            multipliers=_multipliers(arrays),
            objective=np.nan,
            residuals=KKTResiduals(np.nan, np.nan, np.nan, np.nan, 1.0),
            status=Status.NOT_FINITE,
            iterations=0,
            psi=numbers[1],
            context=numbers[2],
            barrier=self._settings().barrier,
            message=f"{self._prefix}: {self._message(_INPUT)}",
        )


def _parts(problem: OCP, multipliers: Multipliers) -> dict[str, Array]:
    """Multipliers by their names in C. Raises ProblemError for shapes that do not fit."""
    check_multipliers(problem, multipliers)
    return {name: getattr(multipliers, own) for own, name in _MULTIPLIERS.items()}


def _trajectory(arrays: Mapping[str, Array]) -> Trajectory:
    return Trajectory(arrays["states"], arrays["actions"])


def _multipliers(arrays: Mapping[str, Array]) -> Multipliers:
    return Multipliers(**{own: arrays[name] for own, name in _MULTIPLIERS.items()})
