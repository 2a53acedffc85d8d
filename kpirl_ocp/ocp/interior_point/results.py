"""Solutions side by side, as the C code writes and reads them, and the records that are made of them."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

import kpirl_ocp.ocp.interior_point.library as c
from kpirl_ocp.ocp.conditions.violations import explained
from kpirl_ocp.ocp.problem.layout import multiplier_shapes
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, KKTResiduals, Multipliers, Solution, Status, Trajectory, record

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


@lru_cache(maxsize=64)
def solution_row(problem: OCP) -> np.dtype[np.void]:
    """The arrays of a solution one behind the other, as the C code writes them, by their names."""
    duals = {f"multipliers.{name}": shape for name, shape in multiplier_shapes(problem).items()}
    plan = {"states": (problem.horizon + 1, problem.n_states), "actions": (problem.horizon, problem.n_actions)}
    return np.dtype([(name, float, shape) for name, shape in (plan | duals).items()])


def solutions_in(
    problem: OCP, psi: Array, context: Array, rows: NDArray[np.void], results: NDArray[np.void], barrier: float
) -> list[Solution]:
    """Records, whose arrays show these; one that is kept keeps the memory of all.

    Args:
        problem: that was solved.
        psi: (B, n_psi) that they were found for.
        context: (B, n_c).
        rows: (B,) of `solution_row`, whose multipliers of given initial states become zero.
        results: B structures `kpirl_mpc_result`.
        barrier: of all.
    """
    rows["multipliers.state"][:, 0, ~problem.free_start] = 0
    parts = (rows[name] for name in rows.dtype.names or ())
    solutions = map(partial(_solution, barrier), psi, context, results.tolist(), *parts)
    return [explained(problem, found) for found in solutions]


def _solution(barrier: float, psi: Array, context: Array, result: tuple[Any, ...], *parts: Array) -> Solution:
    """The record of one solution."""
    (stationarity, feasibility, complementarity, scale), objective, iterations, status = result
    states, actions, dynamics, state, action, path, terminal, path_equality, terminal_equality = parts
    multipliers = {
        "dynamics": dynamics,
        "state": state,
        "action": action,
        "path": path,
        "path_equality": path_equality,
        "terminal": terminal,
        "terminal_equality": terminal_equality,
    }
    residuals = {
        "stationarity": stationarity,
        "feasibility": feasibility,
        "complementarity": complementarity,
        "sign": 0.0,
        "scale": scale,
    }
    fields = {
        "trajectory": record(Trajectory, {"states": states, "actions": actions}),
        "multipliers": record(Multipliers, multipliers),
        "objective": objective,
        "residuals": record(KKTResiduals, residuals),
        "status": STATUS[status],
        "iterations": iterations,
        "psi": psi,
        "context": context,
        "barrier": barrier,
        "message": "",
    }
    return record(Solution, fields)
