"""Discrete dynamics of a differential equation, by CasADi's integrators."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.statement.expressions import Expression, identity

_TOLERANCE = 1e-12  # of the equations of an implicit step
_ADAPTIVE = {"abstol": 1e-11, "reltol": 1e-11}
_METHODS = ("rk4", "midpoint", "collocation", "cvodes", "idas")


def discretise(
    ode: Expression,
    state: Expression,
    *,
    step: Expression | float,
    method: str = "rk4",
    intervals: int = 1,
    degree: int = 3,
    algebraic: Expression | None = None,
    residual: Expression | None = None,
) -> Expression:
    """The state after one step of ds/dt = ode, with everything else constant: `dynamics` of `OCP.from_expressions`.

    Semi-explicit differential-algebraic equations ds/dt = ode(s, z, ..), 0 = residual(s, z, ..) too; and so an implicit
    equation F(ds/dt, s, ..) = 0: with z for ds/dt, ode = z and residual = F. All methods but "rk4" need MX symbols.

    Args:
        ode: ds/dt (n_s,), an expression of the state and of any other symbols.
        step: length of the step, in the unit of time of the ode; a number, or an expression such as q / T.
        method: "rk4", Runge-Kutta of order four; "midpoint", the implicit rule of order two, which keeps quadratic
            invariants; "collocation", Radau IIA of order 2 degree - 1, for stiff equations; "cvodes" and "idas", the
            adaptive methods of SUNDIALS, to 1e-11.
        intervals: equal parts of the step, for the first three methods.
        degree: of collocation.
        algebraic: z (n_z,), symbols.
        residual: (n_z,).

    Raises:
        ProblemError: no such method, a method that does not fit the equations, or shapes that do not fit.
    """
    if method not in _METHODS:
        raise ProblemError(f"method must be one of {', '.join(_METHODS)}; got {method!r}.")
    if intervals < 1 or degree < 1:
        raise ProblemError(f"intervals and degree must be at least 1, got {intervals!r} and {degree!r}.")
    if ode.shape != state.shape:
        raise ProblemError(f"ode must have the shape of the state, {state.shape}, got {ode.shape}.")
    if (algebraic is None) != (residual is None):
        raise ProblemError("algebraic and residual must be given together.")
    if algebraic is not None and method in ("rk4", "cvodes"):
        raise ProblemError(f"method {method!r} knows no algebraic variables: use 'collocation', 'midpoint' or 'idas'.")
    if method != "rk4" and not isinstance(state, ca.MX):
        raise ProblemError(f"method {method!r} needs casadi.MX symbols.")
    equations = _Equations(ode, residual, state, algebraic, step)
    return equations.rk4(intervals) if method == "rk4" else equations.integrated(method, intervals, degree)


@dataclass(frozen=True, eq=False)
class _Equations:
    """ds/dt = ode, 0 = residual in s = state and z = algebraic, and the length of a step."""

    ode: Expression
    residual: Expression | None
    state: Expression
    algebraic: Expression | None
    step: Expression | float

    @property
    def others(self) -> list[Expression]:
        """All symbols but s and z."""
        kind = type(self.state)
        known = [symbol for symbol in (self.state, self.algebraic) if symbol is not None]
        hidden = {identity(part) for symbol in known for part in ca.symvar(symbol)}
        values = [value for value in (self.ode, self.step, self.residual) if value is not None]
        return [symbol for symbol in ca.symvar(ca.veccat(*map(kind, values))) if identity(symbol) not in hidden]

    def rk4(self, intervals: int) -> Expression:
        """The classical method of Runge and Kutta."""
        others, part, s = self.others, self.step / intervals, self.state
        slope = ca.Function("ode", [self.state, *others], [self.ode])
        for _ in range(intervals):
            first = slope(s, *others)
            second = slope(s + part / 2 * first, *others)
            third = slope(s + part / 2 * second, *others)
            fourth = slope(s + part * third, *others)
            s = s + part / 6 * (first + 2 * second + 2 * third + fourth)
        return s

    def integrated(self, method: str, intervals: int, degree: int) -> ca.MX:
        """By an integrator of CasADi over tau = t / step in [0, 1], so that the step may be an expression."""
        others, p = self.others, ca.veccat(*self.others)
        unknowns = {"x": self.state} if self.algebraic is None else {"x": self.state, "z": self.algebraic}
        values = {"ode": self.step * self.ode} | ({} if self.residual is None else {"alg": self.residual})
        equations = ca.Function("equations", [*unknowns.values(), *others], list(values.values()))
        symbols = {name: ca.MX.sym(name, symbol.numel()) for name, symbol in (unknowns | {"p": p}).items()}
        ends = np.cumsum([0, *(symbol.numel() for symbol in others)]).tolist()
        split = zip(ca.vertsplit(symbols["p"], ends), others, strict=True)
        numbers = [ca.reshape(part, *symbol.shape) for part, symbol in split]
        written = equations.call([*(symbols[name] for name in unknowns), *numbers])
        dae = symbols | dict(zip(values, written, strict=True))
        plugin = "collocation" if method == "midpoint" else method
        integrator = ca.integrator("step", plugin, dae, 0.0, 1.0, _options(method, intervals, degree))
        return integrator(x0=self.state, p=p)["xf"]


def _options(method: str, intervals: int, degree: int) -> dict[str, Any]:
    if method in ("cvodes", "idas"):
        return dict(_ADAPTIVE)
    scheme = {"collocation_scheme": "legendre", "interpolation_order": 1}
    if method == "collocation":
        scheme = {"collocation_scheme": "radau", "interpolation_order": degree}
    newton = {"rootfinder": "newton", "rootfinder_options": {"abstol": _TOLERANCE}}
    return {"number_of_finite_elements": intervals, **scheme, **newton}
