"""The interface of solvers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.statement.checks import shown
from kpirl_ocp.types import Array, Solution, Trajectory

Guess = Solution | Trajectory | None


@dataclass(frozen=True, eq=False)
class StageDerivatives:
    """The gradient of the Lagrangian without bounds, constraints and second derivatives at a point, in order of time.

    numbers: all in one row, as the C code writes and reads it: the gradient by x = (s_0, u_0, s_1, .., s_T), given
        entries of s_0 included; the objective; defects f - s_next; h at all stages, then g_T; e at all stages, then
        e_T; and column-major matrices, one stage after the other. These are the Jacobians of f (n_s, n_x), the
        transposed ones of h (n_x, n_h), then of g_T, and of e (n_x, n_e), then of e_T; and the Hessians of the
        Lagrangian (n_x, n_x), at the end (n_s, n_s).
    """

    numbers: Array


class Solver(Protocol):
    """A small frozen object of settings; the functions that it builds for a problem are cached and reused."""

    def solve(
        self, problem: OCP, s0: ArrayLike, psi: ArrayLike = (), context: ArrayLike = (), guess: Guess = None
    ) -> Solution:
        """Solve from s0 (n_s,) for psi (n_psi,) and context (n_c,), starting at `guess` (default: all actions zero).

        Never raises for a failed solve: look at `Solution.status`, or call `Solution.raise_if_failed()`.

        Raises:
            ProblemError: wrong lengths, or a problem with constraints that this solver does not handle.
        """
        ...


@runtime_checkable
class BarrierSolver(Solver, Protocol):
    """A solver that can stop at the solution of min J - tau sum log(slack), a smooth function of psi."""

    def with_barrier(self, barrier: float) -> BarrierSolver:
        """This solver for the problem smoothed with tau = barrier > 0."""
        ...


@runtime_checkable
class BatchSolver(Solver, Protocol):
    """A solver that solves several instances in one call, which releases the GIL."""

    def solve_each(
        self, problem: OCP, s0: Array, psi: Array, context: Array, guesses: Sequence[Guess]
    ) -> list[Solution]:
        """`solve` for each row of s0 (B, n_s), psi (B, n_psi) and context (B, n_c), and each of B guesses."""
        ...


@runtime_checkable
class LinearisingSolver(Solver, Protocol):
    """A solver that can return the derivatives at its solution, so that a sensitivity need not evaluate them again."""

    def solve_and_linearise(
        self, problem: OCP, s0: ArrayLike, psi: ArrayLike = (), context: ArrayLike = (), guess: Guess = None
    ) -> tuple[Solution, StageDerivatives | None]:
        """`solve`, and the derivatives at the solution; None if the solver did not end with them."""
        ...


def solve_and_linearise(
    solver: Solver, problem: OCP, s0: ArrayLike, psi: ArrayLike = (), context: ArrayLike = (), guess: Guess = None
) -> tuple[Solution, StageDerivatives | None]:
    """A solution by any solver, and the derivatives at it, or None if the solver does not return them."""
    if isinstance(solver, LinearisingSolver):
        return solver.solve_and_linearise(problem, s0, psi, context, guess)
    return solver.solve(problem, s0, psi, context, guess), None


def numbers_of(problem: OCP, s0: ArrayLike, psi: ArrayLike, context: ArrayLike) -> tuple[Array, Array, Array]:
    """The three as float64 vectors. Raises ProblemError for a problem that is none, and for wrong lengths."""
    if not isinstance(problem, OCP):
        raise ProblemError(f"problem must be an OCP, got {shown(problem)}: solve(problem, s0, psi, context).")
    return problem.inputs(s0, psi, context)


def check_guess(guess: object) -> None:
    """Raise ProblemError for a guess that is neither Solution, Trajectory nor None."""
    if not isinstance(guess, Guess):
        raise ProblemError(f"guess must be a Solution or a Trajectory, got {shown(guess)}.")


def guess_actions(problem: OCP, guess: Guess) -> Array:
    """Actions (T, n_u) to start from: those of the guess, or zero."""
    check_guess(guess)
    return np.zeros((problem.horizon, problem.n_actions)) if guess is None else problem.as_actions(guess.actions)
