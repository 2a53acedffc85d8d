"""Many solves, and gradients of many, at once over threads: the work is done in C, which lets other threads run."""

from __future__ import annotations

import math
import os
from _thread import start_new_thread
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial
from itertools import chain, pairwise, starmap
from operator import itemgetter
from queue import SimpleQueue
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import BatchSolver, Guess, Solver
from kpirl_ocp.ocp.sensitivity.certificate import Policy, check_policy, require
from kpirl_ocp.ocp.sensitivity.pulls import pull_each
from kpirl_ocp.ocp.sensitivity.solution_arrays import arrays_of, as_rows
from kpirl_ocp.ocp.sensitivity.solution_sensitivity import Gradients
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.types import Array, Solution, floats

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
        B solutions, each with a status of its own. Up to eight share memory, which is freed with the last of them.

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
    whole = (np.broadcast_to(array, (count, array.shape[-1])) for array in arrays.values())
    starts, parameters, contexts = map(np.ascontiguousarray, whole)
    begun: Sequence[Guess] = [None] * count if guesses is None else list(guesses)
    each = solver.solve_each if isinstance(solver, BatchSolver) else partial(_one_by_one, solver)

    def solve(part: slice) -> list[Solution]:
        return each(problem, starts[part], parameters[part], contexts[part], begun[part])

    return in_groups(solve, count, threads)


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
    states, actions = (np.atleast_1d(floats(*each)) for each in (("by_states", by_states), ("by_actions", by_actions)))
    given = {"solutions": len(solutions), "by_states": len(states), "by_actions": len(actions)}
    if len(set(given.values())) > 1:
        raise ProblemError(f"pull_many needs as many of everything, got {given}.")
    check_policy(policy, ("raise", "flag"))
    slopes = _slopes(problem, states, actions)

    def pull(part: slice) -> list[Gradients]:
        numbered = enumerate(solutions[part], part.start)
        rows = as_rows(problem, [arrays_of(problem, each, f"solution {number}") for number, each in numbered])
        return pull_each(problem, solutions[part], rows, slopes[part])

    found = in_groups(pull, len(solutions), threads)
    for number, gradients in enumerate(found):
        require(policy, gradients.certificate, f"gradient {number}")
    return found


def _one_by_one(
    solver: Solver, problem: OCP, s0: Array, psi: Array, context: Array, guesses: Sequence[Guess]
) -> list[Solution]:
    return [solver.solve(problem, *each) for each in zip(s0, psi, context, guesses, strict=True)]


def in_groups(function: Callable[[slice], list[R]], count: int, threads: int | None) -> list[R]:
    """The results of a function that has one for each of a slice of `count`, in groups that threads share, in order.

    One call into C does the work of a group: each return from C waits for the interpreter's lock. No group is larger
    than a thread's share of what is left, so that all threads end at about the same time.
    """
    sharing, ends = max(1, threads or os.cpu_count() or 1), [0]
    while (left := count - ends[-1]) > 0:
        ends.append(ends[-1] + min(_GROUP, math.ceil(left / sharing)))
    groups = list(starmap(slice, pairwise(ends)))
    return list(chain.from_iterable(side_by_side(function, groups, threads=threads)))


def side_by_side(function: Callable[..., R], *columns: Iterable[Any], threads: int | None = None) -> list[R]:
    """The results of a function, in the order of its arguments. Raises ProblemError for less than one thread.

    This thread and others take one after the other; all stop after theirs when one fails or this thread is interrupted.
    Those of `threading` would let this one wait until they run.
    """
    if threads is not None and threads < 1:
        raise ProblemError(f"threads must be at least 1, got {threads}.")
    left = deque(enumerate(zip(*columns, strict=True)))
    count, found, failed = min(threads or os.cpu_count() or 1, len(left)), {}, {}
    running, ended = 0, SimpleQueue[None]()

    def call(number: int, given: tuple[Any, ...]) -> None:
        try:
            found[number] = function(*given)
        except BaseException as error:
            failed[number] = error
            left.clear()

    def work() -> None:
        with suppress(IndexError):  # nothing is left
            while True:
                call(*left.popleft())

    def help_out() -> None:
        try:
            work()
        finally:
            ended.put(None)

    try:
        for _ in range(count - 1):
            start_new_thread(help_out, ())
            running += 1
        work()
    finally:
        left.clear()
        for _ in range(running):
            ended.get()
    for _, error in sorted(failed.items(), key=itemgetter(0)):
        raise error
    return [found[number] for number in sorted(found)]


def _slopes(problem: OCP, states: Array, actions: Array) -> Array:
    """Slopes by states, then by actions of B plans (B, n_w); raises ProblemError for other shapes."""
    if not len(states):
        return np.zeros((0, 0))
    whole = _whole(problem.as_states, states), _whole(problem.as_actions, actions)
    return np.concatenate([slopes.reshape(len(slopes), -1) for slopes in whole], axis=1)


def _whole(fit: Callable[[Array], Array], slopes: Array) -> Array:
    """Slopes as `OCP.as_states` or `OCP.as_actions` has each; they are one shape, and so is what they lack."""
    whole = fit(slopes[0])
    return slopes if whole.shape == slopes.shape[1:] else np.array([fit(each) for each in slopes])


def _rows(name: str, value: ArrayLike, length: int) -> Array:
    """(length,) or (B, length)."""
    try:
        array = np.require(value, float, "A")
    except (TypeError, ValueError):
        array = np.zeros((0, 0, 0))
    if array.ndim not in (1, 2) or array.shape[-1] != length:
        raise ProblemError(f"{name} must be numbers of shape (B, {length}) or ({length},), got {np.shape(value)}.")
    return array
