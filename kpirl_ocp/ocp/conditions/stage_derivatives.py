"""Derivatives of the dynamics, stage by stage, from `OCP.dynamics_derivatives`."""

from __future__ import annotations

from functools import lru_cache
from typing import TypeAlias

import casadi as ca

from kpirl_ocp.ocp.problem.linearised_dynamics import depends_on_psi
from kpirl_ocp.ocp.problem.ocp import OCP

Symbol: TypeAlias = "ca.SX | ca.MX"


@lru_cache(maxsize=64)
def dynamics_second(problem: OCP) -> ca.Function:
    """(s, u, p, lambda) of one stage -> f_s (n_s, n_s), f_u (n_s, n_u), (lambda . f)'' (n_x, n_x).

    p: the parameters of `OCP.transition`; psi alone where the dynamics use neither the context nor the schedule.
    """
    n_s, n_p = problem.n_states, problem.transition.size1_in(2)
    sizes = {"s": n_s, "u": problem.n_actions, "p": n_p, "lambda": n_s}
    s, u, p, costate = at = [ca.MX.sym(name, size) for name, size in sizes.items()]
    given = p if depends_on_psi(problem.transition) else ca.MX(0, 1)
    function, arguments = problem.dynamics_derivatives.linearise(s, u, given, costate).second()
    _, F, H = function.call(arguments, True, False)
    return ca.Function("dynamics_second", at, [F[:, :n_s], F[:, n_s:], H])


@lru_cache(maxsize=64)
def dynamics_jacobian(problem: OCP) -> ca.Function:
    """(s, u, p) of one stage -> f_s (n_s, n_s), f_u (n_s, n_u)."""
    *at, costate = dynamics_second(problem).mx_in()
    by_s, by_u, _ = dynamics_second(problem).call([*at, ca.MX.zeros(costate.shape)], True, False)
    return ca.Function("dynamics_jacobian", at, [by_s, by_u])


def psi_by_stage(problem: OCP, psi: ca.MX) -> ca.MX:
    """psi repeated for every stage, (n_psi, T); (0, T) if the dynamics do not depend on it."""
    return ca.repmat(psi, 1, problem.horizon) if depends_on_psi(problem.transition) else ca.MX(0, problem.horizon)
