"""Learned keypoint dynamics (appendix A.1): the state is s = (z, theta, theta_dot), the action u displaces the joints.

z_next = z + mlp(z, theta, theta_dot, u),    theta_next = theta + u,    theta_dot_next = theta_dot
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.derivatives import DynamicsDerivatives
from kpirl_ocp.ocp.network import MLP, hessian, jacobian, pull, push, second
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
        s, u, psi = self._symbols(n_parameters)
        y = self.mlp(ca.vertcat(s, u))
        return ca.Function("dynamics", [s, u, psi], [self._shift(s) + ca.vertcat(y, self._displacement(u))])

    def derivatives(self, n_parameters: int) -> DynamicsDerivatives:
        """The derivatives of `function`, arranged by hand."""
        s, u, psi = self._symbols(n_parameters)
        ds, du, lam = (ca.MX.sym(name, like.numel()) for name, like in (("ds", s), ("du", u), ("lam", s)))
        n_z, n_s = self.n_z, self.n_states
        theta = slice(n_z, n_z + self.n_joints)
        y, slopes = self.mlp.linearise(ca.vertcat(s, u))
        moved, _ = push(self.mlp, slopes, ca.vertcat(ds, du))
        pulled, _ = pull(self.mlp, slopes, lam[:n_z])
        rows = ca.vertcat(jacobian(self.mlp, slopes), ca.MX(2 * self.n_joints, self.mlp.n_in))
        linear_s = ca.DM(self._shift(ca.DM.eye(n_s)))
        linear_u = ca.vertcat(ca.DM(n_z, self.n_joints), self._displacement(ca.DM.eye(self.n_joints)))
        value = self._shift(s) + ca.vertcat(y, self._displacement(u))
        by_s, by_u = self._shift(lam) + pulled[:n_s], lam[theta] + pulled[n_s:]
        slope, curvature = second(self.mlp, slopes, lam[:n_z])
        F = ca.MX(ca.densify(ca.horzcat(linear_s, linear_u)))
        F[:n_z, :] = slope + ca.horzcat(linear_s, linear_u)[:n_z, :]
        return DynamicsDerivatives(
            jvp=ca.Function("jvp", [s, u, psi, ds, du], [self._shift(ds) + ca.vertcat(moved, self._displacement(du))]),
            vjp=ca.Function("vjp", [s, u, psi, lam], [by_s, by_u, ca.MX.zeros(n_parameters)]),
            jacobian=ca.Function("jacobian", [s, u, psi], [rows[:, :n_s] + linear_s, rows[:, n_s:] + linear_u]),
            hessian=ca.Function("hessian", [s, u, psi, lam], [hessian(self.mlp, slopes, lam[:n_z])]),
            first=ca.Function("first", [s, u, psi, lam], [value, by_s, by_u]),
            second=ca.Function("second", [s, u, psi, lam], [value, F, curvature]),
        )

    def _symbols(self, n_parameters: int) -> tuple[ca.MX, ca.MX, ca.MX]:
        return (
            ca.MX.sym("s", self.n_states),
            ca.MX.sym("u", self.n_joints),
            ca.MX.sym("psi", n_parameters),
        )

    def _shift(self, s: ca.MX | ca.DM) -> ca.MX | ca.DM:
        """The part of the state that stays."""
        if self.residual:
            return s
        return ca.vertcat(type(s).zeros(self.n_z, s.size2()), s[self.n_z :, :])

    def _displacement(self, u: ca.MX | ca.DM) -> ca.MX | ca.DM:
        """How theta and theta_dot move."""
        return ca.vertcat(u, type(u)(self.n_joints, u.size2()))
