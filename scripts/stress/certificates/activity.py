"""Laws of constraints that begin to count: v = min(p, q), stated in several ways."""

import casadi as ca
import numpy as np

from stress.certificates.distances import DUE, gap
from stress.certificates.law import Law, branch


def _minimum(rng):
    q, g = rng.normal(), gap(rng)
    slope = None if g == 0 else float(g < 0)
    return q, {"p": q + g, "branches": (branch(min(q, q + g), slope),), "due": abs(g) > DUE}


def _ridge(v, p):
    return (v - p) ** 2


def bound(rng):
    """v <= q as a bound."""
    q, law = _minimum(rng)
    return Law(cost=_ridge, upper=q, **law)


def path(rng):
    """k (v - q) <= 0 in any units."""
    q, law = _minimum(rng)
    k = 10 ** rng.uniform(-3, 3)
    return Law(cost=_ridge, inequality=lambda v, p: k * (v - q), **law)


def curved(rng):
    """exp v <= exp q."""
    q, law = _minimum(rng)
    return Law(cost=_ridge, inequality=lambda v, p: ca.exp(v) - np.exp(q), **law)


def kinked_constraint(rng):
    """max(v - q, 2 (v - q)) <= 0 has its kink where it begins to count."""
    q, law = _minimum(rng)
    law |= {"due": law["due"] and law["p"] < q}
    return Law(cost=_ridge, inequality=lambda v, p: ca.fmax(v - q, 2 * (v - q)), **law)


def moving_limit(rng):
    """v <= p with the target q: v = min(p, q)."""
    q, g = rng.normal(), gap(rng)
    slope = None if g == 0 else float(g < 0)
    return Law(
        cost=lambda v, p: (v - q) ** 2,
        inequality=lambda v, p: v - p,
        p=q + g,
        branches=(branch(min(q, q + g), slope),),
        due=abs(g) > DUE,
    )


def crossing_limits(rng):
    """v <= p and v <= 2 q - p with the target out of reach: both are strongly active where they cross."""
    q, g, beyond = rng.normal(), gap(rng), rng.uniform(1, 3)
    slope = None if g == 0 else -np.sign(g)
    return Law(
        cost=lambda v, p: (v - q - beyond) ** 2,
        inequality=lambda v, p: ca.vertcat(v - p, v - 2 * q + p),
        p=q + g,
        branches=(branch(q - abs(g), slope),),
        due=abs(g) > DUE,
    )


def corner_of_three(rng):
    """Two actions in a corner where a third constraint passes: v = (p, p) up to where v_0 + v_1 <= 2 q cuts it off."""
    q, g, beyond = rng.normal(), gap(rng), rng.uniform(1, 3)
    slope = None if g == 0 else [float(g < 0)] * 2
    return Law(
        cost=lambda v, p: ca.sumsqr(v - q - beyond),
        inequality=lambda v, p: ca.vertcat(v - p, v[0] + v[1] - 2 * q),
        p=q + g,
        branches=(branch([q + min(g, 0)] * 2, slope),),
        due=abs(g) > DUE,
        n=2,
    )


LAWS = (bound, path, curved, kinked_constraint, moving_limit, crossing_limits, corner_of_three)
