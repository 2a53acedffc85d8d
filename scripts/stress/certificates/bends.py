"""Laws of psi that bend or jump, in every place where psi can stand."""

from typing import NamedTuple

import casadi as ca
import numpy as np

from stress.certificates.distances import DUE, gap
from stress.certificates.law import Branch, Law, branch


class Bend(NamedTuple):
    """A function of x with a kink or a jump at 0: its expression, value and derivative; what the latter is at 0."""

    expression: object
    value: object
    slope: object
    at_zero: float | None


BENDS = (
    Bend(ca.fabs, abs, np.sign, None),
    Bend(lambda x: ca.fmax(x, 0), lambda x: max(x, 0.0), lambda x: float(x > 0), None),
    Bend(lambda x: ca.fmin(2 * x, 0.3 * x), lambda x: min(2 * x, 0.3 * x), lambda x: 0.3 if x > 0 else 2.0, None),
    Bend(ca.floor, np.floor, lambda x: 0.0, None),
    Bend(lambda x: ca.if_else(x >= 0, 0.3, -0.2), lambda x: 0.3 if x >= 0 else -0.2, lambda x: 0.0, None),
    Bend(lambda x: ca.if_else(x > 0, 1 + x, x), lambda x: x + float(x > 0), lambda x: 1.0, None),
    Bend(lambda x: ca.if_else(x > 0, 2 * x, x), lambda x: 2 * x if x > 0 else x, lambda x: 2.0 if x > 0 else 1.0, None),
    Bend(lambda x: x * ca.fabs(x), lambda x: x * abs(x), lambda x: 2 * abs(x), 0.0),
    Bend(lambda x: ca.fmax(x, 0) ** 2, lambda x: max(x, 0.0) ** 2, lambda x: 2 * max(x, 0.0), 0.0),
    Bend(lambda x: ca.sqrt(ca.fabs(x)), lambda x: np.sqrt(abs(x)), lambda x: np.sign(x) / 2 / np.sqrt(abs(x)), None),
)


def _draw(rng):
    """phi(p) as an expression of p, its value and its slope, p, and whether it is smooth around it."""
    bend, g = BENDS[rng.integers(len(BENDS))], gap(rng)
    k, c, q = rng.uniform(0.3, 2), rng.uniform(1.5, 3), rng.choice([0.0, rng.normal()])
    x = (q + g) - q  # as the expression sees it
    slope = bend.at_zero if x == 0 else bend.slope(x)
    slope = None if slope is None else k * slope
    return lambda p: c + k * bend.expression(p - q), c + k * bend.value(x), slope, q + g, abs(g) > DUE


def _times(slope, factor):
    return None if slope is None else slope * np.asarray(factor)


def in_the_target(rng):
    """v = phi(p)."""
    phi, value, slope, p, due = _draw(rng)
    return Law(cost=lambda v, q: (v - phi(q)) ** 2, p=p, branches=(branch(value, slope),), due=due)


def in_a_weight(rng):
    """v = (phi a + b) / (phi + 1)."""
    phi, value, slope, p, due = _draw(rng)
    a, b = rng.normal(size=2)
    found = branch((value * a + b) / (value + 1), _times(slope, (a - b) / (value + 1) ** 2))
    return Law(cost=lambda v, q: phi(q) * (v - a) ** 2 + (v - b) ** 2, p=p, branches=(found,), due=due)


def in_an_inequality(rng):
    """v <= phi(p), out of reach of the target."""
    phi, value, slope, p, due = _draw(rng)
    target = value + rng.uniform(1, 3)
    return Law(
        cost=lambda v, q: (v - target) ** 2,
        inequality=lambda v, q: v - phi(q),
        p=p,
        branches=(branch(value, slope),),
        due=due,
    )


def in_an_inequality_that_does_not_count(rng):
    """v <= phi(p) far away: phi may do what it likes."""
    phi, value, _, p, _ = _draw(rng)
    return Law(
        cost=lambda v, q: (v - q) ** 2 + 0 * value,
        inequality=lambda v, q: v - phi(q) - 20,
        p=p,
        branches=(branch(p, 1),),
        due=False,
    )


def in_an_equality(rng):
    """v_0 + v_1 = phi(p)."""
    phi, value, slope, p, due = _draw(rng)
    found = branch([value / 2] * 2, _times(slope, [0.5, 0.5]))
    return Law(
        cost=lambda v, q: ca.sumsqr(v), equality=lambda v, q: v[0] + v[1] - phi(q), p=p, branches=(found,), due=due, n=2
    )


def in_the_dynamics(rng):
    """v = a, and phi(p) drifts."""
    phi, value, slope, p, due = _draw(rng)
    a = rng.normal()
    return Law(
        cost=lambda v, q: (v - a) ** 2,
        p=p,
        branches=(branch(a, 0),),
        due=due,
        drift=phi,
        drift_branch=Branch(np.array([value]), None if slope is None else np.array([slope])),
    )


LAWS = (
    in_the_target,
    in_a_weight,
    in_an_inequality,
    in_an_inequality_that_does_not_count,
    in_an_equality,
    in_the_dynamics,
)
