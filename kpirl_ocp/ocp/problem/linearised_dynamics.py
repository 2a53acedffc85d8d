"""The dynamics linearised at many points at once, with their curvature; as expressions.

S and Lambda are (n_s, B), U is (n_u, B), x = (s, u) is (n_x, B), F = df/dx, and psi is (n_psi, B), or (0, B) where the
dynamics do not depend on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Protocol

import casadi as ca

from kpirl_ocp.ocp.problem.statement.expressions import inputs_of


class LinearisedDynamics(Protocol):
    """The linearisation of f at B points, with costates Lambda (n_s, B)."""

    @property
    def value(self) -> ca.MX:
        """The values of f (n_s, B)."""
        ...

    @property
    def Ft_lambda(self) -> ca.MX:
        """F' lambda (n_x, B)."""
        ...

    def Ft_lambda_tangent(self, x: ca.MX, dcostates: ca.MX) -> ca.MX:
        """The change of `Ft_lambda` along (x, dlambda): (lambda . f)'' x + F' dlambda (n_x, B)."""
        ...

    def second(self) -> tuple[ca.Function, list[ca.MX]]:
        """A function of one point -> f, F (n_s, n_x), (lambda . f)'' (n_x, n_x); and its arguments, B columns each.

        Whatever is better computed for all points at once is already computed in the arguments.
        """
        ...


@dataclass(frozen=True, eq=False)
class LinearisedByStage:
    """Any dynamics f(s, u, psi), point by point with CasADi's AD; see `LinearisedDynamics`."""

    dynamics: ca.Function
    states: ca.MX
    actions: ca.MX
    psi: ca.MX
    costates: ca.MX

    @property
    def value(self) -> ca.MX:
        """The values of f (n_s, B)."""
        return self._first[0]

    @property
    def Ft_lambda(self) -> ca.MX:
        """F' lambda (n_x, B)."""
        return ca.vertcat(*self._first[1:])

    def Ft_lambda_tangent(self, x: ca.MX, dcostates: ca.MX) -> ca.MX:
        """The change of `Ft_lambda`."""
        change: ca.MX = _tangent(self.dynamics).map(self.states.size2())(*self._at, x, dcostates)
        return change

    def second(self) -> tuple[ca.Function, list[ca.MX]]:
        """The function evaluates everything by itself; its arguments are the points and costates."""
        return second_derivatives(self.dynamics), self._at

    @cached_property
    def _at(self) -> list[ca.MX]:
        return [self.states, self.actions, self.psi, self.costates]

    @cached_property
    def _first(self) -> list[ca.MX]:
        return list(first_derivatives(self.dynamics).map(self.states.size2()).call(self._at))


@lru_cache(maxsize=64)
def first_derivatives(dynamics: ca.Function) -> ca.Function:
    """(s, u, psi, lambda) -> f, f_s^T lambda (n_s,), f_u^T lambda (n_u,); an SX function if f is one."""
    s, u, psi, lam, value = _symbols(dynamics)
    pairing = ca.dot(lam, value)
    outputs = ca.cse([value, *(ca.gradient(pairing, x) for x in (s, u))])
    return _without_unused_psi(ca.Function("first", [s, u, psi, lam], outputs), dynamics)


@lru_cache(maxsize=64)
def second_derivatives(dynamics: ca.Function) -> ca.Function:
    """(s, u, psi, lambda) -> f, (f_s, f_u) (n_s, n_x), second derivative of lambda . f by (s, u) (n_x, n_x)."""
    s, u, psi, lam, value = _symbols(dynamics)
    pairing = ca.dot(lam, value)
    slope = ca.vertcat(ca.gradient(pairing, s), ca.gradient(pairing, u))
    hessian = ca.cse(ca.horzcat(ca.jacobian(slope, s), ca.jacobian(slope, u)))
    outputs = ca.cse([value, ca.horzcat(ca.jacobian(value, s), ca.jacobian(value, u)), hessian])
    return _without_unused_psi(ca.Function("second", [s, u, psi, lam], outputs), dynamics)


@lru_cache(maxsize=64)
def _tangent(dynamics: ca.Function) -> ca.Function:
    """(s, u, psi, lambda, x, dlambda) -> the change of F' lambda (n_x,)."""
    first = first_derivatives(dynamics)
    s, u, psi, costate = first.mx_in()
    x, dcostate = ca.MX.sym("x", s.numel() + u.numel()), ca.MX.sym("dlambda", s.numel())
    _, *Ft_lambda = first(s, u, psi, costate)
    change = ca.jtimes(ca.vertcat(*Ft_lambda), ca.vertcat(s, u, costate), ca.vertcat(x, dcostate))
    return ca.Function("tangent", [s, u, psi, costate, x, dcostate], [ca.densify(change)])


@lru_cache(maxsize=64)
def depends_on_psi(dynamics: ca.Function) -> bool:
    """True if f(s, u, psi) depends on psi."""
    return bool(dynamics.jac_sparsity(0, 2).nnz())


def without_psi(function: ca.Function) -> ca.Function:
    """A function (s, u, psi, ..) of dynamics that do not depend on psi, with an empty psi.

    Repeating psi for every stage takes O(T^2) memory where psi has numbers for every step.
    """
    s, u, psi, *others = function.mx_in()
    outputs = function.call([s, u, ca.MX.zeros(psi.shape), *others], True, False)
    return ca.Function(function.name(), [s, u, ca.MX.sym("psi", 0), *others], outputs)


def _without_unused_psi(function: ca.Function, dynamics: ca.Function) -> ca.Function:
    return function if depends_on_psi(dynamics) else without_psi(function)


def _symbols(dynamics: ca.Function) -> tuple[ca.SX | ca.MX, ...]:
    """Symbols s, u, psi and lambda, and the expression f."""
    s, u, psi = inputs_of(dynamics)
    return s, u, psi, type(s).sym("lam", s.numel()), dynamics(s, u, psi)
