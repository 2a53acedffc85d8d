"""Identifiability of the parameters of a cost from demonstrations, and their accuracy.

Near the minimum of the IRL loss, demonstrations z_demo = z(psi) + noise of standard deviation sigma determine psi up to
a normal distribution with the precision

    F / sigma^2,    F = sum over demonstrations of (dz/dpsi)^T (dz/dpsi),

the Gauss-Newton information matrix of the loss (half its Hessian where residuals are small). Its eigenvectors with
small eigenvalues are directions of psi that hardly change the plan: learning leaves them where they started. Which
eigenvalue is small depends on the units of psi, so directions are compared in units of `spread`, the size of the
region in which each parameter was before learning: a direction is known when the data confine psi to less than that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.hypergradients.certificate import Hypergradient
from kpirl_ocp.irl.hypergradients.loss import demonstrated_observations
from kpirl_ocp.irl.identifiability.plan_jacobian import CONVERGED, plan_jacobian
from kpirl_ocp.irl.learning.horizons import Problems, problems_of
from kpirl_ocp.ocp.problem.statement.checks import number, numbers, shown, vector
from kpirl_ocp.pictures import Brief
from kpirl_ocp.types import Array, Demonstration, Mask

_RANK = 1e-12  # eigenvalues below this share of the largest are rounding
_OUTSIDE = 1e-6  # a combination with this share of its length among unknown directions is unknown


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Brief):
    """Evidence of the demonstrations about psi.

    psi: (n_psi,) where the loss was linearised. information: F (n_psi, n_psi).
    spread: S (n_psi, n_psi) with the covariance S S^T of psi before learning; its columns are the units in which
        directions are compared. Diagonal if parameters were independent.
    noise: sigma, in the unit of the observations. freedom: degrees of freedom of its estimate; infinite if it is given.
    decrement: length of the Gauss-Newton step to the minimum of the loss, in standard deviations; intervals are about
        the minimum, so they mean little where this is large.
    uncertified: number of plans whose derivative was only flagged.
    """

    psi: Array
    information: Array
    spread: Array
    noise: float
    freedom: float
    decrement: float
    uncertified: int

    @cached_property
    def _spectrum(self) -> tuple[Array, Array]:
        values, vectors = np.linalg.eigh(self.spread.T @ self.information @ self.spread)
        return np.maximum(values[::-1], 0.0), vectors[:, ::-1]

    @property
    def eigenvalues(self) -> Array:
        """(n_psi,) of the information in units of the spread, largest first."""
        return self._spectrum[0]

    @property
    def directions(self) -> Array:
        """(n_psi, n_psi): column k is the k-th direction, in units of the spread."""
        return self._spectrum[1]

    @property
    def deviations(self) -> Array:
        """(n_psi,) standard deviation along each direction, from the data alone, in units of the spread."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self._resolved, self.noise / np.sqrt(self.eigenvalues), np.inf)

    def known(self, noise: float | None = None) -> int:
        """Number of directions that the data confine to less than the spread, at this noise (default: `self.noise`)."""
        sigma = self.noise if noise is None else _noise(noise)
        return int((self._resolved & (self.eigenvalues > sigma**2)).sum())

    @property
    def posterior(self) -> Array:
        """Covariance (n_psi, n_psi) of psi, from the data and the spread: (F / sigma^2 + (S S^T)^-1)^-1."""
        scaled = self.spread @ self.directions
        shrink = self.noise**2 / (self.eigenvalues + self.noise**2) if self.noise > 0 else 1.0 * ~self._resolved
        return (scaled * shrink) @ scaled.T

    def determined(self, combinations: ArrayLike | None = None) -> Mask:
        """(m,) True for combinations whose standard deviation the data brought below half of what the spread allows."""
        rows = self._rows(combinations)
        return self._posterior_deviations(rows) < 0.5 * np.linalg.norm(rows @ self.spread, axis=1)

    def intervals(self, level: float = 0.9, combinations: ArrayLike | None = None) -> Array:
        """Confidence intervals (m, 2) of linear combinations of psi, from the data alone.

        combinations: (m, n_psi), one per row; by default psi itself. Infinite where the data do not determine them.
        """
        rows = self._rows(combinations)
        parts = rows @ self.spread @ self.directions  # (m, directions)
        known, lost = parts[:, self._resolved], parts[:, ~self._resolved]
        outside = np.linalg.norm(lost, axis=1) > _OUTSIDE * np.linalg.norm(parts, axis=1)
        deviations = np.linalg.norm(known * self.deviations[self._resolved], axis=1)
        return self._around(rows, np.where(outside, np.inf, deviations), level)

    def credible_intervals(self, level: float = 0.9, combinations: ArrayLike | None = None) -> Array:
        """Intervals from the data and the spread together: never wider than the prior ones.

        They are about the psi that minimises the loss over sigma^2 plus |S^-1 (psi - start)|^2, which is where
        learning from a start ends, roughly: directions that the data do not determine stay at the start.
        """
        rows = self._rows(combinations)
        return self._around(rows, self._posterior_deviations(rows), level)

    def _rows(self, combinations: ArrayLike | None) -> Array:
        given = np.eye(len(self.psi)) if combinations is None else numbers("combinations", combinations)
        rows = np.atleast_2d(given)
        if rows.shape[1:] != self.psi.shape or not np.isfinite(rows).all():
            raise ProblemError(f"combinations must be finite and (m, n_psi) = (m, {len(self.psi)}), got {rows.shape}.")
        return rows

    def _posterior_deviations(self, rows: Array) -> Array:
        return np.sqrt(np.einsum("ij,jk,ik->i", rows, self.posterior, rows))

    def _around(self, rows: Array, deviations: Array, level: float) -> Array:
        share = number("level", level, "between 0 and 1", 0, 1)
        halfwidths = stdtrit(self.freedom, 0.5 + share / 2) * deviations  # the quantile of Student's t
        return (rows @ self.psi)[:, None] + halfwidths[:, None] * [-1.0, 1.0]

    @property
    def _resolved(self) -> Mask:
        return self.eigenvalues > _RANK * self.eigenvalues[0]


def identify(
    problem: Problems,
    demonstrations: Sequence[Demonstration],
    psi: ArrayLike,
    spread: ArrayLike = 1.0,
    noise: float | None = None,
    method: Hypergradient = CONVERGED,
) -> Identification:
    """Evidence of demonstrations about a learned psi (n_psi,).

    Args:
        problem: whose plans imitate the demonstrations; or a function T -> problem, as in `learn`.
        demonstrations: that psi was learned from.
        psi: (n_psi,), near the minimum of the IRL loss.
        spread: standard deviations of psi before learning, a number or (n_psi,); or S (n_psi, n_psi), see
            `Identification`. `gains.stiffness` gives units that make axes comparable.
        noise: standard deviation of the observations; by default from the residuals, which counts misfit as noise.
        method: how the plan depends on psi: `Implicit` for the converged problem, `Unrolled` for gradient steps.

    Raises:
        CertificateError: a plan has no certified derivative, under the policy "raise".
        ProblemError: no demonstrations, a spread or noise that is not positive, or too few observations to estimate
            the noise from.
    """
    if not isinstance(demonstrations, Sequence) or not all(isinstance(one, Demonstration) for one in demonstrations):
        raise ProblemError(f"demonstrations must be a sequence of Demonstration, got {shown(demonstrations)}.")
    if not demonstrations:
        raise ProblemError("identify needs at least one demonstration.")
    problems = problems_of(problem, demonstrations)
    if not problems[0].n_parameters:
        raise ProblemError("problem must have parameters: there is nothing to identify.")
    psi = vector("psi", psi, problems[0].n_parameters)
    units = _spread(spread, len(psi))
    given = None if noise is None else _noise(noise)
    pairs = list(zip(problems, demonstrations, strict=True))
    plans = [plan_jacobian(own, demonstration, psi, method) for own, demonstration in pairs]
    seen = [demonstrated_observations(own, demonstration).T[1:].ravel() for own, demonstration in pairs]
    residuals = np.concatenate(seen) - np.concatenate([plan.observations for plan in plans])
    jacobian = np.vstack([plan.jacobian for plan in plans])
    if not (np.isfinite(jacobian).all() and np.isfinite(residuals).all()):
        raise ProblemError(f"psi must have plans that are finite and can be differentiated; {shown(psi)} has none.")
    information = jacobian.T @ jacobian
    eigenvalues = np.asarray(np.linalg.eigvalsh(units.T @ information @ units), float)
    sigma, freedom = (given, np.inf) if given is not None else estimate_noise(residuals, eigenvalues)
    return Identification(
        psi=psi,
        information=information,
        spread=units,
        noise=sigma,
        freedom=freedom,
        decrement=_decrement(jacobian @ units, residuals, sigma),
        uncertified=sum(not plan.certified for plan in plans),
    )


def _noise(noise: ArrayLike) -> float:
    return number("noise", noise, "positive and finite, below 1e100", 0, 1e100)


def _spread(spread: ArrayLike, n: int) -> Array:
    """S (n, n). Raises ProblemError unless it is finite and invertible."""
    given = numbers("spread", spread)
    S = np.diag(np.broadcast_to(given, (n,))) if given.shape in ((), (1,), (n,)) else given
    lengths = np.linalg.norm(S, axis=-1, keepdims=True)
    positive = given.ndim == 2 or bool((given > 0).all())
    fits = S.shape == (n, n) and positive and bool(((lengths > 1e-100) & (lengths < 1e100)).all())
    if not fits or np.linalg.matrix_rank(S / lengths) < n:  # in whatever units
        raise ProblemError(
            f"spread must be positive, a number or ({n},), or an invertible ({n}, {n}); got {shown(spread)}."
        )
    return S


def estimate_noise(residuals: Array, eigenvalues: Array) -> tuple[float, float]:
    """sigma and its degrees of freedom n - gamma, with gamma = sum lambda / (lambda + sigma^2) parameters in use.

    The effective number of parameters of MacKay (Bayesian Interpolation, 1992, section 4.4). It is the fixed point of
    sigma^2 = |r|^2 / (n - gamma), a contraction of log sigma^2, as no more than n eigenvalues are positive.
    """
    squares, largest = float(residuals @ residuals), eigenvalues.max(initial=0.0)
    found = eigenvalues[eigenvalues > _RANK * largest]
    variance = squares / len(residuals)
    for _ in range(100):
        freedom = len(residuals) - float((found / (found + variance)).sum())
        if freedom < 1:
            break
        variance = squares / freedom
    if freedom < 1:
        raise ProblemError(
            f"{len(residuals)} observations determine as many parameters and say nothing about their noise: "
            "pass noise=, or more demonstrations."
        )
    return float(np.sqrt(variance)), freedom


def _decrement(jacobian: Array, residuals: Array, noise: float) -> float:
    """|(J^T J + sigma^2)^-1/2 J^T r| / sigma, the length of the Gauss-Newton step; J in units of the spread."""
    left, singular, _ = np.linalg.svd(jacobian, full_matrices=False)
    share = singular**2 / (singular**2 + noise**2) if noise > 0 else 1.0 * (singular > 0)
    length = np.linalg.norm(np.sqrt(share) * (left.T @ residuals))
    return float(length / noise) if noise > 0 else (np.inf if length > 0 else 0.0)
