"""A law: a small problem in v whose minimisers v*(p), with their derivatives, are known by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np

from stress.certificates.steep import Function

Expression = Callable[[ca.SX, ca.SX], ca.SX]


class Branch(NamedTuple):
    """One minimiser v (n_v,) with dv/dp (n_v,); None where there is no derivative."""

    v: np.ndarray
    slope: np.ndarray | None


def branch(v, slope) -> Branch:
    """From numbers."""
    return Branch(
        np.atleast_1d(np.asarray(v, float)), None if slope is None else np.atleast_1d(np.asarray(slope, float))
    )


@dataclass(frozen=True, kw_only=True)
class Law:
    """min cost(v, p)  subject to  inequality(v, p) <= 0, equality(v, p) = 0, v <= upper,  at one p.

    branches: its minimisers; none where there is none.
    drift: added to the dynamics, a function of p, with its value and its derivative (None where there is none).
    due: the problem is smooth around p, so that a certificate is expected.
    start: (n_v,) of the solver.
    follow, follow_drift: p -> v*(p) and the drift, for laws that are steep: their derivative has to be the slope to
        both sides.
    swing: a steep function of the first coordinate of the state, added to the first of the dynamics; swing_distance:
        of the state after one step from its steepest place.
    """

    cost: Expression
    p: float
    branches: tuple[Branch, ...]
    due: bool
    inequality: Expression | None = None
    equality: Expression | None = None
    upper: np.ndarray | float | Callable[[ca.SX], ca.SX] = np.inf
    drift: Callable[[ca.SX], ca.SX] | None = None
    drift_branch: Branch = Branch(np.zeros(1), np.zeros(1))
    start: np.ndarray | None = None
    follow: Callable[[float], np.ndarray] | None = None
    follow_drift: Callable[[float], float] | None = None
    swing: Function | None = None
    swing_distance: float = 0.0
    n: int = 1
