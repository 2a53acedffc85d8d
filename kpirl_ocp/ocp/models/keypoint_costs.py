"""The paper's keypoint costs as one family (section "Cost functions and IRL Loss").

    C_psi = sum_{t=1}^{T} sum_i W[t, i] (z_t[i] - z_goal[i])^2  +  sum_{t=0}^{T-1} rho_t |u_t|^2,      W = B g(Psi)

B (T, J) is a basis in time and g the map that keeps weights non-negative (or the identity). Weighted, TimeDependent and
RBF differ only in B; Default has W = 1 and nothing to learn. The effort weight rho keeps a converged problem from
jumping to the goal in one step; N gradient steps of size alpha act like rho of about 1 / (2 alpha N).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.types import Array


class Basis(Protocol):
    """Weights over time as a linear function of few numbers."""

    def matrix(self, horizon: int) -> Array:
        """B (T, J): row t-1 belongs to the state s_t, t = 1..T."""
        ...


@dataclass(frozen=True)
class Weighted:
    """One weight per keypoint coordinate, the same at all times: J = 1."""

    def matrix(self, horizon: int) -> Array:
        """Ones (T, 1)."""
        return np.ones((horizon, 1))


@dataclass(frozen=True)
class TimeDependent:
    """One weight per keypoint coordinate and time step: J = T."""

    def matrix(self, horizon: int) -> Array:
        """Identity (T, T)."""
        return np.eye(horizon)


@dataclass(frozen=True)
class RBF:
    """J Gaussian kernels exp(b (t - mu_j)^2), uniformly spaced over t = 1..T; neighbours cross at half their height."""

    kernels: int = 5

    def matrix(self, horizon: int) -> Array:
        """Kernels (T, J); b = -log 2 / (half the spacing)^2."""
        if not isinstance(self.kernels, int) or not 2 <= self.kernels <= horizon:
            raise ProblemError(f"RBF needs whole 2 <= kernels <= horizon = {horizon}, got {self.kernels!r}.")
        centres, spacing = np.linspace(1, horizon, self.kernels, retstep=True)
        times = np.arange(1, horizon + 1)
        return np.exp(-np.log(2.0) * ((times[:, None] - centres) / (spacing / 2)) ** 2)


@dataclass(frozen=True)
class Default:
    """The squared distance to the goal, W = 1; nothing is learned: J = 0."""

    def matrix(self, horizon: int) -> Array:
        """Empty (T, 0)."""
        return np.zeros((horizon, 0))


@dataclass(frozen=True)
class Parametrisation:
    """A map g from learned numbers to weights, with its inverse."""

    forward: Callable[[ca.SX], ca.SX]
    inverse: Callable[[Array], Array]


def softplus(x: ca.SX) -> ca.SX:
    """log(1 + e^x) without overflow; each branch stays finite beyond its own side, so that its derivatives do too."""
    return ca.if_else(x > 0, x + ca.log1p(ca.exp(-ca.fmax(x, -1))), ca.log1p(ca.exp(ca.fmin(x, 1))))


PARAMETRISATIONS = {
    "identity": Parametrisation(lambda x: x, lambda w: w),  # signs are free, as in the paper
    "softplus": Parametrisation(softplus, lambda w: w + np.log(-np.expm1(-w))),
    "exp": Parametrisation(ca.exp, np.log),
    "square": Parametrisation(lambda x: x * x, np.sqrt),
}


@dataclass(frozen=True)
class KeypointCost:
    """A member of the family.

    basis: Weighted(), TimeDependent(), RBF(kernels) or Default().
    effort: rho, a number or one per step (T,).
    learn_effort: make rho part of psi, one number or one per step as in `effort`, which is then its starting value.
    positivity: name of the map g: "identity", "softplus", "exp" or "square"; a learned effort goes through it too.

    psi = (Psi (J, n_z) row by row, then the effort numbers if they are learned).
    """

    basis: Basis
    effort: float | tuple[float, ...] = 0.0
    learn_effort: bool = False
    positivity: str = "identity"

    def __post_init__(self) -> None:
        if self.positivity not in PARAMETRISATIONS:
            raise ProblemError(f"positivity must be one of {', '.join(PARAMETRISATIONS)}; got {self.positivity!r}.")
        effort = np.atleast_1d(np.asarray(self.effort, float))
        if effort.ndim != 1 or not np.isfinite(effort).all() or (effort < 0).any():
            raise ProblemError(f"effort must be a number >= 0, or one per step (T,); got {self.effort!r}.")
        if np.ndim(self.effort) > 0:
            object.__setattr__(self, "effort", tuple(effort.tolist()))

    def schedule(self, horizon: int) -> Array:
        """The schedule (T+1, n_d): the weights' basis in time, then the effort's."""
        basis = self.basis.matrix(horizon)  # (T, J)
        columns = basis if basis.shape[1] else np.ones((horizon, 1))
        effort = self._effort_basis(horizon)  # (T, 1), or (T, T) when learned per step
        return np.hstack([np.vstack([np.zeros_like(columns[:1]), columns]), np.vstack([effort, effort[-1:]])])

    def preview(self, horizon: int) -> Array:
        """Rows (T-1, n_d) that follow the schedule: no weights, and the effort of the last step.

        Of both together, rows k .. k+T are the schedule of what remains of a task after k steps. The rest of an optimal
        plan is optimal for it (Bellman), so that planning again in every period leads where the first plan does.
        """
        rest = self.schedule(horizon)[-1:]
        n_weights = max(self.basis.matrix(horizon).shape[1], 1)
        return np.repeat(np.hstack([0 * rest[:, :n_weights], rest[:, n_weights:]]), horizon - 1, axis=0)

    def stage_cost(self, z: ca.SX, u: ca.SX, psi: ca.SX, goal: ca.SX, stage: ca.SX) -> ca.SX:
        """The cost of one stage as a scalar expression.

        Args:
            z: keypoints (n_z,).
            u: actions (n_u,).
            psi: parameters (n_psi,).
            goal: z_goal (n_z,).
            stage: row d_t of the schedule (n_d,).
        """
        n_weights = stage.numel() - (np.size(self.effort) if self.learn_effort else 1)
        kernels, effort = stage[:n_weights], stage[n_weights:]
        positive = PARAMETRISATIONS[self.positivity].forward
        n_psi = psi.numel() - (effort.numel() if self.learn_effort else 0)
        weights = ca.reshape(positive(psi[:n_psi]), z.numel(), -1) @ kernels if n_psi else kernels
        rho = ca.dot(effort, positive(psi[n_psi:])) if self.learn_effort else effort
        return ca.sum1(weights * (z - goal) ** 2) + rho * ca.sumsqr(u)

    def n_parameters(self, horizon: int, n_observations: int) -> int:
        """Length of psi."""
        n_weights = self.basis.matrix(horizon).shape[1] * n_observations
        return n_weights + (len(self._efforts(horizon)) if self.learn_effort else 0)

    def initial(self, horizon: int, n_observations: int, weights: ArrayLike = 1.0) -> Array:
        """psi (n_psi,) of given weights, and of the effort as it stands.

        Args:
            horizon: T.
            n_observations: n_z.
            weights: g(Psi), broadcast to (J, n_z).

        Raises:
            ProblemError: weights that the map g cannot represent.
        """
        kernels = self.basis.matrix(horizon).shape[1]
        wanted = np.broadcast_to(np.asarray(weights, float), (kernels, n_observations)).ravel()
        if self.learn_effort:
            wanted = np.concatenate([wanted, self._efforts(horizon)])
        with np.errstate(divide="ignore", invalid="ignore"):
            psi = PARAMETRISATIONS[self.positivity].inverse(wanted)
        if not np.isfinite(psi).all():
            raise ProblemError(
                f"{self.positivity!r} cannot represent weights of {wanted.min():g}: choose positive ones."
            )
        return psi

    def weights(self, psi: ArrayLike, horizon: int, n_observations: int) -> tuple[Array, Array]:
        """W (T, n_z) and rho (T,) of the parameters psi."""
        positive = PARAMETRISATIONS[self.positivity].forward
        psi = np.asarray(psi, float).ravel()
        if len(psi) != self.n_parameters(horizon, n_observations):
            raise ProblemError(f"psi must have length {self.n_parameters(horizon, n_observations)}, got {len(psi)}.")
        values = dense(positive(ca.DM(psi))).ravel()
        basis = self.basis.matrix(horizon)
        split = basis.shape[1] * n_observations
        W = basis @ values[:split].reshape(-1, n_observations) if split else np.ones((horizon, n_observations))
        rho = values[split:] if self.learn_effort else self._efforts(horizon)
        return W, np.broadcast_to(rho, (horizon,)).copy()

    def _efforts(self, horizon: int) -> Array:
        """The effort numbers (1,) or (T,)."""
        efforts = np.atleast_1d(np.asarray(self.effort, float))
        if len(efforts) not in (1, horizon):
            raise ProblemError(f"effort must be one number or one per step ({horizon},), got {len(efforts)}.")
        return efforts

    def _effort_basis(self, horizon: int) -> Array:
        efforts = self._efforts(horizon)
        if not self.learn_effort:
            return np.broadcast_to(efforts, (horizon,)).reshape(horizon, 1)
        return np.eye(horizon) if len(efforts) > 1 else np.ones((horizon, 1))
