"""The passes of `kpirl_ocp.ocp.problem.trajectory_passes` for keypoint dynamics with a network.

The joints do not depend on the keypoints: theta_t is a running sum of the actions and theta_dot is constant. So their
share of the first layer is known for all times before z is, and

    a_1 = W_z z_t + e_t,    e_t = W_theta theta_t + W_u u_t + (W_v theta_dot + b_1)

leaves only W_z in the recursion over time; for few trajectories the rest is one matrix product for all times, and the
same holds for the tangent and, transposed, for the adjoints. For many it stays within the stage, whose products are
wide enough, and no array (n_1, T B) is moved. The rollout keeps the slopes of the activations; what is multiplied in
the adjoint's tangent, sigma'' times the adjoint and da_l, is kept by adjoint and tangent, so that each pass takes one
product with every weight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.ocp.models.mlp import (
    MLP,
    clearance,
    condensed,
    expanded,
    flatten_slopes,
    has_curvature,
    jvp,
    kinked,
    unflatten_slopes,
    vjp,
    vjp_tangent,
)
from kpirl_ocp.ocp.problem.columns import largest_block, scan, symbols_like
from kpirl_ocp.ocp.problem.trajectory_passes import Adjoint, Memory, Rollout, Tangent
from kpirl_ocp.types import Array


@dataclass(frozen=True, eq=False)
class NetworkPasses:
    """The passes over T steps for B trajectories; see `kpirl_ocp.ocp.problem.trajectory_passes.TrajectoryPasses`."""

    dynamics: NetworkDynamics
    horizon: int
    columns: int

    def rollout(self, s0: ca.MX, actions: ca.MX, psi: ca.MX) -> Rollout:
        """States from s0 (n_s, B): the joints of all times first."""
        z0, theta0, velocity = self._parts(s0)
        theta = self._sum(theta0, actions)
        constant = ca.mac(ca.DM(self._by_velocity), velocity, ca.repmat(ca.DM(self._mlp.biases[0]), 1, self.columns))
        inputs, far = self._drive_inputs(theta, actions, constant), [ca.MX(ca.DM.inf(*x.shape)) for x in self._nearest]
        z, *kept = scan(self._forward, z0, inputs, self.horizon, running=far)
        states = _stack(ca.horzcat(z0, z), theta, ca.repmat(velocity, 1, self.horizon + 1))
        first, all_slopes = len(self._first), len(self._slopes)
        least = [*(-largest_block(x, self.columns) for x in (states, actions)), *kept[all_slopes:]]
        return Rollout(states, actions, tuple(kept[:first]), _stack(*least), tuple(kept[first:all_slopes]))

    def clearance(self, moves: ca.MX, nearest: ca.MX) -> ca.MX:
        """That of the network, whose inputs are s and u."""
        return clearance(self.dynamics.mlp, moves, nearest)

    def tangent(self, at: Rollout, psi: ca.MX, dU: ca.MX) -> Tangent:
        """Changes of the states; s_0 does not change."""
        zero = ca.MX.zeros(self.dynamics.n_z, self.columns)
        dtheta = self._sum(ca.MX.zeros(self.dynamics.n_joints, self.columns), dU)
        after, *memory = scan(self._tangent, zero, [*at.memory, *self._drive_inputs(dtheta, dU)], self.horizon)
        return Tangent(_stack(ca.horzcat(zero, after), dtheta, ca.MX.zeros(dtheta.shape)), tuple(memory))

    def adjoint(self, at: Rollout, psi: ca.MX, Q: ca.MX) -> Adjoint:
        """Costates for the slopes Q."""
        return self._backwards(self._adjoint, psi, Q, *at.memory, *at.curvatures)

    def adjoint_tangent(self, at: Rollout, psi: ca.MX, memory: Memory, dS: Tangent, dU: ca.MX, Q: ca.MX) -> Adjoint:
        """Changes of the costates along (dS, dU)."""
        return self._backwards(self._adjoint_tangent, psi, Q, *at.memory, *memory, *dS.memory)

    def _backwards(self, stage: ca.Function, psi: ca.MX, Q: ca.MX, *inputs: ca.MX) -> Adjoint:
        """Accumulate a stage (lambda_z, q_z, ...) -> lambda_z, adjoint of a_1, memory; then sum up for the joints."""
        B, n_q = self.columns, self.dynamics.n_joints
        by_z, by_theta, by_velocity = self._parts(Q)
        before, *found = scan(stage, by_z[:, -B:], [by_z[:, :-B], *inputs], self.horizon, backwards=True)
        costates = ca.horzcat(before[:, B:], by_z[:, -B:])
        share, inner = found[:2] if self._wide else self._shares(found[0])
        theta = self._sum_back(by_theta, share[:n_q, :])
        velocity = self._sum_back(by_velocity, ca.DM(self._by_velocity.T) @ inner)
        return Adjoint(
            costates=_stack(costates, theta, velocity),
            by_actions=theta + share[n_q:, :],
            by_parameters=ca.MX.zeros(psi.shape),
            memory=tuple(found[2 if self._wide else 1 :]),
        )

    def _drive_inputs(self, theta: ca.MX, actions: ca.MX, constant: ca.MX | None = None) -> list[ca.MX]:
        """Inputs of the stages t < T for e_t: the joints (theta_t, u_t) and the constant, or e_t itself."""
        joints = _stack(theta[:, : actions.size2()], actions)
        if self._wide:
            return [joints] if constant is None else [joints, constant]
        return [self._drive(joints, None if constant is None else ca.repmat(constant, 1, self.horizon))]

    def _drive_symbols(self, constant: bool = False) -> tuple[list[ca.MX], ca.MX]:
        """Symbols of those inputs of one stage, and e_t."""
        n_1, n_joints = self._by_joints.shape
        if not self._wide:
            drive = self._symbol("e", n_1)
            return [drive], drive
        symbols = [self._symbol("joints", n_joints), *([self._symbol("constant", n_1)] if constant else [])]
        return symbols, self._drive(*symbols)

    def _drive(self, joints: ca.MX, constant: ca.MX | None = None) -> ca.MX:
        """W_theta theta_t + W_u u_t + constant."""
        by_joints = ca.DM(self._by_joints)
        return by_joints @ joints if constant is None else ca.mac(by_joints, joints, constant)

    def _shares(self, inner: ca.MX) -> tuple[ca.MX, ca.MX]:
        """(W_theta, W_u)^T times the adjoint of a_1, and that adjoint."""
        return ca.DM(self._by_joints.T) @ inner, inner

    @property
    def _wide(self) -> bool:
        """True if the joints' share is left to the stage."""
        return self.columns >= _WIDE

    def _sum(self, start: ca.MX, actions: ca.MX) -> ca.MX:
        """theta_0 .. theta_T (n_q, (T+1) B), the running sum of the actions."""
        return ca.horzcat(start, *scan(_add(*start.shape), start, [actions], self.horizon))

    def _sum_back(self, q: ca.MX, share: ca.MX) -> ca.MX:
        """lambda_1 .. lambda_T of a row of the state that is an integrator: lambda_t = q_t + share_t + lambda_{t+1}."""
        B = self.columns
        if self.horizon == 1:
            return q[:, -B:]
        last, pushes = q[:, -B:], q[:, B:-B] + share[:, B:]
        return ca.horzcat(*scan(_add(*last.shape), last, [pushes], self.horizon - 1, backwards=True), last)

    def _parts(self, s: ca.MX) -> tuple[ca.MX, ca.MX, ca.MX]:
        """The rows z, theta and theta_dot."""
        n_z, n_q = self.dynamics.n_z, self.dynamics.n_joints
        return s[:n_z, :], s[n_z : n_z + n_q, :], s[n_z + n_q :, :]

    @cached_property
    def _mlp(self) -> MLP:
        """The network as a function of z alone."""
        mlp = self.dynamics.mlp
        return replace(mlp, weights=(mlp.weights[0][:, : self.dynamics.n_z], *mlp.weights[1:]))

    @cached_property
    def _by_joints(self) -> Array:
        """(W_theta, W_u)."""
        first, n_z, n_q = self.dynamics.mlp.weights[0], self.dynamics.n_z, self.dynamics.n_joints
        return np.hstack([first[:, n_z : n_z + n_q], first[:, n_z + 2 * n_q :]])

    @cached_property
    def _by_velocity(self) -> Array:
        """W_v."""
        n_z, n_q = self.dynamics.n_z, self.dynamics.n_joints
        return self.dynamics.mlp.weights[0][:, n_z + n_q : n_z + 2 * n_q]

    @cached_property
    def _curved(self) -> bool:
        return has_curvature(self._mlp.linearise(ca.MX.sym("z", self.dynamics.n_z))[1])

    @cached_property
    def _forward(self) -> ca.Function:
        """z, inputs for e_t, smallest arguments with kinks so far -> z_next, slopes, smallest ones with this stage."""
        z, (inputs, drive) = self._symbol("z"), self._drive_symbols(constant=True)
        y, slopes = self._mlp.linearise(z, drive)
        nearest = [ca.fmin(x, ca.fabs(a)) for x, a in zip(self._nearest, kinked(slopes), strict=True)]
        outputs = [self._residual(z) + y, *flatten_slopes(condensed(slopes)), *nearest]
        return ca.Function("forward", [z, *inputs, *self._nearest], outputs)

    @cached_property
    def _tangent(self) -> ca.Function:
        """dz, slopes, inputs for de_t -> dz_next, da_l."""
        dz, (inputs, drive) = self._symbol("dz"), self._drive_symbols()
        dy, tangents = jvp(self._mlp, unflatten_slopes(self._mlp, self._first), dz, drive)
        kept = tangents if self._curved else []
        return ca.Function("tangent", [dz, *self._first, *inputs], [self._residual(dz) + dy, *kept])

    @cached_property
    def _adjoint(self) -> ca.Function:
        """lambda_z, q_z, slopes -> lambda_z before, adjoint of a_1, sigma'' times the adjoints of h_l."""
        lam, q, slopes = self._symbol("lam"), self._symbol("q"), self._slopes
        by_z, inner, bent = vjp(self._mlp, expanded(self._mlp, unflatten_slopes(self._mlp, slopes)), lam)
        kept = flatten_slopes(bent)[len(self._first) :]
        return self._backward("adjoint", [lam, q, *slopes], q + self._residual(lam) + by_z, inner, kept)

    @cached_property
    def _adjoint_tangent(self) -> ca.Function:
        """mu_z, q_z, slopes, sigma'' times the adjoints of h_l, da_l -> mu_z before, tangent of the adjoint of a_1."""
        mu, q, bent = self._symbol("mu"), self._symbol("q"), self._slopes
        tangents = [self._symbol("da", len(bias)) for bias in self._mlp.biases]
        by_z, inner = vjp_tangent(self._mlp, unflatten_slopes(self._mlp, bent), tangents, mu)
        arguments = [mu, q, *bent, *(tangents if self._curved else [])]
        return self._backward("adjoint_tangent", arguments, q + self._residual(mu) + by_z, inner, [])

    def _backward(self, name: str, inputs: list[ca.MX], before: ca.MX, inner: ca.MX, kept: list[ca.MX]) -> ca.Function:
        return ca.Function(name, inputs, [before, *(self._shares(inner) if self._wide else [inner]), *kept])

    def _symbol(self, name: str, rows: int | None = None) -> ca.MX:
        return ca.MX.sym(name, self.dynamics.n_z if rows is None else rows, self.columns)

    @cached_property
    def _slopes(self) -> list[ca.MX]:
        """Symbols for the slopes, first derivatives first."""
        return symbols_like("slope", flatten_slopes(self._mlp.linearise(self._symbol("z"))[1]))

    @property
    def _first(self) -> list[ca.MX]:
        """Symbols for the memory of the rollout: first derivatives."""
        count = sum(slope.first is not None for slope in self._mlp.linearise(self._symbol("z"))[1])
        return self._slopes[:count]

    @cached_property
    def _nearest(self) -> list[ca.MX]:
        """Symbols for the smallest arguments with kinks."""
        return symbols_like("nearest", kinked(self._mlp.linearise(self._symbol("z"))[1]))

    def _residual(self, z: ca.MX) -> ca.MX | float:
        """z where the network predicts its change, else zero."""
        return z if self.dynamics.residual else 0.0


_WIDE = 4  # trajectories that fill the tiles of a matrix product by themselves


def _add(rows: int, columns: int) -> ca.Function:
    x, y = (ca.MX.sym(name, rows, columns) for name in "xy")
    return ca.Function("add", [x, y], [x + y])


def _stack(*parts: ca.MX) -> ca.MX:
    """`vertcat`, which transposes matrices three times, in one pass over each part."""
    ends = list(accumulate(part.size1() for part in parts))
    stacked = ca.MX(ca.DM.zeros(ends[-1], parts[0].size2()))
    for part, end in zip(parts, ends, strict=True):
        stacked[end - part.size1() : end, :] = part
    return stacked
