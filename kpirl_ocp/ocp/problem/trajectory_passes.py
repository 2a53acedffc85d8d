"""Passes along trajectories: the rollout, its tangent, and the adjoint with its own tangent.

    rollout          s_{t+1} = f(s_t, u_t)
    tangent          ds_{t+1} = f_s ds_t + f_u du_t,                            ds_0 = 0
    adjoint          lambda_t = q_t + f_s^T lambda_{t+1},                       lambda_T = q_T
    adjoint tangent  mu_t = q_t + f_s^T mu_{t+1} + (lambda_{t+1} . f)_sx dx_t,  mu_T = q_T

With q the derivatives of a cost along the trajectory, r_t + f_u^T lambda_{t+1} is its gradient in the actions. B
trajectories run side by side: the columns of an array (n, T B) are ordered by time, then by trajectory.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple, Protocol

import casadi as ca

from kpirl_ocp.ocp.problem.columns import scan, sum_blocks
from kpirl_ocp.ocp.problem.statement.expressions import inputs_of

Memory = tuple[ca.MX, ...]
"""Arrays (n, T B) that one pass keeps for a later one."""


class Rollout(NamedTuple):
    """States (n_s, (T+1) B), actions (n_u, T B), and further arrays that the other passes need.

    extremes: (n, B) minus the largest absolute values of each state and action, then the smallest of each number at
        whose zero the dynamics have a kink; None where `clearance` is not known.
    curvatures: arrays that only the adjoint needs.
    """

    states: ca.MX
    actions: ca.MX
    memory: Memory
    extremes: ca.MX | None = None
    curvatures: Memory = ()


class Tangent(NamedTuple):
    """Changes dS (n_s, (T+1) B) of the states, and the arrays that the adjoint's tangent needs of them."""

    states: ca.MX
    memory: Memory


class Adjoint(NamedTuple):
    """Costates lambda_1 .. lambda_T (n_s, T B), f_u^T lambda (n_u, T B) and sum_t f_psi^T lambda (n_psi, B).

    memory: the arrays that the adjoint's tangent needs of the costates.
    """

    costates: ca.MX
    by_actions: ca.MX
    by_parameters: ca.MX
    memory: Memory


class TrajectoryPasses(Protocol):
    """The four passes as expressions; psi is (n_psi, B)."""

    def rollout(self, s0: ca.MX, actions: ca.MX, psi: ca.MX) -> Rollout:
        """The rollout from s0 (n_s, B) with actions (n_u, T B)."""
        ...

    def tangent(self, at: Rollout, psi: ca.MX, dU: ca.MX) -> Tangent:
        """dS for dU (n_u, T B)."""
        ...

    def adjoint(self, at: Rollout, psi: ca.MX, Q: ca.MX) -> Adjoint:
        """The adjoint for q_0 .. q_T, given as Q (n_s, (T+1) B)."""
        ...

    def adjoint_tangent(self, at: Rollout, psi: ca.MX, memory: Memory, dS: Tangent, dU: ca.MX, Q: ca.MX) -> Adjoint:
        """The change of `adjoint` along (dS, dU), when its q changes by Q; `memory` is that of `adjoint`."""
        ...

    def clearance(self, moves: ca.MX, nearest: ca.MX) -> ca.MX:
        """The share (1, B) of moves (n_s + n_u, B) of states and actions that leaves the derivatives as they are.

        That is, up to a thousandth of the terms of the Jacobians, and without a kink; 0 where it is not known.
        `nearest` (n, B) says how near to zero the numbers come at whose zeros the dynamics have kinks.
        """
        ...


@dataclass(frozen=True, eq=False)
class StagePasses:
    """The passes of any dynamics f(s, u, psi), stage by stage with CasADi's AD; see `TrajectoryPasses`."""

    dynamics: ca.Function
    horizon: int
    columns: int

    def rollout(self, s0: ca.MX, actions: ca.MX, psi: ca.MX) -> Rollout:
        """States from s0 (n_s, B)."""
        (states,) = self._scan(self.dynamics, s0, actions, psi)
        return Rollout(ca.horzcat(s0, states), actions, ())

    def tangent(self, at: Rollout, psi: ca.MX, dU: ca.MX) -> Tangent:
        """Changes of the states; s_0 does not change."""
        zero = ca.MX.zeros(self.dynamics.size1_in(0), self.columns)
        return Tangent(ca.horzcat(zero, *self._scan(self._tangent, zero, *_stages(at), psi, dU)), ())

    def adjoint(self, at: Rollout, psi: ca.MX, Q: ca.MX) -> Adjoint:
        """Costates for the slopes Q."""
        return self._backwards(self._adjoint, Q, *_stages(at), psi)

    def adjoint_tangent(self, at: Rollout, psi: ca.MX, memory: Memory, dS: Tangent, dU: ca.MX, Q: ca.MX) -> Adjoint:
        """Changes of the costates along (dS, dU)."""
        direction = dS.states[:, : dU.size2()], dU
        return self._backwards(self._adjoint_tangent, Q, *_stages(at), psi, *memory, *direction)

    def clearance(self, moves: ca.MX, nearest: ca.MX) -> ca.MX:
        """No bound is known."""
        return ca.MX.zeros(1, self.columns)

    def _scan(self, stage: ca.Function, start: ca.MX, *inputs: ca.MX, backwards: bool = False) -> list[ca.MX]:
        return scan(stage.map(self.columns), start, inputs, self.horizon, backwards)

    def _backwards(self, stage: ca.Function, Q: ca.MX, *inputs: ca.MX) -> Adjoint:
        """Accumulate a stage (lambda, q, ...) -> lambda, f_u^T lambda, f_psi^T lambda from the last to the first."""
        B = self.columns
        before, by_actions, by_parameters = self._scan(stage, Q[:, -B:], Q[:, :-B], *inputs, backwards=True)
        costates = ca.horzcat(before[:, B:], Q[:, -B:])
        return Adjoint(costates, by_actions, sum_blocks(by_parameters, B), memory=(costates,))

    @cached_property
    def _symbols(self) -> tuple[ca.MX, ...]:
        """Symbols s, u, psi, lambda, ds, du, mu and q."""
        s, u, psi = (self.dynamics.size1_in(i) for i in range(3))
        sizes = {"s": s, "u": u, "psi": psi, "lam": s, "ds": s, "du": u, "mu": s, "q": s}
        return tuple(ca.MX.sym(name, size) for name, size in sizes.items())

    @cached_property
    def _tangent(self) -> ca.Function:
        s, u, psi, _, ds, du, *_ = self._symbols
        return ca.Function("tangent", [ds, s, u, psi, du], [_jvp(self.dynamics)(s, u, psi, ds, du)])

    @cached_property
    def _adjoint(self) -> ca.Function:
        s, u, psi, lam, _, _, _, q = self._symbols
        by_s, by_u, by_psi = _vjp(self.dynamics)(s, u, psi, lam)
        return ca.Function("adjoint", [lam, q, s, u, psi], [q + by_s, by_u, by_psi])

    @cached_property
    def _adjoint_tangent(self) -> ca.Function:
        s, u, psi, lam, ds, du, mu, q = self._symbols
        Ft_lambda = ca.vertcat(*_vjp(self.dynamics)(s, u, psi, lam))
        change = ca.jtimes(Ft_lambda, ca.vertcat(s, u, lam), ca.vertcat(ds, du, mu))
        by_s, by_u, by_psi = ca.vertsplit(change, [0, s.numel(), s.numel() + u.numel(), change.numel()])
        return ca.Function("adjoint_tangent", [mu, q, s, u, psi, lam, ds, du], [q + by_s, by_u, by_psi])


def _stages(at: Rollout) -> tuple[ca.MX, ca.MX]:
    """States and actions of the stages t = 0 .. T-1."""
    return at.states[:, : at.actions.size2()], at.actions


@lru_cache(maxsize=64)
def _jvp(dynamics: ca.Function) -> ca.Function:
    """(s, u, psi, ds, du) -> f_s ds + f_u du (n_s,)."""
    s, u, psi = inputs_of(dynamics)
    ds, du = type(s).sym("ds", s.numel()), type(s).sym("du", u.numel())
    value = dynamics(s, u, psi)
    return ca.Function("jvp", [s, u, psi, ds, du], [ca.jtimes(value, s, ds) + ca.jtimes(value, u, du)])


@lru_cache(maxsize=64)
def _vjp(dynamics: ca.Function) -> ca.Function:
    """(s, u, psi, lambda) -> f_s^T lambda (n_s,), f_u^T lambda (n_u,), f_psi^T lambda (n_psi,)."""
    s, u, psi = inputs_of(dynamics)
    lam = type(s).sym("lam", s.numel())
    pairing = ca.dot(lam, dynamics(s, u, psi))
    return ca.Function("vjp", [s, u, psi, lam], [ca.gradient(pairing, x) for x in (s, u, psi)])
