"""Bounds and inequalities as lists of rows, with their multipliers.

The bounds on a vector w of unknowns have multipliers nu in the order of w, positive at an upper and negative at a lower
bound. Listed row by row, each side of a bound has a multiplier of its own, which is not negative at a solution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kpirl_ocp.types import Array, Indices, Mask


@dataclass(frozen=True, eq=False)
class BoundRows:
    """Finite lower bounds, then finite upper bounds, as signs * (limits - w[entries]) >= 0; all (n_bounds,).

    twice: True where the other side is bounded, too. equal: where it coincides. n_lower: how many are lower bounds.
    """

    entries: Indices
    signs: Array
    limits: Array
    twice: Mask
    equal: Mask
    n_lower: int

    @classmethod
    def of(cls, lower: Array, upper: Array) -> BoundRows:
        """Of bounds (n_w,), infinite where there is none."""
        low, high = np.flatnonzero(np.isfinite(lower)), np.flatnonzero(np.isfinite(upper))
        entries = np.concatenate([low, high])
        return cls(
            entries=entries,
            signs=np.repeat([-1.0, 1.0], [len(low), len(high)]),
            limits=np.concatenate([lower[low], upper[high]]),
            twice=np.bincount(entries, minlength=len(lower))[entries] > 1,
            equal=(lower == upper)[entries],
            n_lower=len(low),
        )

    def slack(self, w: Array) -> Array:
        """Distances (n_bounds,) from the bounds at w (n_w,); negative beyond them."""
        return self.signs * (self.limits - w[self.entries])

    def net_force(self, forces: Array, n_w: int) -> Array:
        """nu (n_w,) of the rows' multipliers (n_bounds,): upper minus lower."""
        return np.bincount(self.entries, self.signs * forces, n_w).astype(float)


@dataclass(frozen=True)
class Inequalities:
    """All inequalities in one list, each as slack >= 0: finite lower bounds, finite upper bounds, then g <= 0.

    slack: (n_rows,). equal: (n_rows,) True where lower and upper bound coincide, so that the row is an equality.
    """

    bounds: BoundRows
    slack: Array
    equal: Mask

    @classmethod
    def at(cls, bounds: BoundRows, w: Array, g: Array) -> Inequalities:
        """The inequalities at w (n_w,), with the values of g (n_g,) there."""
        equal = np.concatenate([bounds.equal, np.zeros(len(g), bool)])
        return cls(bounds, np.concatenate([bounds.slack(w), -g]), equal)

    def forces(self, nu: Array, mu: Array, barrier: float) -> Array:
        """Multipliers (n_rows,) of all rows from those of the bounds (n_w,) and of g (n_g,).

        With a barrier both sides of a bound push, and only their difference is known: there they follow from the
        slack, tau / slack, and a disagreement shows up in the stationarity.
        """
        at = self.bounds
        forces = at.signs * nu[at.entries]
        forces = np.where(at.twice, np.maximum(forces, 0.0), forces)
        if barrier > 0:
            with np.errstate(divide="ignore"):
                forces = np.where(at.equal, forces, barrier / self.slack[: len(forces)])
        return np.concatenate([forces, mu])
