"""Laws with steep functions, in every place where a kink can be; their answers are followed to both sides of p."""

from functools import partial

import casadi as ca
import numpy as np
from scipy.optimize import brentq

from stress.certificates.law import Branch, Law, branch
from stress.certificates.loss_kinks import Seen, place
from stress.certificates.steep import BENDS, Function, distance, function, steepness


def _of_psi(rng, answer, by_answer, statement, n=1):
    """A law whose minimiser is a function of phi(p).

    answer, by_answer: phi -> v (n,), and dv/dphi. statement: phi (an expression of p), phi(p) -> fields of the law.
    """
    steep, z = function(rng)
    c, q = rng.uniform(4, 6), rng.choice([0.0, rng.normal()])
    p = q + z
    value = c + float(steep.value(p - q))
    return Law(
        p=p,
        branches=(branch(answer(value), by_answer(value) * float(steep.slope(p - q))),),
        due=steep.is_smooth(p - q),
        follow=lambda r: np.atleast_1d(answer(c + float(steep.value(r - q)))),
        n=n,
        **statement(lambda r: c + steep.expression(r - q), value),
    )


def in_the_target(rng):
    """v = phi(p)."""
    return _of_psi(rng, lambda x: x, lambda x: 1.0, lambda phi, x: {"cost": lambda v, p: (v - phi(p)) ** 2})


def in_a_weight(rng):
    """v = (phi a + b) / (phi + 1)."""
    a, b = rng.normal(size=2)
    return _of_psi(
        rng,
        lambda x: (x * a + b) / (x + 1),
        lambda x: (a - b) / (x + 1) ** 2,
        lambda phi, x: {"cost": lambda v, p: phi(p) * (v - a) ** 2 + (v - b) ** 2},
    )


def _at_most(rng, constraint):
    """v <= phi(p), with a target beyond. constraint: phi -> the field of the law that states it."""
    beyond = rng.uniform(1, 3)
    return _of_psi(
        rng,
        lambda x: x,
        lambda x: 1.0,
        lambda phi, x: {"cost": lambda v, p: (v - x - beyond) ** 2} | constraint(phi),
    )


def in_an_inequality(rng):
    """v <= phi(p) as an inequality."""
    return _at_most(rng, lambda phi: {"inequality": lambda v, p: v - phi(p)})


def in_a_bound(rng):
    """v <= phi(p) as a bound."""
    return _at_most(rng, lambda phi: {"upper": phi})


def in_an_equality(rng):
    """v_0 + v_1 = phi(p)."""
    return _of_psi(
        rng,
        lambda x: np.array([x, x]) / 2,
        lambda x: np.array([0.5, 0.5]),
        lambda phi, x: {"cost": lambda v, p: ca.sumsqr(v), "equality": lambda v, p: v[0] + v[1] - phi(p)},
        n=2,
    )


def in_the_drift(rng):
    """v = a, and phi(p) drifts."""
    steep, z = function(rng)
    a, q = rng.normal(), rng.choice([0.0, rng.normal()])
    p = q + z
    return Law(
        cost=lambda v, r: (v - a) ** 2,
        p=p,
        branches=(branch(a, 0),),
        due=steep.is_smooth(p - q),
        drift=lambda r: steep.expression(r - q),
        drift_branch=Branch(np.array([steep.value(p - q)]), np.array([steep.slope(p - q)])),
        follow=lambda r: np.array([a]),
        follow_drift=lambda r: float(steep.value(r - q)),
    )


def _in_v(rng, statement):
    """v + c F(k (v - q)) = p. statement: c F and its integral, expressions of v -> fields of the law."""
    shape, integral, tall = BENDS[rng.integers(len(BENDS))]
    k, c, q = steepness(rng), rng.uniform(0.2, 0.9), rng.choice([0.0, rng.normal()])
    height = c if tall else c / k
    steep = Function(shape, np.array([height]), np.array([k]), np.zeros(1))
    v = q + distance(rng, k)
    p = v + float(steep.value(v - q))

    def follow(r):
        return np.array([brentq(lambda x: x + float(steep.value(x - q)) - r, r - 2, r + 2, xtol=1e-15)])

    return Law(
        p=p,
        branches=(branch(v, 1 / (1 + float(steep.slope(v - q)))),),
        due=steep.is_smooth(v - q),
        follow=follow,
        start=np.array([v]),
        **statement(lambda x: steep.expression(x - q), lambda x: c * integral(x - q, k)),
    )


def in_the_cost(rng):
    """(v - p)^2 / 2 + c G(v - q)."""
    return _in_v(rng, lambda force, integral: {"cost": lambda v, p: (v - p) ** 2 / 2 + integral(v)})


def in_a_constraint(rng):
    """v + c F(v - q) <= p with a target out of reach."""
    return _in_v(
        rng,
        lambda force, integral: {
            "cost": lambda v, p: (v - p - 5) ** 2,
            "inequality": lambda v, p: v + force(v) - p,
        },
    )


def in_an_equation(rng):
    """v + c F(v - q) = p, whatever it costs."""
    return _in_v(rng, lambda force, integral: {"cost": lambda v, p: v**2, "equality": lambda v, p: v + force(v) - p})


def in_the_dynamics(rng):
    """v = p, and a steep function of the state drives it."""
    steep, z = function(rng)
    p, w = rng.normal(), rng.uniform(0.2, 3)
    return Law(
        cost=lambda v, r: w * (v - r) ** 2,
        p=p,
        branches=(branch(p, 1),),
        due=True,
        follow=lambda r: np.array([r]),
        swing=steep,
        swing_distance=z,
    )


def plain(rng):
    """v = p."""
    p, w = rng.normal(), rng.uniform(0.2, 3)
    return Law(
        cost=lambda v, r: w * (v - r) ** 2, p=p, branches=(branch(p, 1),), due=True, follow=lambda r: np.array([r])
    )


LAWS = (
    in_the_target,
    in_a_weight,
    in_an_inequality,
    in_a_bound,
    in_an_equality,
    in_the_drift,
    in_the_cost,
    in_a_constraint,
    in_an_equation,
    in_the_dynamics,
)


def observation(rng, states):
    """z has another coordinate, a steep function of x_i - q, at or beside whose steepest place one stage is."""
    steep, z = function(rng)
    t, i, _ = place(rng, states)
    q = states[t, i] - z
    inside = states[:, i] - q
    observations = np.column_stack([states, steep.value(inside)])
    observations = observations + rng.normal(size=observations.shape)

    def off(found):
        return np.column_stack([found, steep.value(found[:, i] - q)]) - observations

    def slopes(found):
        by = 2 * off(found)
        own = by[:, :-1].copy()
        own[:, i] += by[:, -1] * steep.slope(found[:, i] - q)
        return own

    return Seen(
        lambda s: ca.vertcat(s, steep.expression(s[i] - q)),
        observations,
        slopes,
        due=steep.is_smooth(inside[1:]),
        value=lambda found: float(np.sum(off(found) ** 2)),
    )


def loss(rng, states):
    """The sum of sqrt((x - z)^2 + 1 / k^2), one of which is at or beside its corner."""
    k = steepness(rng)
    t, i, _ = place(rng, states)
    off = rng.choice([-1, 1], states.shape) * rng.uniform(0.1, 1, states.shape)
    off[t, i] = distance(rng, k)
    observations = states - off

    def rounded(unit, problem):
        planned, actions = problem.symbols()[:2]
        seen = ca.MX.sym("Z", problem.n_observations, problem.horizon + 1)
        x = (problem.observe(planned) - seen) / unit
        return ca.Function("rounded", [planned, actions, seen], [unit * ca.sum1(ca.sum2(ca.sqrt(x**2 + k**-2)))])

    def slopes(found):
        x = found - observations
        return x / np.sqrt(x**2 + k**-2)

    return Seen(
        lambda x: x,
        observations,
        slopes,
        due=abs(off[t, i]) > 2e-2 or k <= 1e2,
        power=1,
        in_unit=lambda unit: partial(rounded, unit),
        value=lambda found: float(np.sum(np.sqrt((found - observations) ** 2 + k**-2))),
    )


LOOKS = (observation, loss)
