"""Learned keypoint dynamics (appendix A.1): the state is s = (z, theta, theta_dot), the action u displaces the joints.

z_next = z + mlp(z, theta, theta_dot, u),    theta_next = theta + u,    theta_dot_next = theta_dot
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.models.activations import Slopes
from kpirl_ocp.ocp.models.mlp import MLP, jacobian, pull, push
from kpirl_ocp.ocp.models.mlp_hessian import hessian, prepare, second
from kpirl_ocp.ocp.problem.dynamics import DynamicsDerivatives, Staged
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
        return ca.Function("dynamics", [s, u, psi], [self.successor(s, y, u)])

    def derivatives(self, n_parameters: int) -> DynamicsDerivatives:
        """The derivatives of `function`, arranged by hand."""
        s, u, psi = self._symbols(n_parameters)
        ds, du, lam = (ca.MX.sym(name, like.numel()) for name, like in (("ds", s), ("du", u), ("lam", s)))
        _, slopes = self.mlp.linearise(ca.vertcat(s, u))
        moved, _ = push(self.mlp, slopes, ca.vertcat(ds, du))
        by_s, by_u = self.pulled(slopes, lam)
        J = jacobian(self.mlp, slopes)
        F = ca.vertcat(J + self.linear[: self.n_z, :], self.linear[self.n_z :, :])
        return DynamicsDerivatives(
            jvp=ca.Function("jvp", [s, u, psi, ds, du], [self.successor(ds, moved, du)]),
            vjp=ca.Function("vjp", [s, u, psi, lam], [by_s, by_u, ca.MX.zeros(n_parameters)]),
            jacobian=ca.Function("jacobian", [s, u, psi], [F[:, : self.n_states], F[:, self.n_states :]]),
            hessian=ca.Function("hessian", [s, u, psi, lam], [hessian(self.mlp, slopes, lam[: self.n_z])]),
            first=self._first,
            second=Staged(self._prepare, self._second()),
        )

    def _first(self, steps: int) -> ca.Function:
        """See `DynamicsDerivatives.first`."""
        s, u, psi, lam = self._columns(steps)
        y, slopes = self.mlp.linearise(ca.vertcat(s, u))
        return ca.Function("first", [s, u, psi, lam], [self.successor(s, y, u), *self.pulled(slopes, lam)])

    def _prepare(self, steps: int) -> ca.Function:
        """(s, u, no psi, lam) of all stages -> f, and what `network_second.second` takes."""
        s, u, psi, lam = self._columns(steps)
        y, slopes = self.mlp.linearise(ca.vertcat(s, u))
        parts = prepare(self.mlp, slopes, lam[: self.n_z, :])
        return ca.Function("prepare", [s, u, psi, lam], [self.successor(s, y, u), *(x for x in parts if x is not None)])

    def _second(self) -> ca.Function:
        """f and those parts at one stage -> f, (f_s, f_u) and the Hessian."""
        _, slopes = self.mlp.linearise(ca.MX.sym("x", self.mlp.n_in))
        parts = prepare(self.mlp, slopes, ca.MX.sym("lam", self.n_z))
        value = ca.MX.sym("f", self.n_states)
        symbols = [None if part is None else ca.MX.sym("part", part.size1()) for part in parts]
        J, H = second(self.mlp, symbols)
        F = ca.MX(ca.densify(self.linear))
        F[: self.n_z, :] = J + self.linear[: self.n_z, :]
        return ca.Function("second", [value, *(x for x in symbols if x is not None)], [value, F, H])

    def _columns(self, steps: int) -> tuple[ca.MX, ca.MX, ca.MX, ca.MX]:
        """s, u, no psi and lam of all stages."""
        sizes = {"s": self.n_states, "u": self.n_joints, "psi": 0, "lam": self.n_states}
        s, u, psi, lam = (ca.MX.sym(name, size, steps) for name, size in sizes.items())
        return s, u, psi, lam

    def successor(self, s: ca.MX, y: ca.MX, u: ca.MX) -> ca.MX:
        """The next state for the output y of the network, or its change for changes."""
        return self._shift(s) + ca.vertcat(y, self._displacement(u))

    def pulled(self, slopes: list[Slopes], lam: ca.MX) -> tuple[ca.MX, ca.MX]:
        """f_s^T lam (n_s, B) and f_u^T lam (n_u, B)."""
        pulled, _ = pull(self.mlp, slopes, lam[: self.n_z, :])
        theta = lam[self.n_z : self.n_z + self.n_joints, :]
        return self._shift(lam) + pulled[: self.n_states, :], theta + pulled[self.n_states :, :]

    @property
    def linear(self) -> ca.DM:
        """(f_s, f_u) without the network, sparse."""
        by_s = ca.DM(self._shift(ca.DM.eye(self.n_states)))
        by_u = ca.vertcat(ca.DM(self.n_z, self.n_joints), self._displacement(ca.DM.eye(self.n_joints)))
        return ca.horzcat(by_s, by_u)

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
