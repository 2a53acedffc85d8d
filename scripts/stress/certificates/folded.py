"""Laws whose cost has a kink in v itself: ReLU, absolute values, and bends of the slope."""

import casadi as ca
import numpy as np

from stress.certificates.distances import DUE, gap
from stress.certificates.law import Law, branch


def relu_cost(rng):
    """(v - p)^2 + 2 k relu(v - q): v = p, then it is held at q, then v = p - k."""
    q, k, g = rng.normal(), rng.uniform(0.2, 1.5), gap(rng)
    edge = rng.choice(2)  # where it begins to be held, and where it leaves
    p = q + edge * k + g
    x = p - q
    v = p if x < 0 else q if x <= k else p - k
    held = 0 <= x <= k
    slope = None if g == 0 else 0.0 if held else 1.0
    return Law(
        cost=lambda v, r: (v - r) ** 2 + 2 * k * ca.fmax(v - q, 0),
        p=p,
        branches=(branch(v, slope),),
        due=abs(g) > DUE and not held,
    )


def absolute_cost(rng):
    """(v - p)^2 + 2 k |v - q|: soft thresholding."""
    q, k, g = rng.normal(), rng.uniform(0.2, 1.5), gap(rng)
    p = q + rng.choice([-1, 1]) * k + g
    x = p - q
    v, held = q + np.sign(x) * max(abs(x) - k, 0), abs(x) <= k
    slope = None if g == 0 else float(not held)
    return Law(
        cost=lambda v, r: (v - r) ** 2 + 2 * k * ca.fabs(v - q),
        p=p,
        branches=(branch(v, slope),),
        due=abs(g) > DUE and not held,
    )


def bent_slope(rng):
    """(v - p)^2 + k |v - q| (v - q): dv/dp is 1 / (1 + k) above q and 1 / (1 - k) below."""
    q, k, g = rng.normal(), rng.uniform(0.1, 0.8), gap(rng)
    slope = 1 / (1 + k) if g > 0 else 1 / (1 - k)
    return Law(
        cost=lambda v, p: (v - p) ** 2 + k * ca.fabs(v - q) * (v - q),
        p=q + g,
        branches=(branch(q + g * slope, None if g == 0 else slope),),
        due=abs(g) > DUE,
    )


def squared_relu(rng):
    """(v - p)^2 + k relu(v - q)^2."""
    q, k, g = rng.normal(), rng.uniform(0.2, 3), gap(rng)
    slope = 1 / (1 + k) if g > 0 else 1.0
    return Law(
        cost=lambda v, p: (v - p) ** 2 + k * ca.fmax(v - q, 0) ** 2,
        p=q + g,
        branches=(branch(q + g * slope, None if g == 0 else slope),),
        due=abs(g) > DUE,
    )


def relu_network(rng):
    """A target that a ReLU network makes of p, one unit of which is on or beside its kink."""
    q, g = rng.normal(), gap(rng)
    p = q + g
    inner, outer = rng.uniform(0.3, 1.5, 4) * rng.choice([-1, 1], 4), rng.normal(size=4)
    offsets = -inner * q + np.array([0.0, 1.0, -1.0, 2.0])  # unit 0 bends at q, the others elsewhere
    x = inner * p + offsets
    x[0] = inner[0] * g
    value, on = float(outer @ np.maximum(x, 0)), (x > 0).astype(float)
    slope = None if g == 0 else float(outer @ (on * inner))
    return Law(
        cost=lambda v, r: (
            (v - ca.dot(outer, ca.fmax(ca.vertcat(inner[0] * (r - q), inner[1:] * r + offsets[1:]), 0))) ** 2
        ),
        p=p,
        branches=(branch(value, slope),),
        due=abs(g) > DUE and (np.abs(x[1:]) > DUE).all(),
    )


def stepped_cost(rng):
    """A price to be paid beyond q: v = p is a minimum everywhere but at q, and the edge q is one for p > q."""
    q, g, price = rng.normal(), gap(rng), rng.uniform(0.2, 1)
    p = q + g
    ends = [branch(p, None if g == 0 else 1)] + ([branch(q, 0)] if g > 0 else [])
    return Law(
        cost=lambda v, r: (v - r) ** 2 + ca.if_else(v > q, price, 0),
        p=p,
        branches=tuple(ends),
        due=g < -DUE,
        start=np.array([p]),
    )


LAWS = (relu_cost, absolute_cost, bent_slope, squared_relu, relu_network, stepped_cost)
