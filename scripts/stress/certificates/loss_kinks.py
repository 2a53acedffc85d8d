"""Observations and losses: smooth, or with a kink exactly at or beside the plan.

States are (T+1, n_s) without units here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

from kpirl_ocp.irl.hypergradients import Loss, squared_distance
from stress.certificates.distances import DUE, gap


@dataclass(frozen=True)
class Seen:
    """observation: of x (n_s,). slopes: dL/dX (T+1, n_s), None where there is none; in units of the state.

    power: of the unit of the state in the loss. value: of the loss, where it is followed to both sides.
    in_unit: unit of the state -> the loss, where it is not the same one in all.
    """

    observation: Callable
    observations: np.ndarray
    slopes: Callable
    loss: Loss = squared_distance
    due: bool = True
    power: int = 2
    value: Callable | None = None
    in_unit: Callable | None = None


def squares(rng, states):
    """The state itself, and squares."""
    observations = states + rng.normal(size=states.shape)
    return Seen(
        lambda x: x,
        observations,
        lambda found: 2 * (found - observations),
        value=lambda found: float(np.sum((found - observations) ** 2)),
    )


def reached(rng, states):
    """The demonstration is the plan: the gradient is zero."""
    return Seen(lambda x: x, states, lambda found: 2 * (found - states))


def bent(rng, states):
    """z = x + sin(x) / 2."""
    observations = states + rng.normal(size=states.shape)

    def slopes(found):
        return 2 * (found + np.sin(found) / 2 - observations) * (1 + np.cos(found) / 2)

    return Seen(lambda x: x + ca.sin(x) / 2, observations, slopes)


def place(rng, states):
    """A stage after the first, a coordinate, and its distance from the kink."""
    return int(rng.integers(1, len(states))), int(rng.integers(states.shape[1])), gap(rng)


def _kinked(rng, states, expression, value, slope):
    """z has another coordinate, bend(x_i - q), that bends at or beside the plan at one stage."""
    t, i, g = place(rng, states)
    q = states[t, i] - g
    x = states[:, i] - q
    x[t] = g
    observations = np.column_stack([states, value(x)]) + rng.normal(size=(len(states), states.shape[1] + 1))

    def slopes(found):
        y = found[:, i] - q
        y[t] = g
        if g == 0:
            return None
        by = 2 * (found - observations[:, :-1])
        by[:, i] += 2 * (value(y) - observations[:, -1]) * slope(y)
        return by

    away = np.abs(np.delete(x, [0, t])).min(initial=np.inf)  # s_0 is given
    return Seen(lambda s: ca.vertcat(s, expression(s[i] - q)), observations, slopes, due=min(abs(g), away) > DUE)


def absolute_observation(rng, states):
    """|x - q|."""
    return _kinked(rng, states, ca.fabs, np.abs, np.sign)


def relu_observation(rng, states):
    """max(x - q, 0)."""
    return _kinked(rng, states, lambda x: ca.fmax(x, 0), lambda x: np.maximum(x, 0), lambda x: (x > 0) * 1.0)


def jumping_observation(rng, states):
    """1 where x > q."""
    return _kinked(
        rng, states, lambda x: ca.if_else(x > 0, 1.0, 0.0), lambda x: (x > 0) * 1.0, lambda x: np.zeros_like(x)
    )


def _l1(problem):
    states, actions = problem.symbols()[:2]
    seen = ca.MX.sym("Z", problem.n_observations, problem.horizon + 1)
    return ca.Function("l1", [states, actions, seen], [ca.sum1(ca.sum2(ca.fabs(problem.observe(states) - seen)))])


def absolute_loss(rng, states):
    """The sum of |x - z|, one of which is at or beside its kink."""
    t, i, g = place(rng, states)
    off = rng.choice([-1, 1], states.shape) * rng.uniform(0.1, 1, states.shape)
    off[t, i] = g
    observations = states - off

    def slopes(found):
        return None if g == 0 else np.sign(off)

    return Seen(lambda x: x, observations, slopes, _l1, abs(g) > DUE, 1)


KINKED = (absolute_observation, relu_observation, jumping_observation, absolute_loss)
