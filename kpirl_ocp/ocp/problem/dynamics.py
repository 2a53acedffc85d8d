"""First and second derivatives of the dynamics f(s, u, psi), as functions of their own.

Solvers ask for derivatives here and not from CasADi's AD, so that dynamics with a known structure (a network) can
bring derivatives arranged by hand. Everything else gets the same interface through AD.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca

if TYPE_CHECKING:
    from kpirl_ocp.ocp.conditions.stage_points import Points
    from kpirl_ocp.ocp.problem.trajectory_passes import Sweeps


@dataclass(frozen=True, eq=False)
class Staged:
    """A function of every stage, in two parts.

    prepare: T -> a function of T stages side by side, for what is better computed for all at once; any number of
        outputs with T columns.
    finish: (one column of each) -> the outputs at one stage.
    """

    prepare: Callable[[int], ca.Function]
    finish: ca.Function

    @classmethod
    def by_stage(cls, function: ca.Function) -> Staged:
        """With nothing prepared."""

        def prepare(steps: int) -> ca.Function:
            inputs = [ca.MX.sym("x", function.size1_in(i), steps) for i in range(function.n_in())]
            return ca.Function("prepare", inputs, inputs)

        return cls(prepare, function)


@dataclass(frozen=True, eq=False)
class DynamicsDerivatives:
    """What solvers need to know about f beside its value.

    jvp: (s, u, psi, ds, du) -> f_s ds + f_u du (n_s,).
    vjp: (s, u, psi, lam) -> f_s^T lam (n_s,), f_u^T lam (n_u,), f_psi^T lam (n_psi,).
    jacobian: (s, u, psi) -> f_s (n_s, n_s), f_u (n_s, n_u).
    hessian: (s, u, psi, lam) -> second derivative of lam . f with respect to (s, u), (n_s + n_u, n_s + n_u).
    first: T -> a function of T stages side by side, (s (n_s, T), u (n_u, T), psi (n_psi, T), lam (n_s, T)) -> f,
        f_s^T lam, f_u^T lam, with what they share computed once. psi is (0, T) where f does not depend on it.
    second: (s, u, psi, lam) -> f, (f_s, f_u) and `hessian`, likewise.
    sweeps: (T, B) -> the passes along B trajectories, where something better than stage by stage is known.
    points: (S, U, psi, Lambda) -> linearised at all points at once, likewise.
    """

    jvp: ca.Function
    vjp: ca.Function
    jacobian: ca.Function
    hessian: ca.Function
    first: Callable[[int], ca.Function]
    second: Staged
    sweeps: Callable[[int, int], Sweeps] | None = None
    points: Callable[[ca.MX, ca.MX, ca.MX, ca.MX], Points] | None = None

    @classmethod
    def by_ad(cls, dynamics: ca.Function) -> DynamicsDerivatives:
        """The derivatives of any f(s, u, psi) that CasADi can differentiate: of scalar graphs (SX) as scalar graphs."""
        kind = ca.SX if dynamics.is_a("SXFunction") else ca.MX
        s, u, psi = (kind.sym(name, dynamics.size1_in(i)) for i, name in enumerate(("s", "u", "psi")))
        ds, du, lam = kind.sym("ds", s.numel()), kind.sym("du", u.numel()), kind.sym("lam", s.numel())
        value = dynamics(s, u, psi)
        pairing = ca.dot(lam, value)
        slope = ca.vertcat(ca.gradient(pairing, s), ca.gradient(pairing, u))
        hessian = ca.cse(ca.horzcat(ca.jacobian(slope, s), ca.jacobian(slope, u)))
        by_s, by_u = ca.jacobian(value, s), ca.jacobian(value, u)
        together = ca.cse([value, ca.horzcat(by_s, by_u), hessian])
        moved = ca.jtimes(value, s, ds) + ca.jtimes(value, u, du)
        first = ca.Function("first", [s, u, psi, lam], ca.cse([value, *(ca.gradient(pairing, x) for x in (s, u))]))
        second = ca.Function("second", [s, u, psi, lam], together)
        if not depends_on_psi(dynamics):
            first, second = without_psi(first), without_psi(second)
        return cls(
            jvp=ca.Function("jvp", [s, u, psi, ds, du], [moved]),
            vjp=ca.Function("vjp", [s, u, psi, lam], [ca.gradient(pairing, x) for x in (s, u, psi)]),
            jacobian=ca.Function("jacobian", [s, u, psi], [by_s, by_u]),
            hessian=ca.Function("hessian", [s, u, psi, lam], [hessian]),
            first=first.map,
            second=Staged.by_stage(second),
        )


def depends_on_psi(dynamics: ca.Function) -> bool:
    """Does f(s, u, psi)?"""
    return bool(dynamics.jac_sparsity(0, 2).nnz())


def without_psi(function: ca.Function) -> ca.Function:
    """A function (s, u, psi, ..) of dynamics that do not depend on psi, with an empty psi.

    To repeat psi for every stage takes O(T^2) memory where psi has numbers for every step.
    """
    s, u, psi, *others = function.mx_in()
    outputs = function.call([s, u, ca.MX.zeros(psi.shape), *others], True, False)
    return ca.Function(function.name(), [s, u, ca.MX.sym("psi", 0), *others], outputs)
