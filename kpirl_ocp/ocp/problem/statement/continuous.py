"""Discrete dynamics of a differential equation, by CasADi's integrators."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.statement.checks import number, shown
from kpirl_ocp.ocp.problem.statement.expressions import Expression, identity
from kpirl_ocp.sizes import LONGEST

_TOLERANCE = 1e-12  # of the equations of an implicit step
_ADAPTIVE = {"abstol": 1e-11, "reltol": 1e-11}
_HIGHEST = 9  # degree of collocation in CasADi
_EXPANDED = 20_000  # scalar operations of the largest equations that are written in them; networks have more
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
    if not isinstance(method, str) or method not in _METHODS:
        raise ProblemError(f"method must be one of {', '.join(_METHODS)}; got {shown(method)}.")
    if not _counts(intervals, LONGEST) or not _counts(degree, _HIGHEST):
        raise ProblemError(
            f"intervals and degree must be at least 1, whole numbers, degree at most {_HIGHEST}; "
            f"got {shown(intervals)} and {shown(degree)}."
        )
    if (algebraic is None) != (residual is None):
        raise ProblemError("algebraic and residual must be given together.")
    _check_symbols("state", state, type(state))
    _check_expression("ode", "the shape of the state", ode, type(state), state.shape)
    if not isinstance(step, ca.SX | ca.MX):
        if not number("step", step, "a number that is finite, or an expression", -np.inf):
            raise ProblemError("step must not be 0: the state would never change.")
    else:
        _check_expression("step", "the shape of a number", step, type(state), (1, 1))
    if algebraic is not None:
        if method in ("rk4", "cvodes"):
            raise ProblemError(
                f"method {method!r} knows no algebraic variables: use 'collocation', 'midpoint' or 'idas'."
            )
        _check_symbols("algebraic", algebraic, type(state))
        _check_expression("residual", "the shape of algebraic", residual, type(state), algebraic.shape)
    if method != "rk4" and not isinstance(state, ca.MX):
        raise ProblemError(f"method {method!r} needs casadi.MX symbols.")
    equations = _Equations(ode, residual, state, algebraic, step)
    return equations.rk4(intervals) if method == "rk4" else equations.integrated(method, intervals, degree)


def _counts(value: object, most: int) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(1 <= value <= most)


def _check_symbols(name: str, value: Any, kind: type[Any]) -> None:
    if kind not in (ca.SX, ca.MX) or not isinstance(value, kind):
        raise ProblemError(f"{name} must be a column of CasADi symbols, like the state, got {shown(value)}.")
    if not value.is_column() or not value.numel() or not value.is_valid_input():
        raise ProblemError(f"{name} must be a column of CasADi symbols, got {shown(value)}.")


def _check_expression(name: str, like: str, value: Any, kind: type[Any], shape: tuple[int, int]) -> None:
    if not isinstance(value, kind):
        raise ProblemError(f"{name} must be a casadi.{kind.__name__} expression, as the state is, got {shown(value)}.")
    if value.shape != shape:
        raise ProblemError(f"{name} must have {like}, {shape}, got {value.shape}.")


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
        options = _options(method, intervals, degree, _in_scalars(equations))
        integrator = ca.integrator("step", plugin, dae, 0.0, 1.0, options)
        return integrator(x0=self.state, p=p)["xf"]


def _in_scalars(equations: ca.Function) -> bool:
    """Whether they can be written in scalar operations, in which CasADi solves and differentiates them much faster."""
    try:
        return bool(equations.expand().n_nodes() <= _EXPANDED)
    except RuntimeError:  # a linear system that is factorised at run time, for example
        return False


def _options(method: str, intervals: int, degree: int, expand: bool) -> dict[str, Any]:
    if method in ("cvodes", "idas"):
        return {**_ADAPTIVE, "expand": expand}
    scheme = {"collocation_scheme": "legendre", "interpolation_order": 1}
    if method == "collocation":
        scheme = {"collocation_scheme": "radau", "interpolation_order": degree}
    newton = {"rootfinder": "newton", "rootfinder_options": {"abstol": _TOLERANCE, "expand": expand}}
    return {"number_of_finite_elements": intervals, **scheme, **newton}
