"""A primal-dual interior-point method whose Newton steps are Riccati recursions: O(T) time and memory.

Multiple shooting with exact Hessians and Mehrotra's predictor-corrector steps, which lower tau on the way. The pivots
of the recursion show whether the Hessian is positive along the dynamics; where it is not, Newton steps with weight on
the actions keep to the same tau (as in Waechter and Biegler, 2006, section 3.1). Steps follow the dynamics
(`feedback_rollout`), as long as a filter accepts. The recursion is that of Rao, Wright and Rawlings (1998) and of
HPIPM (Frison and Diehl, 2020).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.interior_point.filter import Filter
from kpirl_ocp.ocp.interior_point.iterate import Derivatives, Iterate, Newton, Step, shortened
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.scope import refuse_features
from kpirl_ocp.ocp.problem.solver import Guess, StageDerivatives
from kpirl_ocp.types import Array, KKTResiduals, Solution, Status, Trajectory, largest

_START = 0.3  # barrier parameter of a cold start, relative to the gradient of the objective there
_WARM = 1e-3  # largest one of a warm start
_LARGE = 100.0  # multipliers above this count as large, as in Ipopt
_SHORTEST = 1e-10  # step length below which a line search gives up
_TINY = 1e-14  # relative step below which rounding decides, so that the step is taken as it is
_FAR = 1e12  # |w| beyond which an iterate has diverged
_ATTEMPTS = 6  # line searches at one iterate, each with a stronger regularisation


@dataclass(frozen=True)
class Riccati:
    """Structure-exploiting interior-point solver; bounds and path constraints; warm start from a `Solution`.

    A warm start that gets stuck begins again, cold, from the guess's trajectory.

    tolerance: on `KKTResiduals.worst`.
    max_iterations: before it gives up.
    barrier: complementarity tau at which to stop. Zero solves the problem itself; tau > 0 solves
        min J - tau sum log(slack), whose solution is a smooth function of psi.
    steps: take exactly this many Newton steps without line search, from a warm start: the real-time iteration
        (Diehl et al., 2005). None iterates until convergence.
    """

    tolerance: float = 1e-10
    max_iterations: int = 500
    barrier: float = 0.0
    steps: int | None = None

    def __post_init__(self) -> None:
        if not self.tolerance > 0 or not self.barrier >= 0 or self.max_iterations < 1:
            raise ProblemError("Riccati needs tolerance > 0, barrier >= 0 and max_iterations >= 1.")
        if self.steps is not None and self.steps < 1:
            raise ProblemError(f"steps must be at least 1, or None to iterate until convergence; got {self.steps!r}.")

    def with_barrier(self, barrier: float) -> Riccati:
        """The same solver for the smoothed problem."""
        return replace(self, barrier=barrier)

    def solve(
        self, problem: OCP, s0: ArrayLike, psi: ArrayLike = (), context: ArrayLike = (), guess: Guess = None
    ) -> Solution:
        """Solve; see `Solver.solve`. A `Solution` as guess also hands over its multipliers."""
        from kpirl_ocp.ocp.export.resident import resident  # which exports this class

        numbers = problem.inputs(s0, psi, context)
        refuse_features(problem, "Riccati")
        machine = resident(problem, self.max_iterations)
        found = machine.solve(self, *numbers, guess) if machine else None
        return found or self.solve_in_python(problem, *numbers, guess)

    def solve_and_linearise(
        self, problem: OCP, s0: ArrayLike, psi: ArrayLike = (), context: ArrayLike = (), guess: Guess = None
    ) -> tuple[Solution, StageDerivatives | None]:
        """`solve`, and the second derivatives that it ended with; see `LinearisingSolver`."""
        from kpirl_ocp.ocp.export.resident import resident

        numbers = problem.inputs(s0, psi, context)
        refuse_features(problem, "Riccati")
        machine = resident(problem, self.max_iterations)
        found = machine.solve(self, *numbers, guess) if machine else None
        if machine is None or found is None:
            return self.solve_in_python(problem, *numbers, guess), None
        return found, machine.derivatives()

    def solve_in_python(self, problem: OCP, s0: Array, psi: Array, context: Array, guess: Guess = None) -> Solution:
        """The same, one numpy array after the other; only derivatives and Newton steps are compiled functions."""
        newton = Newton(problem, s0, psi, context)
        run = _Run(self, newton)
        run.begin(*(self._warm(newton, guess) if isinstance(guess, Solution) else self._cold(newton, guess)))
        if self.steps is not None:
            return run.solution(run.advance(self.steps))
        status = run.converge()
        if isinstance(guess, Solution) and status in (Status.STALLED, Status.INFEASIBLE):
            run.begin(*self._cold(newton, guess.trajectory))
            status = run.converge()
        return run.solution(status)

    def _cold(self, newton: Newton, guess: Trajectory | None) -> tuple[Iterate, float]:
        """Iterate and tau for a start without multipliers."""
        iterate = newton.start(guess)
        tau = self.barrier or _START * newton.differentiate(iterate, matrices=False).scale
        return replace(iterate, z=tau / iterate.y), tau

    def _warm(self, newton: Newton, guess: Solution) -> tuple[Iterate, float]:
        """Iterate and tau for a start with multipliers."""
        tau = self.barrier or self._warm_barrier(newton, guess)
        return newton.resume(guess, tau), tau

    def _warm_barrier(self, newton: Newton, guess: Solution) -> float:
        """As small as the guess is good, so that a solution stays one; at most `_WARM`, so that a guess counts."""
        final = self.tolerance / 10
        error = newton.differentiate(newton.resume(guess, final), matrices=False).residuals(0.0).worst
        return float(np.clip(error, final, _WARM)) if np.isfinite(error) else _WARM


class _Run:
    """One solve: where it is, and how it got there."""

    def __init__(self, solver: Riccati, newton: Newton) -> None:
        self.solver, self.newton = solver, newton
        self.iterations = 0
        self.tolerance = solver.tolerance
        if solver.barrier > 0:  # the tolerance bounds multiplier * slack - tau: it has to be small beside tau
            self.tolerance = min(solver.tolerance, max(1e-6 * solver.barrier, 1e-13))

    def begin(self, iterate: Iterate, tau: float) -> None:
        """Go on from here; iterations count on."""
        self.iterate, self.tau = iterate, tau
        self.regularisation = 0.0  # the last one that was needed
        self.at: Derivatives = self.newton.differentiate(iterate)
        self.filter = Filter.starting_at(self.at.violation)

    def converge(self) -> Status:
        """Newton steps with line search until the conditions hold, or nothing helps."""
        while True:
            if not self.at.finite:
                return Status.NOT_FINITE
            if self._solved:
                return Status.CONVERGED
            if self.iterations == self.solver.max_iterations:
                return Status.ITERATION_LIMIT
            if largest(self.iterate.w) > _FAR:
                return Status.DIVERGED
            if not self._search():
                return self._why_stuck()
            self.iterations += 1

    def advance(self, steps: int) -> Status:
        """Full Newton steps, cut only where a slack or multiplier would become negative."""
        for left in reversed(range(steps)):
            step = self._step(0.0) if self.at.finite else None
            if step is None:
                return self._why_stuck() if self.at.finite else Status.NOT_FINITE
            self._move(step, step.primal_length, last=not left)
            self.iterations += 1
        if not self.at.finite:
            return Status.NOT_FINITE
        return Status.CONVERGED if self._solved else Status.STEPS_TAKEN

    def _why_stuck(self) -> Status:
        if not all(np.isfinite(matrix).all() for matrix in self.at.matrices):
            return Status.NOT_FINITE
        # Without bounds on states every rollout is feasible: then only this iterate is not.
        violation = self.at.residuals(self.solver.barrier).feasibility
        infeasible = self.newton.problem.has_state_constraints and violation > self.tolerance**0.5
        return Status.INFEASIBLE if infeasible else Status.STALLED

    @property
    def _solved(self) -> bool:
        """Do the conditions hold, and complementarity as if multipliers were at most `_LARGE`?

        Relative to larger multipliers alone, the weakest of the active constraints would stay too far from its bound.
        """
        found = self.at.residuals(self.solver.barrier)
        return found.worst <= self.tolerance and found.complementarity <= self._close

    @property
    def _close(self) -> float:
        """What complementarity may be off: a fifth of the tolerance, in units of multipliers where these are large."""
        return self.solver.tolerance / 5 * max(1.0, self.at.scale / _LARGE)

    @property
    def _final_tau(self) -> float:
        """The barrier to stop at."""
        return self.solver.barrier or self._close / 2

    def _step(self, regularisation: float) -> Step | None:
        """The Newton step, with as much regularisation as the pivots ask for; None if none is enough."""
        rho = regularisation
        while rho < 1e20:
            step = self.newton.step(self.at, self.tau, rho)
            if step.positive:
                self.regularisation = rho or self.regularisation
                return step
            first = max(self.regularisation / 3, 1e-12) if self.regularisation else 1e-4
            rho = first if rho == 0 else rho * (8.0 if self.regularisation else 100.0)
        return None

    def _search(self) -> bool:
        """Move along the corrected step where it is one to a minimum; else along Newton steps, regularised."""
        least = self._final_tau
        step = self.newton.corrected_step(self.at, least, max(self.tau, least))
        if step.positive:
            if step.tau != self.tau:
                self.tau, self.filter = step.tau, Filter.starting_at(self.at.violation)
            if self._move_along(step):
                return True
        rho = 0.0
        for _ in range(_ATTEMPTS):
            newton = self._step(rho)
            if newton is None:
                return False
            if self._move_along(newton):
                return True
            rho = max(100 * newton.regularisation, 1e-4)
        return False

    def _move_along(self, step: Step) -> bool:
        """Move by the longest length that the filter accepts, if there is one."""
        length, before, slope = step.primal_length, self.at.merit(step.tau), step.slope(self.at)
        tiny = largest(step.dw) <= _TINY * (1 + largest(self.iterate.w))
        while length >= _SHORTEST:
            trial, *merit = self.newton.trial(self.at, step, length)
            if (tiny and np.isfinite(merit[1])) or self.filter.accepts(*before, slope, length, merit):
                self._arrive(replace(trial, z=self.iterate.z + step.dual_length * step.dz))
                return True
            length = shortened(length, self.iterate, trial) if np.isinf(merit[1]) else length / 2
        return False

    def _move(self, step: Step, length: float, last: bool = False) -> None:
        self._arrive(self.iterate.moved(step, length, step.dual_length), last)

    def _arrive(self, at: Iterate, last: bool = False) -> None:
        self.iterate = self.newton.centre(at, self.tau)
        self.at = self.newton.differentiate(self.iterate, matrices=not last)

    def solution(self, status: Status) -> Solution:
        """The record of this run."""
        residuals: KKTResiduals = self.at.residuals(self.solver.barrier)
        return Solution(
            trajectory=self.newton.trajectory(self.iterate),
            multipliers=self.newton.multipliers(self.iterate),
            objective=self.at.objective,
            residuals=residuals,
            status=status,
            iterations=self.iterations,
            psi=self.newton.psi,
            context=self.newton.context,
            barrier=self.solver.barrier,
        )
