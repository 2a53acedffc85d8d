"""Many solves, and gradients of many, at once over threads: the work is done in C, which lets other threads run."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import chain
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import BatchSolver, Given, Guess, Solver
from kpirl_ocp.ocp.sensitivity.certificate import Policy, check_policy
from kpirl_ocp.ocp.sensitivity.pulls import pull_each
from kpirl_ocp.ocp.sensitivity.solution_sensitivity import Gradients
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.types import Array, Solution

Q = TypeVar("Q")
R = TypeVar("R")
_GROUP = 8  # solves of one call into C, during which an interrupt has to wait


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
    count = next(iter(counts.values()), 1)
    columns = [np.broadcast_to(array, (count, array.shape[-1])) for array in arrays.values()]
    rows = list(zip(*columns, guesses or [None] * count, strict=True))
    each = solver.solve_each if isinstance(solver, BatchSolver) else partial(_one_by_one, solver)
    return in_groups(partial(each, problem), rows, threads)


def pull_many(
    problem: OCP,
    solutions: Sequence[Solution],
    by_states: ArrayLike,
    by_actions: ArrayLike,
    policy: Policy = "raise",
    threads: int | None = None,
) -> list[Gradients]:
    """Gradients of functions of B solutions; the results do not depend on the number of threads.

    Args:
        problem: that was solved.
        solutions: B of them, by any solver.
        by_states: slopes of the functions by the states (B, T+1, n_s).
        by_actions: the same by the actions (B, T, n_u).
        policy: what to do with a gradient that is not certified: "raise" CertificateError, or "flag" it in its
            certificate.
        threads: how many; None: as many as there are processors.

    Returns:
        B gradients by psi, s_0 and the context, each with a certificate of its own.

    Raises:
        CertificateError: under the policy "raise", when one is not certified.
        ProblemError: arrays of other shapes, or of different B.
    """
    states, actions = np.asarray(by_states, float), np.asarray(by_actions, float)
    if not len(solutions) == len(states) == len(actions):
        given = {"solutions": len(solutions), "by_states": len(states), "by_actions": len(actions)}
        raise ProblemError(f"pull_many needs as many of everything, got {given}.")

    check_policy(policy, ("raise", "flag"))
    rows = list(zip(solutions, states, actions, strict=True))
    return in_groups(partial(pull_each, problem, policy=policy), rows, threads)


def _one_by_one(solver: Solver, problem: OCP, rows: Sequence[Given]) -> list[Solution]:
    return [solver.solve(problem, *row) for row in rows]


def in_groups(function: Callable[[Sequence[Q]], list[R]], given: Sequence[Q], threads: int | None) -> list[R]:
    """`function(given)`, which has one result for each, in groups that threads share; the order stays.

    One call into C does the work of a group: each return from C waits for the interpreter's lock.
    """
    size = max(1, min(_GROUP, len(given) // (threads or os.cpu_count() or 1)))
    groups = [given[i : i + size] for i in range(0, len(given), size)]
    return list(chain.from_iterable(side_by_side(function, groups, threads=threads)))


def side_by_side(function: Callable[..., R], *columns: Iterable[Any], threads: int | None = None) -> list[R]:
    """The results of a function, in the order of its arguments. Raises ProblemError for less than one thread."""
    if threads is not None and threads < 1:
        raise ProblemError(f"threads must be at least 1, got {threads}.")
    if threads == 1:
        return list(map(function, *columns))
    with ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        return list(pool.map(function, *columns))


def _rows(name: str, value: ArrayLike, length: int) -> Array:
    """(length,) or (B, length)."""
    try:
        array = np.require(value, float, "A")
    except (TypeError, ValueError):
        array = np.zeros((0, 0, 0))
    if array.ndim not in (1, 2) or array.shape[-1] != length:
        raise ProblemError(f"{name} must be numbers of shape (B, {length}) or ({length},), got {np.shape(value)}.")
    return array
