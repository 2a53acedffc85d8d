"""Discrete dynamics of a differential equation, by CasADi's integrators."""

from __future__ import annotations

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
    parts = [ode, step] if residual is None else [ode, step, residual]
    others = _others(parts, [state] if algebraic is None else [state, algebraic])
    if method == "rk4":
        return _rk4(ode, state, step, others, intervals)
    return _implicit(ode, state, step, others, algebraic, residual, method, intervals, degree)


def _others(expressions: list[Any], known: list[Expression]) -> list[Expression]:
    """The symbols in expressions that are not known."""
    kind = type(known[0])
    hidden = {identity(part) for symbol in known for part in ca.symvar(symbol)}
    found = ca.symvar(ca.veccat(*map(kind, expressions)))
    return [symbol for symbol in found if identity(symbol) not in hidden]


def _rk4(
    ode: Expression, state: Expression, step: Expression | float, others: list[Expression], intervals: int
) -> Expression:
    slope = ca.Function("ode", [state, *others], [ode])
    part, s = step / intervals, state
    for _ in range(intervals):
        first = slope(s, *others)
        second = slope(s + part / 2 * first, *others)
        third = slope(s + part / 2 * second, *others)
        fourth = slope(s + part * third, *others)
        s = s + part / 6 * (first + 2 * second + 2 * third + fourth)
    return s


def _implicit(
    ode: ca.MX,
    state: ca.MX,
    step: ca.MX | float,
    others: list[ca.MX],
    algebraic: ca.MX | None,
    residual: ca.MX | None,
    method: str,
    intervals: int,
    degree: int,
) -> ca.MX:
    """One step in the time tau = t / step, so that the step may be an expression."""
    inputs = [state, *others] if algebraic is None else [state, algebraic, *others]
    outputs = [step * ode] if residual is None else [step * ode, residual]
    equations = ca.Function("equations", inputs, outputs)
    p = ca.MX.sym("p", sum(symbol.numel() for symbol in others))
    ends = np.cumsum([0, *(symbol.numel() for symbol in others)]).tolist()
    numbers = [ca.reshape(part, *symbol.shape) for part, symbol in zip(ca.vertsplit(p, ends), others, strict=True)]
    names = ["x"] if algebraic is None else ["x", "z"]
    variables = [ca.MX.sym(name, symbol.numel()) for name, symbol in zip(names, inputs, strict=False)]
    values = equations.call([*variables, *numbers])
    dae = dict(zip(names, variables, strict=True)) | dict(zip(("ode", "alg"), values, strict=False)) | {"p": p}
    plugin = "collocation" if method == "midpoint" else method
    integrator = ca.integrator("step", plugin, dae, 0.0, 1.0, _options(method, intervals, degree))
    return integrator(x0=state, p=ca.veccat(*others))["xf"]


def _options(method: str, intervals: int, degree: int) -> dict[str, Any]:
    if method in ("cvodes", "idas"):
        return dict(_ADAPTIVE)
    scheme = {"collocation_scheme": "legendre", "interpolation_order": 1}
    if method == "collocation":
        scheme = {"collocation_scheme": "radau", "interpolation_order": degree}
    newton = {"rootfinder": "newton", "rootfinder_options": {"abstol": _TOLERANCE}}
    return {"number_of_finite_elements": intervals, **scheme, **newton}
