"""A step along the dynamics themselves, not their linearisation, with the feedback of the Riccati recursion.

    u_t' = u_t + alpha du_t + K_t (s_t' - s_t - alpha ds_t),    s_{t+1}' = f(s_t', u_t') - (1 - alpha) d_t

Defects d shrink by exactly 1 - alpha, and once they are zero every iterate is a rollout: differential dynamic
programming from a feasible guess, multiple shooting from another one (Mastalli et al., Crocoddyl, 2020). Where the
linearisation holds only nearby, as it does for learned dynamics with large costates, much longer steps are accepted.
"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca

from kpirl_ocp.ocp.conditions.stage_derivatives import dynamics_alone, psi_by_stage
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.trajectory_cost import TrajectoryCost


@lru_cache(maxsize=64)
def follow(problem: OCP) -> ca.Function:
    """(S, U, dS, dU, K, d, alpha, psi, c) -> S' (n_s, T+1), U' (n_u, T), J and path constraints (n_h, T) there.

    K (n_u, n_s T) are the gains and d (n_s, T) the defects of `kpirl_ocp.ocp.interior_point.newton_step.newton_step`.
    """
    steps, n_s, n_u = problem.horizon, problem.n_states, problem.n_actions
    S, dS = ca.MX.sym("S", n_s, steps + 1), ca.MX.sym("dS", n_s, steps + 1)
    U, dU = ca.MX.sym("U", n_u, steps), ca.MX.sym("dU", n_u, steps)
    K, d = ca.MX.sym("K", n_u, n_s * steps), ca.MX.sym("d", n_s, steps)
    alpha, psi, context = ca.MX.sym("alpha"), ca.MX.sym("psi", problem.n_parameters), ca.MX.sym("c", problem.n_context)
    target = S + alpha * dS
    after, actions = _stage(problem).mapaccum(steps)(
        target[:, 0], target[:, :steps], U + alpha * dU, K, (1 - alpha) * d, psi_by_stage(problem, psi)
    )
    states = ca.horzcat(target[:, 0], after)
    cost = TrajectoryCost(problem, 1)
    value, *_ = cost.first(states, actions, cost.coefficients(psi, context))
    outputs = [ca.densify(x) for x in (states, actions, value, problem.path(states, actions, psi, context))]
    return ca.Function("follow", [S, U, dS, dU, K, d, alpha, psi, context], outputs)


def _stage(problem: OCP) -> ca.Function:
    """(s, target, u, K, d, psi) -> f(s, u') - d and u' = u + K (s - target)."""
    n_s, n_u = problem.n_states, problem.n_actions
    s, target, d = (ca.MX.sym(name, n_s) for name in ("s", "target", "d"))
    dynamics = dynamics_alone(problem)
    u, K, psi = ca.MX.sym("u", n_u), ca.MX.sym("K", n_u, n_s), ca.MX.sym("psi", dynamics.size1_in(2))
    action = u + K @ (s - target)
    return ca.Function("follow_stage", [s, target, u, K, d, psi], [dynamics(s, action, psi) - d, action])
