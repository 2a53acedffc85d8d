"""Activation functions with their first two derivatives, written to stay accurate at any argument.

NaN stays NaN in every one (fmax and fmin would lose it), and nothing overflows on the way to a finite value.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca


@dataclass(frozen=True)
class Slopes:
    """sigma'(a) and sigma''(a), entry by entry; None stands for a slope of one, or for no curvature anywhere.

    kink: the numbers at whose zeros sigma' or sigma'' jumps; None where sigma is smooth.
    value: sigma(a), where sigma''(a) follows from it and sigma'(a) as in `SECOND_OF_VALUE`.
    """

    first: ca.MX | None
    second: ca.MX | None
    kink: ca.MX | None = None
    value: ca.MX | None = None


def relu(a: ca.MX) -> tuple[ca.MX, Slopes]:
    """max(a, 0); the slope at the kink is zero, as in torch. One product: an overflow to -infinity shows as NaN."""
    slope = a > 0
    return slope * a, Slopes(slope, None, a)


def leaky_relu(a: ca.MX) -> tuple[ca.MX, Slopes]:
    """The argument where it is positive, a hundredth of it elsewhere (the default of torch)."""
    slope = 0.01 + 0.99 * (a > 0)
    return slope * a, Slopes(slope, None, a)


def identity(a: ca.MX) -> tuple[ca.MX, Slopes]:
    """The argument itself."""
    return a, Slopes(None, None)


def tanh(a: ca.MX) -> tuple[ca.MX, Slopes]:
    """tanh a."""
    y = ca.tanh(a)
    slope = 1 - y * y
    return y, Slopes(slope, -2 * y * slope, value=y)


def sigmoid(a: ca.MX) -> tuple[ca.MX, Slopes]:
    """1 / (1 + e^-a)."""
    y, other = _logistic(a)
    return y, Slopes(y * other, y * other * (other - y))


def softplus(a: ca.MX) -> tuple[ca.MX, Slopes]:
    """log(1 + e^a). Torch returns the argument itself above 20, which is up to 2e-9 less."""
    y, other = _logistic(a)
    return ca.if_else(a < 0, 0, a) + ca.log1p(ca.exp(-ca.fabs(a))), Slopes(y, y * other)


def silu(a: ca.MX) -> tuple[ca.MX, Slopes]:
    """a sigmoid(a)."""
    y, other = _logistic(a)
    return a * y, Slopes(y + a * y * other, y * other * (2 + a * (other - y)))


def elu(a: ca.MX) -> tuple[ca.MX, Slopes]:
    """The argument where it is positive, e^a - 1 elsewhere; the curvature jumps at zero."""
    positive = a > 0
    negative = ca.if_else(positive, 0, a)
    growth = ca.exp(negative)
    return ca.if_else(positive, a, 0) + ca.expm1(negative), Slopes(growth, ca.if_else(positive, 0, growth), a)


def _logistic(a: ca.MX) -> tuple[ca.MX, ca.MX]:
    """sigmoid(a) and sigmoid(-a), each to full relative accuracy."""
    tail = ca.exp(-ca.fabs(a))
    large = 1 / (1 + tail)
    small = tail * large
    positive = a > 0
    return ca.if_else(positive, large, small), ca.if_else(positive, small, large)


Activation = Callable[[ca.MX], tuple[ca.MX, Slopes]]
"""a -> sigma(a) and its slopes."""

ACTIVATIONS: dict[str, Activation] = {
    "elu": elu,
    "identity": identity,
    "leaky_relu": leaky_relu,
    "relu": relu,
    "sigmoid": sigmoid,
    "silu": silu,
    "softplus": softplus,
    "tanh": tanh,
}

SECOND_OF_VALUE: dict[str, Callable[[ca.MX, ca.MX], ca.MX]] = {"tanh": lambda y, slope: -2 * y * slope}
"""(sigma(a), sigma'(a)) -> sigma''(a), for activations of which the value may be kept in place of sigma''(a)."""

SCALES: dict[str, tuple[float, float]] = {
    "elu": (1.0, 1.0),
    "identity": (1.0, 0.0),
    "leaky_relu": (1.0, 0.0),
    "relu": (1.0, 0.0),
    "sigmoid": (0.25, 0.71),
    "silu": (1.1, 0.54),
    "softplus": (1.0, 0.32),
    "tanh": (1.0, 1.42),
}
"""(L, c): away from kinks, the first three derivatives are at most L, c L and c^2 L in absolute value."""
