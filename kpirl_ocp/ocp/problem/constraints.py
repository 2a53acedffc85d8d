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

    other: the row of the other side, or the row itself where that is not bounded. equal: True where both coincide.
    n_lower: how many are lower bounds.
    """

    entries: Indices
    signs: Array
    limits: Array
    other: Indices
    equal: Mask
    n_lower: int

    @classmethod
    def of(cls, lower: Array, upper: Array) -> BoundRows:
        """The rows of bounds (n_w,) that are infinite where there is none."""
        low, high = np.flatnonzero(np.isfinite(lower)), np.flatnonzero(np.isfinite(upper))
        entries, rows = np.concatenate([low, high]), np.arange(len(low) + len(high))
        places, other = np.full((2, len(lower)), -1), rows.copy()
        places[0, low], places[1, high] = rows[: len(low)], rows[len(low) :]
        both = places[:, (places >= 0).all(axis=0)]
        other[both] = both[::-1]
        return cls(
            entries=entries,
            signs=np.repeat([-1.0, 1.0], [len(low), len(high)]),
            limits=np.concatenate([lower[low], upper[high]]),
            other=other,
            equal=(lower == upper)[entries],
            n_lower=len(low),
        )

    @property
    def twice(self) -> Mask:
        """True where the same entry also has a bound on the other side."""
        return self.other != np.arange(len(self.other))

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

        Of two sides the force is on the one that pushes. With a barrier both push, and only their difference is known:
        the further one pushes with tau / slack, the nearer one with the rest.
        """
        at = self.bounds
        net, slack = at.signs * nu[at.entries], self.slack[: len(at.entries)]
        forces = np.where(at.twice, np.maximum(net, 0.0), net)
        if barrier > 0:
            with np.errstate(divide="ignore"):
                push = barrier / slack
            both = np.where(slack > slack[at.other], push, net + push[at.other])
            forces = np.where(at.twice & ~at.equal, both, forces)
        return np.concatenate([forces, mu])
