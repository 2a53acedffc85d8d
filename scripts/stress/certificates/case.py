"""One generated case: what is differentiated, and what is known of the answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kpirl_ocp import OCP, Demonstration, Riccati, Trajectory
from kpirl_ocp.irl.hypergradients import Loss, squared_distance

TOLERANCE = 1e-3  # of a gradient, relative


class Truth(NamedTuple):
    """The gradient (n_psi,) of the branch that a plan is on; None where there is none.

    scale: (n_psi,) what its errors are measured by.
    """

    gradient: np.ndarray | None
    scale: np.ndarray

    def agrees(self, found: np.ndarray) -> bool:
        """Whether a gradient is right."""
        return self.gradient is not None and bool((np.abs(found - self.gradient) <= TOLERANCE * self.scale).all())


@dataclass(frozen=True, kw_only=True)
class Case:
    """family: where it comes from. truth: of a plan. due: a certificate is expected. scaled: in drawn units."""

    family: str
    problem: OCP
    demonstration: Demonstration
    psi: np.ndarray
    truth: Callable[[Trajectory], Truth]
    due: bool
    scaled: bool
    guess: Trajectory | None = None
    loss: Loss = squared_distance
    solver: object = Riccati()


def weighed(by_states: np.ndarray, tangent: np.ndarray, slope: float, move: np.ndarray) -> np.ndarray:
    """Scale for errors of a gradient, (n_psi,): its terms without their signs.

    by_states: (T+1, n_s) dL/dS. tangent: (T+1, n_s, n_psi) dS/dpsi. slope, move (n_psi,): units of both, a hundredth of
    which counts where they are zero.
    """
    return np.einsum("ti,tij->j", np.abs(by_states) + 1e-2 * slope, np.abs(tangent) + 1e-2 * move)
