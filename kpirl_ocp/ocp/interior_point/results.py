"""Solutions side by side, as the C code writes and reads them, and the records that are made of them."""

from __future__ import annotations

from functools import lru_cache, partial
from itertools import accumulate, pairwise
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

import kpirl_ocp.ocp.interior_point.library as c
from kpirl_ocp.ocp.problem.layout import multiplier_shapes
from kpirl_ocp.ocp.problem.ocp import OCP
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
RESULT = np.dtype(c.Result)


class SolutionRows:
    """B solutions as an array (B, n): a row holds the arrays of one, in the order of `shapes`, one behind the other.

    shapes: of the arrays of a solution, by name.
    """

    def __init__(self, problem: OCP) -> None:
        duals = {f"multipliers.{name}": shape for name, shape in multiplier_shapes(problem).items()}
        plan = {"states": (problem.horizon + 1, problem.n_states), "actions": (problem.horizon, problem.n_actions)}
        self.shapes: dict[str, tuple[int, ...]] = plan | duals
        self._ends = list(accumulate(map(prod, self.shapes.values()), initial=0))
        self._given = np.flatnonzero(~problem.free_start)

    def empty(self, count: int) -> Array:
        """To be filled."""
        return np.empty((count, self._ends[-1]))

    def parts(self, rows: Array) -> list[Array]:
        """The arrays (B, ..) of all solutions, which show `rows`."""
        spans = zip(pairwise(self._ends), self.shapes.values(), strict=True)
        return [rows[:, a:b].reshape(len(rows), *shape) for (a, b), shape in spans]

    def solutions(
        self, psi: Array, context: Array, rows: Array, results: NDArray[Any], barrier: float
    ) -> list[Solution]:
        """Records, whose arrays show `rows`.

        Args:
            psi: (B, n_psi) that they were found for.
            context: (B, n_c).
            rows: (B, n), whose multipliers of given initial states become zero.
            results: B structures `kpirl_mpc_result`.
            barrier: of all.
        """
        parts = self.parts(rows)
        parts[3][:, 0, self._given] = 0
        return list(map(partial(_solution, barrier), psi, context, results.tolist(), *parts))


def _solution(barrier: float, psi: Array, context: Array, result: tuple[Any, ...], *parts: Array) -> Solution:
    """The record of one solution."""
    (stationarity, feasibility, complementarity, scale), objective, iterations, status = result
    states, actions, dynamics, state, action, path, terminal, path_equality, terminal_equality = parts
    return Solution(
        psi=psi,
        context=context,
        trajectory=Trajectory(states, actions),
        multipliers=Multipliers(dynamics, state, action, path, path_equality, terminal, terminal_equality),
        objective=objective,
        residuals=KKTResiduals(stationarity, feasibility, complementarity, 0.0, scale),
        status=STATUS[status],
        iterations=iterations,
        barrier=barrier,
    )


@lru_cache(maxsize=64)
def solution_rows(problem: OCP) -> SolutionRows:
    """The layout of a problem's solutions."""
    return SolutionRows(problem)
