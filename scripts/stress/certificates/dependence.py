"""Laws whose constraints depend on each other or repeat each other."""

import casadi as ca

from stress.certificates.law import Law, branch


def bound_and_path(rng):
    """The same limit twice, both active: v = q."""
    q, k = rng.normal(), 10 ** rng.uniform(-2, 2)
    return Law(
        cost=lambda v, p: (v - p) ** 2,
        upper=q,
        inequality=lambda v, p: k * (v - q),
        p=q + rng.uniform(0.1, 2),
        branches=(branch(q, 0),),
        due=False,
    )


def twice_the_same(rng):
    """v <= p twice."""
    p, k = rng.normal(), rng.uniform(0.5, 3)
    return Law(
        cost=lambda v, q: (v - q - 1) ** 2,
        inequality=lambda v, q: ca.vertcat(v - q, k * (v - q)),
        p=p,
        branches=(branch(p, 1),),
        due=False,
    )


def equality_twice(rng):
    """The same equality twice."""
    p = rng.normal()
    return Law(
        cost=lambda v, q: ca.sumsqr(v),
        equality=lambda v, q: ca.vertcat(v[0] + v[1] - q, 2 * (v[0] + v[1] - q)),
        p=p,
        branches=(branch([p / 2, p / 2], [0.5, 0.5]),),
        due=False,
        n=2,
    )


def tangent_limits(rng):
    """A disc that touches a half plane: one feasible point, no multipliers."""
    p = rng.uniform(0.5, 2)
    return Law(
        cost=lambda v, q: ca.sumsqr(v - 1),
        inequality=lambda v, q: ca.vertcat(ca.sumsqr(v) - q**2, q - v[0]),
        p=p,
        branches=(branch([p, 0], [1, 0]),),
        due=False,
        n=2,
    )


def redundant_but_inactive(rng):
    """Copies of a limit that do not count."""
    p = rng.normal()
    return Law(
        cost=lambda v, q: (v - q) ** 2,
        inequality=lambda v, q: ca.vertcat(v - q - 1, 2 * (v - q - 1), v - q - 1),
        upper=p + 1,
        p=p,
        branches=(branch(p, 1),),
        due=True,
    )


LAWS = (bound_and_path, twice_the_same, equality_twice, tangent_limits, redundant_but_inactive)
