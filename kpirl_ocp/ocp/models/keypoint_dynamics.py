"""Learned keypoint dynamics (appendix A.1): the state is s = (z, theta, theta_dot), the action u displaces the joints.

z_next = z + mlp(z, theta, theta_dot, u),    theta_next = theta + u,    theta_dot_next = theta_dot
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.models.activations import Slopes
from kpirl_ocp.ocp.models.mlp import MLP, jvp, vjp, vjp_tangent
from kpirl_ocp.ocp.models.mlp_hessian import prepare, second
from kpirl_ocp.types import Array


@dataclass(frozen=True, eq=False)
class NetworkDynamics:
    """A network that predicts how keypoints move.

    mlp: (n_z + 3 n_joints) -> n_z, with its normalisation folded in.
    n_z: length of z, two image coordinates per keypoint.
    n_joints: length of theta, theta_dot and u.
    residual: the network predicts z_next - z, not z_next.
    rate: steps per second that it was trained at [Hz]; None if unknown.
    """

    mlp: MLP
    n_z: int
    n_joints: int
    residual: bool = True
    rate: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.mlp, MLP):
            raise ProblemError(
                "keypoint dynamics need an MLP, a chain of layers. State a problem with another network by "
                "OCP.from_expressions(dynamics=network(state, action), ...)."
            )
        expected = (self.n_z + 3 * self.n_joints, self.n_z)
        if (self.mlp.n_in, self.mlp.n_out) != expected:
            raise ProblemError(
                f"{self.n_z} keypoint coordinates and {self.n_joints} joints need a network with "
                f"{expected[0]} inputs and {expected[1]} outputs; it has {self.mlp.n_in} and {self.mlp.n_out}."
            )

    @property
    def n_states(self) -> int:
        """n_z + 2 n_joints."""
        return self.n_z + 2 * self.n_joints

    def state(self, keypoints: ArrayLike, theta: ArrayLike, velocity: ArrayLike = 0.0) -> Array:
        """State (n_s,) from keypoints (K, 2) or (n_z,), theta (n_joints,) [rad] and theta_dot, by default at rest."""
        z, theta = np.asarray(keypoints, float).ravel(), np.asarray(theta, float)
        if z.shape != (self.n_z,) or theta.shape != (self.n_joints,):
            raise ProblemError(
                f"a state needs {self.n_z} keypoint coordinates and {self.n_joints} joint positions, "
                f"got shapes {z.shape} and {theta.shape}."
            )
        return np.concatenate([z, theta, np.broadcast_to(np.asarray(velocity, float), theta.shape)])

    def function(self, n_parameters: int) -> ca.Function:
        """f(s, u, psi) -> s_next; psi (n_parameters,) belongs to the cost and is not used."""
        s, u = ca.MX.sym("s", self.n_states), ca.MX.sym("u", self.n_joints)
        psi, y = ca.MX.sym("psi", n_parameters), self.mlp(ca.vertcat(s, u))
        return ca.Function("dynamics", [s, u, psi], [self.successor(s, y, u)])

    def successor(self, s: ca.MX, y: ca.MX, u: ca.MX) -> ca.MX:
        """The next state for the output y of the network; linear, so that changes of all three give its change."""
        return self._shift(s) + ca.vertcat(y, self._displacement(u))

    def Ft_lambda(self, slopes: list[Slopes], costates: ca.MX) -> ca.MX:
        """F' lambda (n_x, B) for costates (n_s, B)."""
        by_network, *_ = vjp(self.mlp, slopes, costates[: self.n_z, :])
        theta = costates[self.n_z : self.n_z + self.n_joints, :]
        by_s = self._shift(costates) + by_network[: self.n_states, :]
        return ca.vertcat(by_s, theta + by_network[self.n_states :, :])

    @property
    def linear(self) -> ca.DM:
        """(f_s, f_u) without the network, sparse."""
        by_s = ca.DM(self._shift(ca.DM.eye(self.n_states)))
        by_u = ca.vertcat(ca.DM(self.n_z, self.n_joints), self._displacement(ca.DM.eye(self.n_joints)))
        return ca.horzcat(by_s, by_u)

    def _shift(self, s: ca.MX | ca.DM) -> ca.MX | ca.DM:
        """The part of the state that the next one is a change of."""
        if self.residual:
            return s
        return ca.vertcat(type(s).zeros(self.n_z, s.size2()), s[self.n_z :, :])

    def _displacement(self, u: ca.MX | ca.DM) -> ca.MX | ca.DM:
        """The displacement (2 n_joints, B) of theta and theta_dot."""
        return ca.vertcat(u, type(u)(self.n_joints, u.size2()))


@dataclass(frozen=True, eq=False)
class LinearisedNetwork:
    """The dynamics at many points: every layer is one matrix product for all of them; see `LinearisedDynamics`.

    psi is not used. The slopes of the activations are computed once for all results.
    """

    dynamics: NetworkDynamics
    states: ca.MX
    actions: ca.MX
    psi: ca.MX
    costates: ca.MX

    @cached_property
    def value(self) -> ca.MX:
        """The successors."""
        return self.dynamics.successor(self.states, self._linearised[0], self.actions)

    @property
    def Ft_lambda(self) -> ca.MX:
        """The costates pulled back through every stage."""
        return self.dynamics.Ft_lambda(self._slopes, self.costates)

    def Ft_lambda_tangent(self, x: ca.MX, dcostates: ca.MX) -> ca.MX:
        """The change of `Ft_lambda`."""
        mlp = self.dynamics.mlp
        *_, bent = vjp(mlp, self._slopes, self._of_network(self.costates))
        _, tangents = jvp(mlp, self._slopes, x)
        by_network, _ = vjp_tangent(mlp, bent, tangents, self._of_network(dcostates))
        return by_network + self.dynamics.linear.T @ dcostates

    def second(self) -> tuple[ca.Function, list[ca.MX]]:
        """At one point, the products that remain after `mlp_hessian.prepare` has run for all points at once."""
        dynamics = self.dynamics
        parts = prepare(dynamics.mlp, self._slopes, self._of_network(self.costates))
        value = ca.MX.sym("f", dynamics.n_states)
        symbols = [None if part is None else ca.MX.sym("part", part.size1()) for part in parts]
        J, H = second(dynamics.mlp, symbols)
        F = ca.MX(ca.densify(dynamics.linear))
        F[: dynamics.n_z, :] = J + dynamics.linear[: dynamics.n_z, :]
        function = ca.Function("second", [value, *(x for x in symbols if x is not None)], [value, F, H])
        return function, [self.value, *(part for part in parts if part is not None)]

    @property
    def _slopes(self) -> list[Slopes]:
        return self._linearised[1]

    @cached_property
    def _linearised(self) -> tuple[ca.MX, list[Slopes]]:
        return self.dynamics.mlp.linearise(ca.vertcat(self.states, self.actions))

    def _of_network(self, costates: ca.MX) -> ca.MX:
        return costates[: self.dynamics.n_z, :]
