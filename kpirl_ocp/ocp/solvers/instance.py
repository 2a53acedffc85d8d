"""The part that solvers of the whole program share: where a solve begins, its arguments for CasADi, its audited end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.ocp.conditions.audit import audit
from kpirl_ocp.ocp.conditions.multiplier_estimates import estimate_multipliers
from kpirl_ocp.ocp.conditions.program import limits_from, not_started, starting_point, trajectory_of, transcribe
from kpirl_ocp.ocp.conditions.violations import explained
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.problem.layout import bound_multipliers, unpack_multipliers
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Guess, numbers_of
from kpirl_ocp.types import Array, KKTResiduals, Multipliers, Solution, Status, Trajectory


@dataclass(frozen=True, eq=False)
class Instance:
    """A problem with the numbers of one solve: s_0 (n_s,), psi (n_psi,), context (n_c,), and w (n_w,) to start from."""

    problem: OCP
    s0: Array
    psi: Array
    context: Array
    w: Array

    @classmethod
    def of(cls, problem: OCP, s0: ArrayLike, psi: ArrayLike, context: ArrayLike, guess: Guess) -> Instance:
        """The instance that `Solver.solve` is asked to solve; raises ProblemError for inputs that do not fit."""
        numbers = numbers_of(problem, s0, psi, context)
        return cls(problem, *numbers, starting_point(problem, *numbers, guess))

    @property
    def finite(self) -> bool:
        """False if a number is NaN or infinite."""
        return bool(np.isfinite(np.concatenate([self.w, self.psi, self.context])).all())

    def not_started(
        self,
        why: str = "the start, psi or the context holds NaN or infinity",
        status: Status = Status.NOT_FINITE,
    ) -> Solution:
        """The result of a solve that could not start."""
        return not_started(self.problem, self.w, self.psi, self.context, why, status)

    def arguments(self, guess: Guess) -> dict[str, Array]:
        """Those of `casadi.nlpsol` for `nonlinear_program`; a `Solution` as guess hands over its multipliers."""
        program = transcribe(self.problem)
        lower, upper = limits_from(self.problem, self.s0)
        p = np.concatenate([self.psi, self.context])
        given = {"x0": self.w, "p": p, "lbx": lower, "ubx": upper, "lbg": program.lower, "ubg": np.zeros(1)}
        if isinstance(guess, Solution):
            given["lam_x0"] = bound_multipliers(guess.multipliers)
            given["lam_g0"] = program.multipliers(guess.multipliers)
        return given

    def point(self, result: dict[str, ca.DM]) -> tuple[Trajectory, Multipliers]:
        """Trajectory and multipliers that `casadi.nlpsol` found with these arguments."""
        w, nu, lam = (dense(result[name]).ravel() for name in ("x", "lam_x", "lam_g"))
        multipliers = unpack_multipliers(self.problem, nu, *np.split(lam, [transcribe(self.problem).n_equalities]))
        return trajectory_of(self.problem, w, self.s0), multipliers

    def solution(
        self,
        point: tuple[Trajectory, Multipliers],
        tolerance: float,
        judge: Callable[[float], Status],
        *,
        objective: float,
        iterations: int,
        message: str,
        barrier: float = 0.0,
    ) -> Solution:
        """The solution at a point, CONVERGED where the audit meets the tolerance.

        Where the multipliers alone are to blame that it does not, estimates take their place.
        judge: the status where it does not, of `KKTResiduals.worst`.
        """
        trajectory, multipliers = point
        residuals = audit(self.problem, self.psi, self.context, trajectory, multipliers, barrier)
        if barrier == 0 and residuals.feasibility <= tolerance < residuals.worst:
            multipliers, residuals = self._estimated(trajectory, tolerance) or (multipliers, residuals)
        found = Solution(
            trajectory=trajectory,
            multipliers=multipliers,
            objective=objective,
            residuals=residuals,
            status=Status.CONVERGED if residuals.worst <= tolerance else judge(residuals.worst),
            iterations=iterations,
            psi=self.psi,
            context=self.context,
            barrier=barrier,
            message=message,
        )
        return explained(self.problem, found)

    def _estimated(self, trajectory: Trajectory, tolerance: float) -> tuple[Multipliers, KKTResiduals] | None:
        """Estimated multipliers and their residuals, if these meet the tolerance."""
        at = self.problem, self.psi, self.context, trajectory
        multipliers = estimate_multipliers(*at)
        if multipliers is None:
            return None
        residuals = audit(*at, multipliers)
        return (multipliers, residuals) if residuals.worst <= tolerance else None


def nonlinear_program(problem: OCP) -> dict[str, ca.MX]:
    """The program of `transcribe` by the names of `casadi.nlpsol`; p is (psi, c)."""
    program = transcribe(problem)
    w, *numbers = program.symbols
    return {"x": w, "p": ca.vertcat(*numbers), "f": program.values(*program.symbols)[0], "g": program.rows}
