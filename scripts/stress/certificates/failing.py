"""Laws without an answer: infeasible, unbounded, NaN; and solvers that stop too early."""

import casadi as ca
import numpy as np

from kpirl_ocp import GradientDescent, Ipopt, Riccati
from stress.certificates import smooth
from stress.certificates.law import Law


def infeasible(rng):
    """v <= q and v >= q + 1."""
    q = rng.normal()
    return Law(
        cost=lambda v, p: (v - p) ** 2,
        upper=q,
        inequality=lambda v, p: q + 1 - v,
        p=rng.normal(),
        branches=(),
        due=False,
    )


def unbounded(rng):
    """The cost falls for ever."""
    return Law(cost=lambda v, p: p * v, p=rng.uniform(0.5, 2), branches=(), due=False)


def not_a_number(rng):
    """The cost is NaN at this p."""
    return Law(cost=lambda v, p: (v - ca.sqrt(p)) ** 2, p=-rng.uniform(0.1, 2), branches=(), due=False)


def nan_dynamics(rng):
    """The dynamics are NaN at this p, the cost is not."""
    return Law(cost=lambda v, p: (v - 1) ** 2, p=-rng.uniform(0.1, 2), branches=(), due=False, drift=ca.log)


def nan_beside(rng):
    """A cost that ends at its own minimum: sqrt(v - q) (v - q) is NaN below q."""
    q = rng.normal()
    return Law(
        cost=lambda v, p: (v - p) ** 2 + ca.sqrt(v - q) * (v - q),
        p=q,
        branches=(),
        due=False,
        start=np.array([q + 0.5]),
    )


LAWS = (infeasible, unbounded, not_a_number, nan_dynamics, nan_beside)


def early_stop(rng):
    """A solver that is not given enough iterations."""
    few = int(rng.integers(1, 4))
    kinds = (Ipopt(max_iterations=few), Riccati(max_iterations=few), GradientDescent(few, 0.05))
    return kinds[rng.integers(len(kinds))]


def hurried(rng):
    """A smooth law, for solvers that stop too early."""
    return smooth.LAWS[rng.integers(6)](rng)
