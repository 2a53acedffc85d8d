"""A filter line search: a step must reduce the objective or the violation of the constraints, and never cycle.

Waechter and Biegler, On the implementation of an interior-point filter line-search algorithm (2006), section 2.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

_VIOLATION, _OBJECTIVE, _ARMIJO = 1e-5, 1e-8, 1e-4  # sufficient decrease of theta, of phi by theta, of phi by its slope
_ROUNDING = 10 * np.finfo(float).eps


@dataclass
class Filter:
    """Pairs (theta, phi) of violation and objective that no later iterate may be worse than in both.

    largest: theta above which nothing is accepted. small: theta below which the objective decides.
    """

    largest: float
    small: float
    pairs: list[tuple[float, float]] = field(default_factory=list)

    @classmethod
    def starting_at(cls, theta: float) -> Filter:
        """For a first iterate with violation theta."""
        return cls(largest=1e4 * max(1.0, theta), small=1e-4 * max(1.0, theta))

    def accepts(self, theta: float, phi: float, slope: float, length: float, trial: Sequence[float]) -> bool:
        """Is a step of `length` from (theta, phi) with directional derivative `slope` of phi to `trial` good enough?

        Adds the point it leaves to the filter, unless the objective alone decided.
        """
        new_theta, new_phi = trial
        tolerated = _ROUNDING * abs(phi)
        if not (np.isfinite(new_theta) and np.isfinite(new_phi)) or new_theta > self.largest:
            return False
        if any(new_theta >= t and new_phi - tolerated > p for t, p in self.pairs):
            return False
        if slope < 0 and length * (-slope) ** 2.3 > theta**1.1 and theta <= self.small:
            return bool(new_phi <= phi + _ARMIJO * length * slope + tolerated)
        better = new_theta <= (1 - _VIOLATION) * theta or new_phi <= phi - _OBJECTIVE * theta + tolerated
        if better:
            self.pairs.append(((1 - _VIOLATION) * theta, phi - _OBJECTIVE * theta))
        return bool(better)
