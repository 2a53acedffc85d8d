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
    from kpirl_ocp.ocp.sweeps import Sweeps


@dataclass(frozen=True, eq=False)
class DynamicsDerivatives:
    """What solvers need to know about f beside its value.

    jvp: (s, u, psi, ds, du) -> f_s ds + f_u du (n_s,).
    vjp: (s, u, psi, lam) -> f_s^T lam (n_s,), f_u^T lam (n_u,), f_psi^T lam (n_psi,).
    jacobian: (s, u, psi) -> f_s (n_s, n_s), f_u (n_s, n_u).
    hessian: (s, u, psi, lam) -> second derivative of lam . f with respect to (s, u), (n_s + n_u, n_s + n_u).
    sweeps: (T, B) -> the passes along B trajectories, where something better than stage by stage is known.
    """

    jvp: ca.Function
    vjp: ca.Function
    jacobian: ca.Function
    hessian: ca.Function
    sweeps: Callable[[int, int], Sweeps] | None = None

    @classmethod
    def by_ad(cls, dynamics: ca.Function) -> DynamicsDerivatives:
        """The derivatives of any f(s, u, psi) that CasADi can differentiate."""
        s, u, psi = (ca.MX.sym(name, dynamics.size1_in(i)) for i, name in enumerate(("s", "u", "psi")))
        ds, du = ca.MX.sym("ds", s.numel()), ca.MX.sym("du", u.numel())
        value, both = dynamics(s, u, psi), ca.vertcat(s, u)
        lam = ca.MX.sym("lam", s.numel())
        pairing = ca.dot(lam, value)
        return cls(
            jvp=ca.Function("jvp", [s, u, psi, ds, du], [ca.jtimes(value, both, ca.vertcat(ds, du))]),
            vjp=ca.Function("vjp", [s, u, psi, lam], [ca.gradient(pairing, x) for x in (s, u, psi)]),
            jacobian=ca.Function("jacobian", [s, u, psi], [ca.jacobian(value, s), ca.jacobian(value, u)]),
            hessian=ca.Function("hessian", [s, u, psi, lam], [ca.hessian(pairing, both)[0]]),
        )
