"""Functions without a kink that are as steep as one: sigmoids, bumps, waves, rounded corners, and networks of them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np
from scipy.special import erf, expit

from stress.certificates.distances import DUE

_EARLY, _LATE = 1e2, 40.0  # steepness that is none; tails in which an exponential is gone


class Steep(NamedTuple):
    """A function of x = k z: its expression, its value and its derivative. tail: how it comes to its end."""

    expression: Callable
    value: Callable
    slope: Callable
    tail: str


def _sech2(x):
    return 4 * np.exp(-2 * np.abs(x)) / (1 + np.exp(-2 * np.abs(x))) ** 2


_TANH = Steep(ca.tanh, np.tanh, _sech2, "exponential")
_SIGMOID = Steep(lambda x: 0.5 + ca.tanh(x / 2) / 2, expit, lambda x: _sech2(x / 2) / 4, "exponential")
_ATAN = Steep(ca.atan, np.arctan, lambda x: 1 / (1 + x**2), "algebraic")
_RISE = Steep(
    lambda x: x / ca.sqrt(1 + x**2), lambda x: x / np.sqrt(1 + x**2), lambda x: (1 + x**2) ** -1.5, "algebraic"
)
JUMPS = (
    _TANH,
    _SIGMOID,
    _ATAN,
    _RISE,
    Steep(ca.erf, erf, lambda x: 2 / np.sqrt(np.pi) * np.exp(-(x**2)), "exponential"),
    Steep(lambda x: ca.exp(-(x**2)), lambda x: np.exp(-(x**2)), lambda x: -2 * x * np.exp(-(x**2)), "exponential"),
)
CORNERS = (  # divided by k
    Steep(lambda x: ca.sqrt(x**2 + 1), lambda x: np.sqrt(x**2 + 1), lambda x: x / np.sqrt(x**2 + 1), "algebraic"),
    Steep(lambda x: ca.fmax(x, 0) + ca.log1p(ca.exp(-ca.fabs(x))), lambda x: np.logaddexp(0, x), expit, "exponential"),
    Steep(ca.sin, np.sin, np.cos, "none"),
    _TANH,  # of no height, but with a slope of 1 at 0
)
# Derivatives of convex functions, with those: a cost may bend like this in the action.
BENDS = (
    (_RISE, lambda z, k: ca.sqrt(z**2 + k**-2), 1.0),
    (_ATAN, lambda z, k: z * ca.atan(k * z) - ca.log1p((k * z) ** 2) / (2 * k), 1.0),
    (_TANH, lambda z, k: ca.fabs(z) + ca.log1p(ca.exp(-2 * k * ca.fabs(z))) / k, 1.0),
    (CORNERS[2], lambda z, k: -ca.cos(k * z) / k**2, 0.0),  # sin, divided by k
)


@dataclass(frozen=True)
class Function:
    """The sum of heights times steep functions of k (z - place); one of them rises at or beside z."""

    shape: Steep
    heights: np.ndarray
    steepness: np.ndarray
    places: np.ndarray

    def expression(self, z):
        """In CasADi."""
        terms = zip(self.heights, self.steepness, self.places, strict=True)
        return sum(float(a) * self.shape.expression(float(k) * (z - float(b))) for a, k, b in terms)

    def value(self, z):
        """(...,) at z (...,)."""
        return self.shape.value(self._inside(z)) @ self.heights

    def slope(self, z):
        """Its derivative by z."""
        return self.shape.slope(self._inside(z)) @ (self.heights * self.steepness)

    def _inside(self, z):
        return self.steepness * (np.asarray(z)[..., None] - self.places)

    def is_smooth(self, z) -> bool:
        """Whether it is smooth within DUE of all of z."""
        near = np.abs(np.asarray(z)[..., None] - self.places)
        beyond = self.steepness * (near - DUE) > _LATE
        gone = {"exponential": beyond, "algebraic": near > 2 * DUE, "none": np.zeros(near.shape, bool)}[self.shape.tail]
        return bool((gone | (np.abs(self.steepness) <= _EARLY)).all())


def steepness(rng) -> float:
    """From 1e1 to 1e10."""
    return 10 ** rng.uniform(1, 10)


def distance(rng, k: float) -> float:
    """0; or on the slope; or 1e-12 to 1e-3 to either side; or 0.02 to 0.5."""
    sign = rng.choice([-1.0, 1.0])
    choices = (0.0, rng.uniform(0, 3) / k, 10 ** rng.uniform(-12, -3), rng.uniform(0.02, 0.5))
    return sign * choices[rng.choice(4, p=[0.15, 0.3, 0.25, 0.3])]


def function(rng) -> tuple[Function, float]:
    """One of them, or a network's layer of them, and z at or beside its steepest place."""
    k, high = steepness(rng), rng.random() < 0.6
    shapes = JUMPS if high else CORNERS
    shape, units = shapes[rng.integers(len(shapes))], rng.choice([1, 4], p=[0.7, 0.3])
    ks = np.concatenate([[k], k * rng.uniform(0.1, 1, units - 1)])
    heights = rng.uniform(0.3, 1.5, units) * rng.choice([-1, 1], units) / (1.0 if high else ks)
    places = np.concatenate([[0.0], rng.normal(size=units - 1)])
    return Function(shape, heights, ks, places), distance(rng, k)
