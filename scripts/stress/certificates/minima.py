"""Laws whose stationary points are folds, maxima, saddles, or flat."""

import casadi as ca
import numpy as np

from stress.certificates.distances import DUE, gap
from stress.certificates.law import Law, branch

FOLD = 2 / (3 * np.sqrt(3))  # tilt at which a well of (v^2 - 1)^2 / 4 + p v disappears


def wells(rng):
    """Two wells; the one that the start is in disappears in a fold as p grows."""
    p = FOLD - abs(gap(rng))
    roots = np.roots([1.0, 0.0, -1.0, p])
    v = np.sort(roots[np.abs(roots.imag) < 1e-7].real)
    ends = [v[0], v[-1]]
    slopes = [None if abs(3 * x**2 - 1) < 1e-12 else -1 / (3 * x**2 - 1) for x in ends]
    return Law(
        cost=lambda v, q: (v**2 - 1) ** 2 / 4 + q * v,
        p=p,
        branches=tuple(branch(x, slope) for x, slope in zip(ends, slopes, strict=True)),
        due=FOLD - p > DUE,
        start=np.array([rng.choice([-1.0, 0.8])]),
    )


def jumped(rng):
    """Beyond the fold only the left well is left."""
    p = FOLD + rng.uniform(0.02, 0.5)
    roots = np.roots([1.0, 0.0, -1.0, p])
    v = float(roots[np.abs(roots.imag) < 1e-9].real[0])
    return Law(
        cost=lambda v, q: (v**2 - 1) ** 2 / 4 + q * v,
        p=p,
        branches=(branch(v, -1 / (3 * v**2 - 1)),),
        due=True,
        start=np.array([0.8]),
    )


def cube_root(rng):
    """v = (p - q)^(1/3)."""
    q, g = rng.normal(), gap(rng)
    v = np.cbrt(g)
    return Law(
        cost=lambda v, p: v**4 / 4 - (p - q) * v,
        p=q + g,
        branches=(branch(v, None if g == 0 else 1 / (3 * v**2)),),
        due=abs(g) > DUE,
        start=np.array([0.8]),
    )


def pitchfork(rng):
    """v = 0 splits into two minima."""
    q, g = rng.normal(), gap(rng)
    root = np.sqrt(max(g, 0.0))
    slope = None if g == 0 else 0.5 / root if g > 0 else 0.0
    ends = [branch(s * root, None if slope is None else s * slope) for s in ((-1, 1) if g > 0 else (1,))]
    return Law(
        cost=lambda v, p: v**4 / 4 - (p - q) * v**2 / 2,
        p=q + g,
        branches=tuple(ends),
        due=abs(g) > DUE,
        start=np.array([0.7]),
    )


def maximum(rng):
    """The solver starts on a maximum; the minima are +-sqrt(1/2) to either side of it, for p = 0."""
    root = np.sqrt(0.5)
    ends = tuple(branch(s * root, -1 / (6 * root**2 - 1)) for s in (-1, 1))
    return Law(cost=lambda v, p: v**4 - (v - p) ** 2, p=0.0, branches=ends, due=False, start=np.zeros(1))


def saddle(rng):
    """v_1 = 0 is a maximum along v_1."""
    p = rng.normal()
    ends = tuple(branch([p, s * np.sqrt(0.5)], [1, 0]) for s in (-1, 1))
    return Law(
        cost=lambda v, q: (v[0] - q) ** 2 + v[1] ** 4 - v[1] ** 2,
        p=p,
        branches=ends,
        due=False,
        start=np.array([p, 0.0]),
        n=2,
    )


def flat_direction(rng):
    """Only the sum of both actions has a cost."""
    p = rng.normal()
    return Law(cost=lambda v, q: (v[0] + v[1] - q) ** 2, p=p, branches=(), due=False, n=2)


def dead_zone(rng):
    """No cost near the target."""
    p, q = rng.normal(), rng.uniform(0.2, 1)
    return Law(
        cost=lambda v, r: ca.fmax(ca.fabs(v - r) - q, 0) ** 2, p=p, branches=(), due=False, start=np.array([p + q / 2])
    )


def flat_minimum(rng):
    """(v - p)^4 has no curvature at its minimum."""
    p = rng.normal()
    return Law(cost=lambda v, q: (v - q) ** 4, p=p, branches=(branch(p, 1),), due=False)


def nothing(rng):
    """No cost at all."""
    return Law(cost=lambda v, q: 0 * v, p=rng.normal(), branches=(), due=False)


LAWS = (wells, jumped, cube_root, pitchfork, maximum, saddle, flat_direction, dead_zone, flat_minimum, nothing)
