"""Results of the C code as solutions."""

from __future__ import annotations

from itertools import accumulate, pairwise
from typing import Any

import numpy as np

import kpirl_ocp.ocp.interior_point.library as c
from kpirl_ocp.ocp.problem.layout import split
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Given
from kpirl_ocp.types import Array, KKTResiduals, Multipliers, Solution, Status, Trajectory

STATUS = {
    0: Status.CONVERGED,
    1: Status.STEPS_TAKEN,
    2: Status.ITERATION_LIMIT,
    3: Status.INFEASIBLE,
    4: Status.STALLED,
    5: Status.DIVERGED,
    6: Status.NOT_FINITE,
    10: Status.NOT_A_MINIMUM,
    11: Status.ACCEPTABLE,
}
"""Values of the C enum kpirl_mpc_status that a solve ends with."""


class Results:
    """One array per solve: x, costates, multipliers of bounds, of h and g_T, and of e and e_T."""

    def __init__(self, problem: OCP, n_w: int) -> None:
        """n_w: length of x."""
        T = problem.horizon
        rows = T * problem.n_path + problem.n_terminal, T * problem.n_path_equality + problem.n_terminal_equality
        self._problem, self._given = problem, np.flatnonzero(~problem.free_start)
        self._ends = list(accumulate((0, n_w, T * problem.n_states, n_w, *rows)))

    def empty(self) -> Array:
        """An array to be filled."""
        return np.empty(self._ends[-1])

    def places(self, values: Array) -> tuple[int, ...]:
        """Addresses of the parts, the first members of `kpirl_mpc_result`."""
        at = c.address_of(values)
        return tuple(at + values.itemsize * begin for begin in self._ends[:-1])

    def solution(self, given: Given, values: Array, result: Any, barrier: float) -> Solution:
        """Of one solve; it shows parts of `values`."""
        (_, psi, context, _), r = given, result.residuals
        x, *multipliers = (values[a:b] for a, b in pairwise(self._ends))
        problem = self._problem
        return Solution(
            psi=psi,
            context=context,
            trajectory=Trajectory(*split(x, problem.horizon, problem.n_states, problem.n_actions)),
            multipliers=self._multipliers(*multipliers),
            objective=result.objective,
            residuals=KKTResiduals(r.stationarity, r.feasibility, r.complementarity, 0.0, r.scale),
            status=STATUS[result.status],
            iterations=result.iterations,
            barrier=barrier,
        )

    def _multipliers(self, costates: Array, bounds: Array, path: Array, equality: Array) -> Multipliers:
        problem = self._problem
        T, n_s, n_h, n_e = problem.horizon, problem.n_states, problem.n_path, problem.n_path_equality
        state, action = split(bounds, T, n_s, problem.n_actions)
        state[0, self._given] = 0
        return Multipliers(
            dynamics=costates.reshape(T, n_s),
            state=state,
            action=action,
            path=path[: T * n_h].reshape(T, n_h),
            path_equality=equality[: T * n_e].reshape(T, n_e),
            terminal=path[T * n_h :],
            terminal_equality=equality[T * n_e :],
        )
