"""A primal-dual interior-point method whose Newton steps are Riccati recursions: O(T) time and memory.

Multiple shooting with exact Hessians and Mehrotra's predictor-corrector steps, which lower tau on the way. The pivots
of the recursion show whether the Hessian is positive along the dynamics; where it is not, Newton steps with weight on
the actions keep to the same tau (as in Waechter and Biegler, 2006, section 3.1). The method itself is the C code in
`kpirl_ocp/ocp/interior_point/c`; the recursion is that of Rao, Wright and Rawlings (1998) and of HPIPM (Frison and
Diehl, 2020).
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.interior_point import library as c
from kpirl_ocp.ocp.interior_point.cores import borrow_core
from kpirl_ocp.ocp.interior_point.machine_code import Compile
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Guess, StageDerivatives, numbers_of
from kpirl_ocp.ocp.problem.statement.checks import check_settings
from kpirl_ocp.types import Array, Solution


@dataclass(frozen=True)
class Riccati:
    """Structure-exploiting interior-point solver for the whole problem class; warm start from a `Solution`.

    A warm start that gets stuck begins again, cold, from the guess's trajectory.

    tolerance: on `KKTResiduals.worst`.
    max_iterations: before it gives up.
    barrier: complementarity tau at which to stop. Zero solves the problem itself; tau > 0 solves
        min J - tau sum log(slack), whose solution is a smooth function of psi.
    steps: take exactly this many Newton steps without line search, from a warm start: the real-time iteration
        (Diehl et al., 2005). None iterates until convergence.
    compile: machine code for the problem's functions: True waits for it, False does without, and "auto" has it made in
        the background once a problem is solved often. The numbers are the same either way, to the last bit; only large
        networks, with T (n_s + n_u)^2 > 15000, round differently, and are compiled before their first solve.
    verbose: print a line per iteration to the standard error output.
    """

    tolerance: float = 1e-10
    max_iterations: int = 500
    barrier: float = 0.0
    steps: int | None = None
    compile: Compile = "auto"
    verbose: bool = field(default=False, compare=False)

    def __post_init__(self) -> None:
        check_settings(self, "tolerance", "barrier", "max_iterations", *(["steps"] if self.steps is not None else []))
        if not 0 < self.tolerance < np.inf or not 0 <= self.barrier < np.inf or self.max_iterations < 1:
            raise ProblemError("Riccati needs tolerance > 0, barrier >= 0 and max_iterations >= 1.")
        if self.steps is not None and self.steps < 1:
            raise ProblemError(f"steps must be at least 1, or None to iterate until convergence; got {self.steps!r}.")
        if self.compile not in (True, False, "auto"):
            raise ProblemError(f'compile must be True, False or "auto", got {self.compile!r}.')

    def with_barrier(self, barrier: float) -> Riccati:
        """The same solver for the smoothed problem."""
        return replace(self, barrier=barrier)

    def solve(
        self, problem: OCP, s0: ArrayLike, psi: ArrayLike = (), context: ArrayLike = (), guess: Guess = None
    ) -> Solution:
        """Solve; see `Solver.solve`. A `Solution` as guess also hands over its multipliers."""
        return self.solve_each(problem, *_one(problem, s0, psi, context, guess))[0]

    def solve_each(
        self, problem: OCP, s0: Array, psi: Array, context: Array, guesses: Sequence[Guess]
    ) -> list[Solution]:
        """`solve` for rows of s0 (B, n_s), psi (B, n_psi) and context (B, n_c), with B guesses; see `BatchSolver`."""
        with borrow_core(problem) as core:
            return core.solve(self._options(), self.compile, s0, psi, context, guesses)

    def solve_and_linearise(
        self, problem: OCP, s0: ArrayLike, psi: ArrayLike = (), context: ArrayLike = (), guess: Guess = None
    ) -> tuple[Solution, StageDerivatives | None]:
        """`solve`, and the second derivatives that it ended with; see `LinearisingSolver`."""
        given = _one(problem, s0, psi, context, guess)
        with borrow_core(problem) as core:
            return core.solve(self._options(), self.compile, *given)[0], core.derivatives()

    def _options(self) -> Any:
        options = c.Options(self.max_iterations, self.steps or 0, self.tolerance, self.barrier)
        if self.verbose:
            print(_HEADER, file=sys.stderr)
            options.log = ctypes.cast(_print, ctypes.c_void_p)
        return options


def _one(
    problem: OCP, s0: ArrayLike, psi: ArrayLike, context: ArrayLike, guess: Guess
) -> tuple[Array, Array, Array, list[Guess]]:
    """One solve for `Riccati.solve_each`."""
    start, parameters, about = numbers_of(problem, s0, psi, context)
    return start[None], parameters[None], about[None], [guess]


_HEADER = "iter   objective      inf_pr   inf_du   compl    lg(tau) ||d||    lg(rg) alpha_du alpha_pr  ls"


@c.LOG
def _print(_: int, line: Any) -> None:
    """One iteration, in the columns of Ipopt's log; "r" marks feasibility restoration."""
    it = line.contents
    regularisation = f"{np.log10(it.regularisation):6.1f}" if it.regularisation > 0 else "     -"
    print(
        f"{it.iteration + 1:4d}{'r' if it.restoring else ' '}{it.objective:14.7e} "
        f"{it.infeasibility:8.2e} {it.dual_infeasibility:8.2e} "
        f"{it.complementarity:8.2e} {np.log10(it.tau) if it.tau > 0 else -np.inf:6.1f} {it.step:8.2e} {regularisation} "
        f"{it.dual_length:8.2e} {it.primal_length:8.2e} {it.trials:3d}",
        file=sys.stderr,
    )
