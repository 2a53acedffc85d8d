"""Derivatives of the dynamics f(s, u, psi), in the two forms that solvers and gradients need.

Dynamics with a known structure, such as a network, can bring derivatives arranged by hand; all others get them from
CasADi's AD, with the same interface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import casadi as ca

from kpirl_ocp.ocp.problem.linearised_dynamics import LinearisedByStage, LinearisedDynamics
from kpirl_ocp.ocp.problem.trajectory_passes import StagePasses, TrajectoryPasses


@dataclass(frozen=True, eq=False)
class DynamicsDerivatives:
    """Derivatives of f at given points, and along trajectories of f itself.

    linearise: (S (n_s, B), U (n_u, B), psi (n_psi, B), Lambda (n_s, B)) -> f linearised at B points; psi is (0, B)
        where f does not depend on it.
    passes: (T, B) -> the passes along B trajectories of T steps.
    """

    linearise: Callable[[ca.MX, ca.MX, ca.MX, ca.MX], LinearisedDynamics]
    passes: Callable[[int, int], TrajectoryPasses]

    @classmethod
    def by_ad(cls, dynamics: ca.Function) -> DynamicsDerivatives:
        """The derivatives by CasADi's AD, of any f(s, u, psi) that it can differentiate."""
        return cls(partial(LinearisedByStage, dynamics), partial(StagePasses, dynamics))
