"""The dynamics at B points at once, linearised, with the curvature along a direction; as expressions.

S and Lambda are (n_s, B), U is (n_u, B), x = (s, u) is (n_x, B), and psi is (n_psi, B), or (0, B) where the dynamics do
not depend on it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Protocol

import casadi as ca

from kpirl_ocp.ocp.problem.ocp import OCP


class Points(Protocol):
    """f at B points with costates Lambda."""

    @property
    def pulled(self) -> ca.MX:
        """F' lambda (n_x, B)."""
        ...

    def moved(self, x: ca.MX) -> ca.MX:
        """F x (n_s, B)."""
        ...

    def pulled_tangent(self, x: ca.MX, dcostates: ca.MX) -> ca.MX:
        """How `pulled` changes along (x, dlambda): (lambda . f)'' x + F' dlambda (n_x, B)."""
        ...


def points(problem: OCP, states: ca.MX, actions: ca.MX, psi: ca.MX, costates: ca.MX) -> Points:
    """As the dynamics bring them along, else by AD."""
    given = problem.dynamics_derivatives.points
    return (given or StagePoints.of(problem))(states, actions, psi, costates)


@dataclass(frozen=True, eq=False)
class StagePoints:
    """Of any dynamics, point by point. derivatives: `first` and its tangent, of one point."""

    first: ca.Function
    states: ca.MX
    actions: ca.MX
    psi: ca.MX
    costates: ca.MX

    @classmethod
    def of(cls, problem: OCP) -> Callable[[ca.MX, ca.MX, ca.MX, ca.MX], StagePoints]:
        """For the dynamics of a problem."""
        return partial(cls, problem.dynamics_derivatives.first(1))

    @property
    def pulled(self) -> ca.MX:
        """See `Points`."""
        return ca.vertcat(*self._map(self.first)()[1:])

    def moved(self, x: ca.MX) -> ca.MX:
        """See `Points`."""
        return self._map(_tangent(self.first))(x, ca.MX.zeros(self.costates.shape))[0]

    def pulled_tangent(self, x: ca.MX, dcostates: ca.MX) -> ca.MX:
        """See `Points`."""
        return self._map(_tangent(self.first))(x, dcostates)[1]

    def _map(self, stage: ca.Function) -> Callable[..., list[ca.MX]]:
        at = self.states, self.actions, self.psi, self.costates
        return lambda *directions: stage.map(self.states.size2()).call([*at, *directions])


@lru_cache(maxsize=64)
def _tangent(first: ca.Function) -> ca.Function:
    """(s, u, psi, lambda, x, dlambda) -> F x, and the change of F' lambda."""
    s, u, psi, costate = first.mx_in()
    x, dcostate = ca.MX.sym("x", s.numel() + u.numel()), ca.MX.sym("dlambda", s.numel())
    value, *pulled = first(s, u, psi, costate)
    changes = ca.jtimes(ca.vertcat(value, *pulled), ca.vertcat(s, u, costate), ca.vertcat(x, dcostate))
    moved, pulled = ca.vertsplit(changes, [0, s.numel(), changes.numel()])
    return ca.Function("tangent", [s, u, psi, costate, x, dcostate], [ca.densify(y) for y in (moved, pulled)])
