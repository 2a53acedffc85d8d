"""The `stage_points` of keypoint dynamics with a network: every layer is one matrix product for all points.

Its slopes are computed once, whatever is asked.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from kpirl_ocp.ocp.models.activations import Slopes
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.ocp.models.mlp import pull_tangent, push


@dataclass(frozen=True, eq=False)
class NetworkPoints:
    """See `kpirl_ocp.ocp.conditions.stage_points.Points`; psi is not used."""

    dynamics: NetworkDynamics
    states: ca.MX
    actions: ca.MX
    psi: ca.MX
    costates: ca.MX

    @property
    def pulled(self) -> ca.MX:
        """See `Points`."""
        return ca.vertcat(*self.dynamics.pulled(self._slopes, self.costates))

    def moved(self, x: ca.MX) -> ca.MX:
        """See `Points`."""
        n_s = self.dynamics.n_states
        by_network, _ = push(self.dynamics.mlp, self._slopes, x)
        return self.dynamics.successor(x[:n_s, :], by_network, x[n_s:, :])

    def pulled_tangent(self, x: ca.MX, dcostates: ca.MX) -> ca.MX:
        """See `Points`."""
        adjoints = self._of_network(self.costates), x, self._of_network(dcostates)
        by_network, _ = pull_tangent(self.dynamics.mlp, self._slopes, *adjoints)
        return by_network + self.dynamics.linear.T @ dcostates

    @cached_property
    def _slopes(self) -> list[Slopes]:
        return self.dynamics.mlp.linearise(ca.vertcat(self.states, self.actions))[1]

    def _of_network(self, costates: ca.MX) -> ca.MX:
        return costates[: self.dynamics.n_z, :]
