"""The derivative of a solution with respect to psi, the initial state s_0 and the context c.

    at = sensitivity(problem, solution)
    at.pull(by_states, by_actions)     dL/dpsi, dL/ds_0, dL/dc  of any function L(S, U) with these slopes
    at.push(psi=dpsi)                  dS, dU                   when psi, s_0 and c move

Both are products with dv/dp of `implicit_function`. Each takes one linear solve, however many parameters there are, and
comes with its certificate.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.ocp.interior_point.core import Core
from kpirl_ocp.ocp.interior_point.cores import borrow_core
from kpirl_ocp.ocp.problem.layout import split
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import StageDerivatives
from kpirl_ocp.ocp.sensitivity.certificate import (
    Policy,
    SensitivityCertificate,
    check_policy,
    judged,
)
from kpirl_ocp.ocp.sensitivity.evidence import measure
from kpirl_ocp.ocp.sensitivity.factorisation import Factorisation
from kpirl_ocp.ocp.sensitivity.implicit_function import ByParameters, ImplicitFunction
from kpirl_ocp.ocp.sensitivity.kkt_system import Instance, KKTSystem, Memory
from kpirl_ocp.ocp.sensitivity.solution_arrays import arrays_of, as_row
from kpirl_ocp.pictures import Brief
from kpirl_ocp.types import Array, Solution


@dataclass(frozen=True, repr=False)
class Gradients(Brief):
    """Gradients of a function of the planned trajectory: psi (n_psi,), s0 (n_s,), context (n_c,)."""

    psi: Array
    s0: Array
    context: Array
    certificate: SensitivityCertificate

    @classmethod
    def undefined(cls, problem: OCP, certificate: SensitivityCertificate) -> Gradients:
        """All NaN: there is no gradient."""
        psi, s0, context = (
            np.full(size, np.nan) for size in (problem.n_parameters, problem.n_states, problem.n_context)
        )
        return cls(psi, s0, context, certificate)


@dataclass(frozen=True, repr=False)
class Tangent(Brief):
    """The change of a planned trajectory: states (T+1, n_s), actions (T, n_u)."""

    states: Array
    actions: Array
    certificate: SensitivityCertificate


def sensitivity(
    problem: OCP, solution: Solution, policy: Policy = "raise", derivatives: StageDerivatives | None = None
) -> Sensitivity:
    """Linearise the KKT conditions at a solution that any solver found for this problem.

    A solution of the problem smoothed with a barrier has the derivative of that problem.

    Args:
        problem: the problem that was solved.
        solution: its solution; psi, context and s_0 = states[0] are those that it was solved for.
        policy: what to do with a derivative that is not certified: "raise" CertificateError, or "flag" it in its
            certificate.
        derivatives: at the solution, where the solver ended with them (`solve_and_linearise`).

    Raises:
        ProblemError: shapes that do not fit the problem, or another policy.
    """
    return Sensitivity(problem, solution, policy, derivatives)


class Sensitivity:
    """Products with the derivative of a solution, each with its certificate; see `sensitivity`."""

    def __init__(
        self, problem: OCP, solution: Solution, policy: Policy, derivatives: StageDerivatives | None = None
    ) -> None:
        check_policy(policy, ("raise", "flag"))
        self.problem, self.solution, self.policy = problem, solution, policy
        self._row = as_row(arrays_of(problem, solution))
        self._instance, self._derivatives = Instance.of(problem, solution), derivatives

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.solution!r}, policy={self.policy!r})"

    def pull(self, by_states: ArrayLike, by_actions: ArrayLike) -> Gradients:
        """Gradients of a function L of the trajectory.

        Args:
            by_states: dL/dS (T+1, n_s); row 0 is the derivative by s_0 with the other states fixed.
            by_actions: dL/dU (T, n_u).

        Raises:
            CertificateError: under the policy "raise", when the gradients are not certified.
            ProblemError: shapes that do not fit.
        """
        slopes = self.problem.as_states(by_states), self.problem.as_actions(by_actions)
        with borrow_core(self.problem) as core:
            return self._pull(core, self._linearised(core), b"".join(slopes))  # type: ignore[arg-type]

    @property
    def plan(self) -> Array:
        """(n_w,) the plan that is differentiated, in the order of time: the solution after Newton steps, if any."""
        with borrow_core(self.problem) as core:
            return self._linearised(core).system.x

    def pull_and_move(self, slopes: Array) -> tuple[Gradients, Array]:
        """`pull` of slopes (n_w,) by S, then by U, and `KKTSystem.parameter_tangent` (n_w,)."""
        with borrow_core(self.problem) as core:
            at = self._linearised(core)
            found = self._pull(core, at, slopes.tobytes())
            return found, at.system.parameter_tangent

    def _pull(self, core: Core, at: Workspace, slopes: bytes) -> Gradients:
        if at.system.finite:
            (psi, s0, context), evidence, finite = measure(core, at.system, at.nearby, slopes)
            if finite:
                return Gradients(psi, s0, context, self._certificate(at, evidence))
        return Gradients.undefined(self.problem, self._certificate(at, None))

    def push(
        self, psi: ArrayLike | None = None, s0: ArrayLike | None = None, context: ArrayLike | None = None
    ) -> Tangent:
        """The change of the trajectory when psi, s_0 and the context change; those left out stay the same.

        Args:
            psi: dpsi (n_psi,).
            s0: ds_0 (n_s,).
            context: dc (n_c,).

        Raises:
            CertificateError: under the policy "raise", when the tangent is not certified.
            ProblemError: shapes that do not fit.
        """
        given = zip((psi, s0, context), self._sizes, strict=True)
        dpsi, ds0, dcontext = (np.zeros(size) if move is None else move for move, size in given)
        ds0, dpsi, dcontext = self.problem.inputs(ds0, dpsi, dcontext)
        with borrow_core(self.problem) as core:
            at = self._linearised(core)
            if not at.system.finite:
                states, actions = (np.full_like(part, np.nan) for part in (self.solution.states, self.solution.actions))
                return Tangent(states, actions, self._certificate(at, None))
            at.system.renew(core)
            function = ImplicitFunction(at.system, Factorisation(at.system))
            change, residual = function.push(ByParameters(dpsi, ds0, dcontext))
            plan = split(change.x, self.problem.horizon, self.problem.n_states, self.problem.n_actions)
            _, evidence, _ = measure(core, at.system, at.nearby, b"".join(plan), change.x)  # type: ignore[arg-type]
            return Tangent(*plan, self._certificate(at, evidence | {"linear_residual": residual}))

    @property
    def _sizes(self) -> tuple[int, int, int]:
        """Lengths of psi, s_0 and the context."""
        return self.problem.n_parameters, self.problem.n_states, self.problem.n_context

    def _linearised(self, core: Core) -> Workspace:
        """The workspace of a core, holding the KKT system of this solution."""
        at = core.kept(Workspace)
        if at.owner() is not self:
            at.system = KKTSystem(self._instance, at.here)
            at.system.linearise_at(self._row, core, self._derivatives)
            at.owner = weakref.ref(self)
        return at

    def _certificate(self, at: Workspace, evidence: Mapping[str, float] | None) -> SensitivityCertificate:
        return judged(self.policy, self.problem, self.solution, at.system.active, evidence)


class Workspace:
    """Memory for the KKT system at a solution of a problem, and for a second one nearby.

    owner: returns the `Sensitivity` whose KKT system it holds, or None.
    """

    system: KKTSystem

    def __init__(self, problem: OCP) -> None:
        self.here, self.nearby = Memory(problem), Memory(problem)
        self.release()

    def release(self) -> None:
        """Forget whose KKT system it holds."""
        self.owner: Callable[[], Sensitivity | None] = lambda: None
