"""Ipopt on the multiple-shooting program, with derivatives assembled from this package's stage functions and compiled.

The same program as `kpirl_ocp.Ipopt` has, w = (s_1 .. s_T, u_0 .. u_{T-1}), without path constraints.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.codegen.compiler import compiled
from kpirl_ocp.ocp.conditions.stage_derivatives import dynamics_jacobian, dynamics_second
from kpirl_ocp.ocp.problem.layout import limits, pack, unpack
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Trajectory


class StageIpopt:
    """The program of one problem, ready to be solved."""

    def __init__(self, problem: OCP, tolerance: float) -> None:
        self._problem = problem
        program, derivatives = _functions(problem)
        options = {
            "tol": tolerance,
            "acceptable_iter": 0,
            "nlp_scaling_method": "none",
            "bound_relax_factor": 0.0,
            "print_level": 0,
            "sb": "yes",
        }
        quiet = {"print_time": False, "show_eval_warnings": False}
        self._solver = ca.nlpsol("ipopt", "ipopt", program, {**derivatives, **quiet, "ipopt": options})

    def solve(self, s0: Array, psi: Array, context: Array) -> tuple[float, Trajectory, int, str]:
        """Objective, trajectory, iterations and Ipopt's word."""
        problem, n_s = self._problem, self._problem.n_states
        guess = problem.simulate(s0, np.zeros((problem.horizon, problem.n_actions)), psi)
        lower, upper = (bound[n_s:] for bound in limits(problem))
        p = np.concatenate([s0, psi, context])
        result = self._solver(x0=pack(guess)[n_s:], p=p, lbx=lower, ubx=upper, lbg=0.0, ubg=0.0)
        stats = self._solver.stats()
        trajectory = unpack(problem, np.concatenate([s0, np.array(result["x"]).ravel()]))
        return float(result["f"]), trajectory, int(stats["iter_count"]), str(stats["return_status"])


def _functions(problem: OCP) -> tuple[dict[str, ca.MX], dict[str, ca.Function]]:
    """The program, and its compiled derivatives under the names of CasADi's options."""
    steps, n_s, n_u = problem.horizon, problem.n_states, problem.n_actions
    psi, context = problem.symbols()[2:]
    s0, w = ca.MX.sym("s0", n_s), ca.MX.sym("w", steps * (n_s + n_u))
    p = ca.vertcat(s0, psi, context)
    states = ca.horzcat(s0, ca.reshape(w[: steps * n_s], n_s, steps))
    actions = ca.reshape(w[steps * n_s :], n_u, steps)
    weight, costates = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", steps * n_s)

    before, wide = states[:, :steps], ca.repmat(psi, 1, steps)
    defects = ca.vec(problem.transition.map(steps)(before, actions, wide) - states[:, 1:])
    by_state, by_action = dynamics_jacobian(problem).map(steps)(before, actions, wide)
    *_, curvature = dynamics_second(problem).map(steps)(before, actions, wide, ca.reshape(costates, n_s, steps))
    cost = problem.cost(states, actions, psi, context)
    hessian = ca.triu(weight * ca.hessian(cost, w)[0] + _curvature(problem, curvature))
    functions = {
        "grad_f": ([w, p], [cost, ca.gradient(cost, w)]),
        "jac_g": ([w, p], [defects, _jacobian(problem, by_state, by_action)]),
        "hess_lag": ([w, p, weight, costates], [hessian]),
    }
    built = {name: compiled(ca.Function(name, *ends)) for name, ends in functions.items()}
    return {"x": w, "p": p, "f": cost, "g": defects}, built


def _jacobian(problem: OCP, by_state: ca.MX, by_action: ca.MX) -> ca.MX:
    """Of f(s_t, u_t) - s_{t+1} with respect to w."""
    n_s, steps = problem.n_states, problem.horizon
    blocks = ca.horzsplit(by_state, n_s)[1:]  # s_0 is given
    shifted = ca.vertcat(ca.MX(n_s, n_s * steps), ca.horzcat(ca.diagcat(*blocks), ca.MX(n_s * (steps - 1), n_s)))
    first = shifted if blocks else ca.MX(n_s, n_s)
    return ca.horzcat(first - ca.MX.eye(n_s * steps), ca.diagcat(*ca.horzsplit(by_action, problem.n_actions)))


def _curvature(problem: OCP, hessians: ca.MX) -> ca.MX:
    """Of lambda . f with respect to w."""
    n_s, n_u = problem.n_states, problem.n_actions
    stages = ca.horzsplit(hessians, n_s + n_u)
    last = ca.MX(n_s, n_s)
    by_states = ca.diagcat(*(stage[:n_s, :n_s] for stage in stages[1:]), last)
    across = ca.diagcat(*(stage[:n_s, n_s:] for stage in stages[1:]))  # s_t with u_t, t >= 1
    n_first = n_s * (problem.horizon - 1)
    mixed = ca.vertcat(ca.horzcat(ca.MX(n_first, n_u), across), ca.MX(n_s, n_u * problem.horizon))
    by_actions = ca.diagcat(*(stage[n_s:, n_s:] for stage in stages))
    return ca.vertcat(ca.horzcat(by_states, mixed), ca.horzcat(mixed.T, by_actions))
