"""Fatrop on the stage-ordered program (Vanroye, Sathya, De Schutter and Decre, 2023): another structured solver.

Unknowns x = (s_0, u_0, s_1, u_1, .. s_T); constraints stage by stage, in the order that CasADi's interface asks for:
s_{t+1} - f(s_t, u_t) = 0, at t = 0 the given entries of s_0, then e(s_t, u_t) = 0 and h(s_t, u_t) <= 0; at the end
e_T(s_T) = 0 and g_T(s_T) <= 0.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import cast

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.conditions.program import selected, trajectory_of, transcribe
from kpirl_ocp.ocp.problem.guards import dense, one_at_a_time
from kpirl_ocp.ocp.problem.layout import by_stage, lengths, pack, split, unpack, unpack_multipliers
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Guess
from kpirl_ocp.ocp.problem.statement.checks import check_settings
from kpirl_ocp.ocp.solvers.child_process import ChildProcess
from kpirl_ocp.ocp.solvers.infeasible import shown_infeasible
from kpirl_ocp.ocp.solvers.instance import Instance
from kpirl_ocp.types import Array, Mask, Multipliers, Solution, Status, Trajectory

_STATUS = {
    "SOLVER_RET_SUCCESS": Status.CONVERGED,
    "SOLVER_RET_LIMITED": Status.ITERATION_LIMIT,
    "SOLVER_RET_INFEASIBLE": Status.INFEASIBLE,
    "SOLVER_RET_NAN": Status.NOT_FINITE,
}

_CHILD = ChildProcess()
_GAVE_UP = (Status.FAILED, Status.ITERATION_LIMIT)


@dataclass(frozen=True)
class Fatrop:
    """Interior-point solver with exact Hessian on the stage structure, for every problem.

    A guess hands over its states and actions; Fatrop does not take multipliers. It moves every bound outwards by 1e-8
    (a setting that CasADi does not pass on), and the residuals show that: `Riccati` and `Ipopt` are more accurate.

    Fatrop does not end where a derivative is NaN or infinite. It runs in a process of its own, so that a solve ends in
    any case, can be interrupted, and leaves other threads alone.

    tolerance: Fatrop's own.
    max_iterations: before it gives up.
    time_limit: of a solve [s], after which it has FAILED; None solves in this process, without a limit.
    """

    tolerance: float = 1e-8
    max_iterations: int = 500
    time_limit: float | None = 60.0

    def __post_init__(self) -> None:
        check_settings(self, "tolerance", "max_iterations", *(["time_limit"] if self.time_limit is not None else []))
        limited = self.time_limit is None or self.time_limit > 0
        if not 0 < self.tolerance < np.inf or self.max_iterations < 1 or not limited:
            raise ProblemError("Fatrop needs tolerance > 0, max_iterations >= 1 and time_limit > 0.")

    def solve(
        self, problem: OCP, s0: ArrayLike, psi: ArrayLike = (), context: ArrayLike = (), guess: Guess = None
    ) -> Solution:
        """Solve; see `Solver.solve`."""
        instance = Instance.of(problem, s0, psi, context, guess)
        numbers = instance.s0, instance.psi, instance.context, instance.w
        if self.time_limit is None:
            return self._solve_here(problem, *numbers)
        found = _CHILD.call(self.time_limit, self._solve_here, problem, *numbers)
        if found is None:
            return instance.not_started(f"Fatrop: no answer after {self.time_limit} s", Status.FAILED)
        return cast("Solution", found)

    @one_at_a_time
    def _solve_here(self, problem: OCP, *numbers: Array) -> Solution:
        instance = Instance(problem, *numbers)
        if not _finite(instance):
            return instance.not_started("a function or its gradient is not finite at the start")
        program = _build(problem, self)
        try:
            result = program.solver(**program.arguments(instance))
        except RuntimeError as error:
            return instance.not_started(f"Fatrop: {str(error).splitlines()[-1]}", Status.FAILED)
        stats = program.solver.stats()
        word = str(stats.get("unified_return_status", "SOLVER_RET_UNKNOWN"))
        iterations = int(stats.get("iter_count", 0))

        def judge(residual: float) -> Status:
            status = self._short_of_tolerance(word, iterations, residual)
            return Status.INFEASIBLE if status in _GAVE_UP and shown_infeasible(instance) else status

        return instance.solution(
            program.point(instance, result),
            self.tolerance,
            judge,
            objective=float(result["f"]),
            iterations=iterations,
            message=f"Fatrop: {word}",
        )

    def _short_of_tolerance(self, word: str, iterations: int, residual: float) -> Status:
        if not np.isfinite(residual):
            return Status.NOT_FINITE
        if iterations >= self.max_iterations and word != "SOLVER_RET_SUCCESS":
            return Status.ITERATION_LIMIT
        return _STATUS.get(word, Status.FAILED)


@dataclass(frozen=True, eq=False)
class _Program:
    """The solver, and the kind of every constraint."""

    solver: ca.Function
    kinds: NDArray[np.str_]

    @property
    def inequality(self) -> Mask:
        """Which constraints are inequalities."""
        return np.isin(self.kinds, ("path", "terminal"))

    def arguments(self, instance: Instance) -> dict[str, Array]:
        """Those of the solver; p is (s_0, psi, c)."""
        problem, begun = instance.problem, unpack(instance.problem, instance.w)
        bounds = zip(problem.limits, map(np.asarray, problem.action_bounds), strict=True)
        lower, upper = (by_stage(*pair) for pair in bounds)
        return {
            "x0": by_stage(begun.states, begun.actions),
            "p": np.concatenate([instance.s0, instance.psi, instance.context]),
            "lbx": lower,
            "ubx": upper,
            "lbg": np.where(self.inequality, -np.inf, 0.0),
            "ubg": np.zeros(1),
        }

    def point(self, instance: Instance, result: dict[str, ca.DM]) -> tuple[Trajectory, Multipliers]:
        """Trajectory and multipliers that the solver found."""
        x, on_bounds, on_rows = (dense(result[name]).ravel() for name in ("x", "lam_x", "lam_g"))
        w, nu = (pack(_by_kind(instance.problem, values)) for values in (x, on_bounds))

        def of(*names: str) -> Array:
            return np.concatenate([on_rows[self.kinds == name] for name in names])

        lam = np.concatenate([-of("dynamics"), of("path_equality", "terminal_equality")])  # the rows are s_next - f
        multipliers = unpack_multipliers(instance.problem, nu, lam, of("path", "terminal"))
        return trajectory_of(instance.problem, w, instance.s0), multipliers


def _finite(instance: Instance) -> bool:
    """True if all functions and their gradients are finite at the start; Fatrop does not end where they are not."""
    program, at = transcribe(instance.problem), (instance.w, instance.psi, instance.context)
    ones = [np.ones(n) for n in lengths(instance.problem)[1:]]
    values = [*program.values(*at), *program.first(*at, *ones)]
    return all(np.isfinite(dense(value)).all() for value in values)


def _by_kind(problem: OCP, x: Array) -> Trajectory:
    """The trajectory of x, in the order of `by_stage`."""
    return Trajectory(*split(x, problem.horizon, problem.n_states, problem.n_actions))


@lru_cache(maxsize=64)
def _build(problem: OCP, solver: Fatrop) -> _Program:
    steps, n_s, n_u = problem.horizon, problem.n_states, problem.n_actions
    x, s0 = ca.MX.sym("x", steps * (n_s + n_u) + n_s), ca.MX.sym("s0", n_s)
    stages = ca.reshape(x[: steps * (n_s + n_u)], n_s + n_u, steps)
    states, actions = ca.horzcat(stages[:n_s, :], x[steps * (n_s + n_u) :]), stages[n_s:, :]
    point = states, actions, *problem.symbols()[2:]
    blocks = list(_blocks(problem, s0, point))
    kinds = np.concatenate([np.repeat(name, rows.numel()) for _, name, rows in blocks])
    others = [(at, rows.numel()) for at, name, rows in blocks if name != "dynamics"]
    options = {
        "structure_detection": "manual",
        "N": steps,
        "nx": [n_s] * (steps + 1),
        "nu": [n_u] * steps + [0],
        "ng": [sum(size for at, size in others if at == t) for t in range(steps + 1)],
        "fatrop": {"tol": solver.tolerance, "max_iter": solver.max_iterations, "print_level": 0},
        "equality": [name not in ("path", "terminal") for name in kinds],
        "print_time": False,
        "show_eval_warnings": False,
    }
    program = {
        "x": x,
        "p": ca.vertcat(s0, *point[2:]),
        "f": problem.cost(*point),
        "g": ca.vertcat(*(rows for *_, rows in blocks)),
    }
    return _Program(ca.nlpsol("fatrop", "fatrop", program, options), kinds)


def _blocks(problem: OCP, s0: ca.MX, point: Sequence[ca.MX]) -> Iterator[tuple[int, str, ca.MX]]:
    """Stage, kind and rows of all constraints, without those that are switched off."""
    states, live = point[0], problem.live
    gaps = states[:, 1:] - problem.at_stages(problem.dynamics, *point)
    equalities, path = problem.at_stages(problem.path_equality, *point), problem.path(*point)
    for t in range(problem.horizon):
        yield t, "dynamics", gaps[:, t]
        if t == 0:
            yield t, "start", selected(states[:, 0] - s0, ~problem.free_start)
        yield t, "path_equality", selected(equalities[:, t], live.path_equality[t])
        yield t, "path", path[:, t]
    last = problem.at_end(problem.terminal_equality, *point)
    yield problem.horizon, "terminal_equality", selected(last, live.terminal_equality)
    yield problem.horizon, "terminal", problem.at_end(problem.terminal_inequality, *point)
