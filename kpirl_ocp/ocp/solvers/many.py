"""Many solves at once, over threads: the work is done in C, which lets other threads run."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Guess, Solver
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.types import Array, Solution


def solve_many(
    problem: OCP,
    s0: ArrayLike,
    psi: ArrayLike = (),
    context: ArrayLike = (),
    guesses: Sequence[Guess] | None = None,
    solver: Solver = Riccati(),  # noqa: B008 - frozen
    threads: int | None = None,
) -> list[Solution]:
    """Solve one problem for B sets of numbers; the results do not depend on the number of threads.

    Args:
        problem: the same for all.
        s0: (B, n_s) initial states, or (n_s,) for all.
        psi: (B, n_psi), or (n_psi,) for all.
        context: (B, n_c), or (n_c,) for all.
        guesses: B of them; None starts every solve from no action.
        solver: `Riccati` lets threads run side by side; other solvers take turns.
        threads: how many; None: as many as there are processors.

    Returns:
        B solutions, each with a status of its own.

    Raises:
        ProblemError: arrays of other shapes, or of different B.
    """
    given = {"s0": (s0, problem.n_states), "psi": (psi, problem.n_parameters), "context": (context, problem.n_context)}
    arrays = {name: _rows(name, value, length) for name, (value, length) in given.items()}
    counts = {name: len(array) for name, array in arrays.items() if array.ndim == 2}
    if guesses is not None:
        counts["guesses"] = len(guesses)
    if len(set(counts.values())) > 1:
        raise ProblemError(f"solve_many needs as many of everything, got {counts}.")
    if threads is not None and threads < 1:
        raise ProblemError(f"threads must be at least 1, got {threads}.")
    count = next(iter(counts.values()), 1)
    columns = [np.broadcast_to(array, (count, array.shape[-1])) for array in arrays.values()]
    with ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        return list(pool.map(solver.solve, [problem] * count, *columns, guesses or [None] * count))


def _rows(name: str, value: ArrayLike, length: int) -> Array:
    """(length,) or (B, length)."""
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError):
        array = np.zeros((0, 0, 0))
    if array.ndim not in (1, 2) or array.shape[-1] != length:
        raise ProblemError(f"{name} must be numbers of shape (B, {length}) or ({length},), got {np.shape(value)}.")
    return array
