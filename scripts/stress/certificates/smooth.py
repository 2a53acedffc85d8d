"""Laws without a kink anywhere near."""

import casadi as ca
import numpy as np
from scipy.optimize import brentq

from stress.certificates.law import Law, branch


def ridge(rng):
    """v = p."""
    p, w = rng.normal(), rng.uniform(0.2, 3)
    return Law(cost=lambda v, q: w * (v - q) ** 2, p=p, branches=(branch(p, 1),), due=True)


def sine(rng):
    """v = sin p."""
    p = rng.uniform(-3, 3)
    return Law(cost=lambda v, q: (v - ca.sin(q)) ** 2, p=p, branches=(branch(np.sin(p), np.cos(p)),), due=True)


def quartic(rng):
    """v - p + 2 k v^3 = 0."""
    p, k = rng.uniform(-2, 2), rng.uniform(0.1, 2)
    v = brentq(lambda v: v - p + 2 * k * v**3, -3, 3, xtol=1e-15)
    slope = 1 / (1 + 6 * k * v**2)
    return Law(cost=lambda v, q: (v - q) ** 2 + k * v**4, p=p, branches=(branch(v, slope),), due=True)


def exponential(rng):
    """v = log p."""
    p = rng.uniform(0.2, 5)
    return Law(cost=lambda v, q: ca.exp(v) - q * v, p=p, branches=(branch(np.log(p), 1 / p),), due=True)


def pair(rng):
    """v = (p, p^2)."""
    p = rng.uniform(-1.5, 1.5)
    found = branch([p, p**2], [1, 2 * p])
    return Law(cost=lambda v, q: (v[0] - q) ** 2 + (v[1] - q * v[0]) ** 2, p=p, branches=(found,), due=True, n=2)


def softplus(rng):
    """sigmoid(v) = p."""
    p = rng.uniform(0.1, 0.9)
    found = branch(np.log(p / (1 - p)), 1 / (p * (1 - p)))
    return Law(cost=lambda v, q: ca.log1p(ca.exp(v)) - q * v, p=p, branches=(found,), due=True)


def on_a_circle(rng):
    """A target outside the disc |v| <= p."""
    p, angle = rng.uniform(0.3, 2), rng.uniform(0, 2 * np.pi)
    way = np.array([np.cos(angle), np.sin(angle)])
    target = way * (p + rng.uniform(0.3, 2))
    return Law(
        cost=lambda v, q: ca.sumsqr(v - target),
        inequality=lambda v, q: ca.sumsqr(v) - q**2,
        p=p,
        branches=(branch(p * way, way),),
        due=True,
        n=2,
    )


def on_a_line(rng):
    """The point of a.v = p that is closest to the origin."""
    p, a = rng.normal(), rng.normal(size=2)
    found = branch(a * p / (a @ a), a / (a @ a))
    return Law(
        cost=lambda v, q: ca.sumsqr(v), equality=lambda v, q: ca.dot(a, v) - q, p=p, branches=(found,), due=True, n=2
    )


def far_constraints(rng):
    """Constraints that are nowhere near."""
    p = rng.normal()
    return Law(
        cost=lambda v, q: (v - q) ** 2,
        inequality=lambda v, q: ca.vertcat(v - q - 3, -v + q - 5),
        upper=p + 4,
        p=p,
        branches=(branch(p, 1),),
        due=True,
    )


LAWS = (ridge, sine, quartic, exponential, pair, softplus, on_a_circle, on_a_line, far_constraints)
