"""The interior-point core in C with one problem in it."""

from __future__ import annotations

import ctypes
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar, cast

import casadi as ca
import numpy as np
from numpy.typing import NDArray

import kpirl_ocp.ocp.interior_point.library as c
from kpirl_ocp.ocp.codegen.numpy_calls import Build
from kpirl_ocp.ocp.conditions.structure import quadratic_program
from kpirl_ocp.ocp.interior_point.evaluator import Compiled, Names, VirtualMachine, pointer_to
from kpirl_ocp.ocp.interior_point.horizon_functions import horizon_functions
from kpirl_ocp.ocp.interior_point.machine_code import Compile, prepare, prepare_function
from kpirl_ocp.ocp.interior_point.results import RESULT, solution_row, solutions_in
from kpirl_ocp.ocp.interior_point.stage_functions import stage_functions
from kpirl_ocp.ocp.interior_point.tapes import Tape, Tapes, dense_entries, read_tapes
from kpirl_ocp.ocp.problem.layout import by_stage, check_multipliers
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Guess, StageDerivatives, check_guess
from kpirl_ocp.types import Array, Solution

_OTHERS = 32  # things that a core keeps besides its functions
_EVALUATIONS = 5  # of every stage that a use of such a function makes

T = TypeVar("T")


class Core:
    """Memory, functions and bounds of one problem for the C code; for one thread at a time."""

    def __init__(self, problem: OCP) -> None:
        self._library = c.library()
        self.problem = problem
        self._kept: list[Any] = []  # arrays and evaluators that the C code has pointers to
        self._schedule = np.ascontiguousarray(problem.schedule, float)
        self._patterns = self._find_patterns()
        self._code: Mapping[str, int] | None = None
        self._model = self._make_model()
        dimensions, bounds = dimensions_of(self.problem), self._bounds()
        given = [ctypes.byref(x) for x in (dimensions, bounds, self._model)]
        self._memory = np.zeros(self._library.kpirl_mpc_core_size(*given), np.uint8)
        self._core = self._library.kpirl_mpc_core_init(*given, ctypes.c_void_p(self._memory.ctypes.data))
        self._wish: Compile = "auto"
        self._evaluations = 0
        self._others: OrderedDict[Any, Any] = OrderedDict()

    @property
    def library(self) -> Any:
        """The C code."""
        return self._library

    @property
    def address(self) -> int:
        """Of the structure `kpirl_mpc_core`."""
        return int(self._core)

    def kept(self, make: Callable[[OCP], T]) -> T:
        """`make(problem)`, made once for this core, of which nobody else makes use at the same time."""
        if make not in self._others:
            while len(self._others) >= _OTHERS:
                self._others.popitem(last=False)
            self._others[make] = make(self.problem)
        self._others.move_to_end(make)
        return cast("T", self._others[make])

    def function(self, build: Build, uses: int = 1) -> int:
        """The address of a C function pointer to `build(problem)`, which works in memory of this core.

        It is called with structures of pointers to its arguments and to its results, in their order.

        uses: of the function that are to come; machine code is worth making after many.
        """
        pointer = self.kept(pointer_to(build))
        if not pointer.compiled:
            pointer.uses += uses
            evaluations = _EVALUATIONS * self.problem.horizon * pointer.uses
            code = prepare_function(self.problem, build, self._wish, evaluations)
            if code is not None:
                pointer.take(code)
        return pointer.address

    def solve(
        self, options: Any, wish: Compile, s0: Array, psi: Array, context: Array, guesses: Sequence[Guess]
    ) -> list[Solution]:
        """Solve for each of several numbers with settings `library.Options`; the GIL is released meanwhile.

        Args:
            options: settings.
            wish: for machine code.
            s0: (B, n_s). psi: (B, n_psi). context: (B, n_c).
            guesses: B of them.
        """
        self._use(wish)
        count = len(s0)
        kept = [np.array(array, float, order="C") for array in (s0, psi, context)]
        begun = [[np.require(array, float, ("C", "A")) for array in self._start(guess)] for guess in guesses]
        numbers = c.Numbers(*map(c.address_of, kept), c.address_of(self._schedule))
        starts = (c.Start * count)(*(c.Start(*map(c.address_of, start)) for start in begun)) if any(begun) else None
        found, results = np.empty(count, solution_row(self.problem)), np.empty(count, RESULT)
        at = ctypes.addressof(numbers), ctypes.addressof(options), None if starts is None else ctypes.addressof(starts)
        self._library.kpirl_mpc_solve_each(self._core, count, *at, found.ctypes.data, results.ctypes.data)
        solutions = solutions_in(self.problem, kept[1], kept[2], found, results, options.barrier)
        self._evaluations += 2 * sum(each.iterations + 1 for each in solutions) * self.problem.horizon
        return solutions

    def _use(self, wish: Compile) -> None:
        """The machine code that there is by now, or none, as is wished."""
        self._wish, code = wish, prepare(self.problem, wish, self._evaluations)
        if code is not self._code:
            self._code = code
            self._model = self._make_model()
            self._library.kpirl_mpc_core_set_model(self._core, ctypes.addressof(self._model))

    def derivatives(self) -> StageDerivatives | None:
        """At the last solution; None if the solve ended without them."""
        count = self._library.kpirl_mpc_put_derivatives(self._core, None)
        if not count:
            return None
        numbers = np.empty(count)
        for part in (self._library.kpirl_mpc_core_gradient, self._library.kpirl_mpc_put_derivatives):
            part(self._core, c.address_of(numbers))
        return StageDerivatives(numbers)

    def _bounds(self) -> Any:
        lower, upper, free = point_bounds(self.problem)
        self._kept += [lower, upper, free]
        return c.Bounds(*(array.ctypes.data for array in (lower, upper)), free.ctypes.data, len(free))

    def _make_model(self) -> Any:
        """The functions: as machine code where there is some, else as tapes where they can be read as such."""
        if self.problem.derivatives is not None:
            functions, model = horizon_functions(self.problem), c.Model(by_stage=0)
            model.horizon[:] = [self._pointer(function, c.HORIZON) for function in functions.horizon]
            model.dynamics = self._pointer(functions.dynamics)
            return model
        stages, tapes = stage_functions(self.problem), read_tapes(self.problem) if self._code is None else None
        model = c.Model(by_stage=tapes is None, quadratic=quadratic_program(self.problem), **self._patterns)
        if tapes is None:
            model.stage[:] = [self._pointer(function) for function in stages.stage]
            model.last[:] = [self._pointer(function) for function in stages.last]
        else:
            model.horizon[:] = [self._taped(*pair) for pair in tapes]
            model.dynamics = self._pointer(stages.stage[0])
        return model

    def _taped(self, stage: Tape, last: Tape) -> Any:
        tapes = Tapes(stage, last, dimensions_of(self.problem), self._schedule)
        self._kept.append(tapes)
        return tapes.pointer

    def _pointer(self, function: ca.Function, names: Names = c.STAGE) -> Any:
        if self._code is None:
            evaluator: VirtualMachine | Compiled = VirtualMachine(function, names)
        else:
            evaluator = Compiled(function, names, self._code[function.name()])
        self._kept.append(evaluator)
        return evaluator.pointer

    def _find_patterns(self) -> dict[str, Any]:
        """Places of the nonzeros of sparse results."""
        if self.problem.derivatives is not None:
            return {}
        functions = stage_functions(self.problem)
        second, last = functions.stage[2], functions.last[2]
        stage = {name: self._pattern(second, name) for name in ("F", "G", "E", "H")}
        return stage | {f"{name}_last": self._pattern(last, name) for name in ("G", "E", "H")}

    def _pattern(self, function: ca.Function, name: str) -> Any:
        entries = dense_entries(function.sparsity_out(name))
        self._kept.append(entries)
        return c.Pattern(len(entries), entries.ctypes.data)

    def _start(self, guess: Guess) -> list[Array]:
        """Arrays for `library.Start`."""
        check_guess(guess)
        if guess is None:
            return []
        problem = self.problem
        arrays = [by_stage(problem.as_states(guess.states), problem.as_actions(guess.actions))]
        if isinstance(guess, Solution):
            m = guess.multipliers
            check_multipliers(problem, m)
            rows = [(m.path, m.terminal), (m.path_equality, m.terminal_equality)]
            arrays += [m.dynamics, by_stage(m.state, m.action)]
            arrays += [np.concatenate([path.ravel(), last]) for path, last in rows]
        return arrays


def dimensions_of(problem: OCP) -> Any:
    """As the core is given them."""
    return c.Dimensions(
        horizon=problem.horizon,
        n_states=problem.n_states,
        n_actions=problem.n_actions,
        n_path=problem.n_path,
        n_equality=problem.n_path_equality,
        n_terminal=problem.n_terminal,
        n_terminal_equality=problem.n_terminal_equality,
        n_parameters=problem.n_parameters,
        n_context=problem.n_context,
        n_schedule=np.asarray(problem.schedule).shape[1],
    )


def point_bounds(problem: OCP) -> tuple[Array, Array, NDArray[np.intc]]:
    """Lower and upper bounds in the order of `by_stage`, and which entries of s_0 are free."""
    pairs = zip(problem.limits, problem.action_bounds, strict=True)
    lower, upper = (by_stage(states, np.asarray(actions)) for states, actions in pairs)
    return lower, upper, np.flatnonzero(problem.free_start).astype(np.intc)
