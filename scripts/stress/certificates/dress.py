"""Laws made into optimal-control problems whose answers stay known.

    v_t = u_t + K s_t,   s_{t+1} = A s_t + B v_t + k sin(s_t) + e r + drift(p) + swing(s_t),   psi = (p, r)

The cost of a law sees v alone, so that v_t = v*(p) at every stage. The difference of a potential at s_{t+1} and s_t is
added to the stage cost and taken off at the end: it changes no plan, but multipliers and Hessians. All numbers are in
units, of cost, state, action and parameters, that are powers of two, so that a kink stays exactly where it is.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from kpirl_ocp import OCP, Demonstration, Riccati, Trajectory
from stress.certificates.case import Case, Truth, weighed
from stress.certificates.law import Law
from stress.certificates.loss_kinks import Seen, squares

REACH, HOLDS = 0.5e-6, 1e-2  # of a certificate: share of a parameter, and of the terms of a gradient


@dataclass(frozen=True)
class Units:
    """Of cost, states, actions and the two parameters."""

    cost: float = 1.0
    state: float = 1.0
    action: float = 1.0
    psi: np.ndarray = field(default_factory=lambda: np.ones(2))

    @classmethod
    def draw(cls, rng) -> Units:
        """Over twelve orders of magnitude in the cost, six in each of the others."""
        cost, state, action, *psi = np.exp2(rng.integers([-20, -10, -10, -10, -10], [21, 11, 11, 11, 11]))
        return cls(cost, state, action, np.array(psi))


class Dressed:
    """A law at every stage of an optimal-control problem."""

    def __init__(self, law: Law, rng, units: Units) -> None:
        self.law, self.units, self.steps = law, units, int(rng.integers(1, 7))
        n = law.n + int(rng.integers(0, 2))
        self.A, self.B = 0.5 * rng.normal(size=(n, n)), rng.normal(size=(n, law.n))
        bounded = callable(law.upper) or np.isfinite(law.upper).any()
        self.K = rng.normal(size=(law.n, n)) * (rng.random() < 0.5) * (not bounded)
        self.e, self.d, self.s0, self.r = *rng.normal(size=(3, n)), rng.normal()
        self.slope, self.bend = rng.normal(size=n) * (rng.random() < 0.5), 0.5 * rng.normal() * (rng.random() < 0.5)
        self.k = 0.2 * (rng.random() < 0.7)
        self.bend *= self.k > 0  # what is linear is linear-quadratic, too
        self.weights = rng.uniform(0.5, 2, self.steps + 1)
        self.q = 0.0  # from which the swing begins
        for _ in range(5 * bool(law.swing)):  # until it meets the state after one step
            self.q = self.states(np.tile(law.branches[0].v, (self.steps, 1)))[1, 0] - law.swing_distance

    @property
    def psi(self) -> np.ndarray:
        """(2,) in its units."""
        return self.units.psi * [self.law.p, self.r]

    def problem(self, observation) -> OCP:
        """The problem; observation: of the state without units."""
        units, law = self.units, self.law
        s, u, psi, weight = (ca.SX.sym(*pair) for pair in (("s", len(self.s0)), ("u", law.n), ("psi", 2), ("d", 1)))
        x, p, r = s / units.state, psi[0] / units.psi[0], psi[1] / units.psi[1]
        v = u / units.action + ca.DM(self.K) @ x
        drift = law.drift(p) * self.d if law.drift else 0
        after = ca.DM(self.A) @ x + ca.DM(self.B) @ v + self.k * ca.sin(x) + self.e * r + drift
        if law.swing:
            after[0] += law.swing.expression(x[0] - self.q)
        rows = {"path_constraint": law.inequality, "path_equality": law.equality}
        return OCP.from_expressions(
            state=s,
            action=u,
            parameters=psi,
            stage=weight,
            schedule=self.weights[:, None],
            horizon=self.steps,
            dynamics=units.state * after,
            stage_cost=units.cost * (weight * law.cost(v, p) + self.potential(after) - self.potential(x)),
            terminal_cost=-units.cost * self.potential(x),
            observation=units.state * observation(x),
            action_bounds=(-np.inf, units.action * (law.upper(p) if callable(law.upper) else np.asarray(law.upper))),
            **{name: row(v, p) for name, row in rows.items() if row},
        )

    def potential(self, x):
        """Whose differences are added to the stage cost."""
        return ca.dot(self.slope, x) + self.bend * ca.sum1(ca.cos(x))

    def states(self, v: np.ndarray, drift: float | None = None) -> np.ndarray:
        """(T+1, n_s) without units, for v (T, n_v)."""
        drifting = (self.law.drift_branch.v[0] if drift is None else drift) * self.d
        states = [self.s0]
        for now in v:
            x = states[-1]
            states.append(self.A @ x + self.B @ now + self.k * np.sin(x) + self.e * self.r + drifting)
            if self.law.swing:
                states[-1][0] += self.law.swing.value(x[0] - self.q)
        return np.array(states)

    def swings_smoothly(self, states: np.ndarray) -> bool:
        """Whether the dynamics are smooth within DUE of states (T+1, n_s)."""
        return self.law.swing is None or self.law.swing.is_smooth(states[:-1, 0] - self.q)

    def tangent(self, states: np.ndarray, slopes: np.ndarray) -> np.ndarray:
        """dS/d(p, r) (T+1, n_s, 2) without units, for dv/dp (T, n_v)."""
        found, drift = [np.zeros((len(self.s0), 2))], self.law.drift_branch.slope[0] * self.d
        for x, slope in zip(states, slopes, strict=False):
            own = np.column_stack([self.B @ slope + drift, self.e])
            by_state = self.A + np.diag(self.k * np.cos(x))
            if self.law.swing:
                by_state[0, 0] += self.law.swing.slope(x[0] - self.q)
            found.append(by_state @ found[-1] + own)
        return np.array(found)

    def trajectory(self, v: np.ndarray) -> Trajectory:
        """In its units, for v (T, n_v)."""
        states = self.states(v)
        actions = v - states[:-1] @ self.K.T
        return Trajectory(self.units.state * states, self.units.action * actions)

    def v_of(self, plan: Trajectory) -> np.ndarray:
        """v (T, n_v) of a plan."""
        return plan.actions / self.units.action + plan.states[:-1] / self.units.state @ self.K.T

    def truth(self, plan: Trajectory, seen: Seen) -> Truth:
        """Of the branch at every stage that is closest to the plan."""
        branches, v = self.law.branches, self.v_of(plan)
        nothing = Truth(None, np.ones(2))
        if not branches or not np.isfinite(v).all():
            return nothing
        nearest = [min(branches, key=lambda end: np.abs(end.v - now).max()) for now in v]
        exact = np.array([end.v for end in nearest])
        if np.abs(exact - v).max() > 1e-2 or any(end.slope is None for end in (*nearest, self.law.drift_branch)):
            return nothing
        states = self.states(exact)
        by_states = seen.slopes(states)
        if by_states is None:
            return nothing
        units = self.units
        unit = units.state ** (seen.power - 1)
        by_states = unit * by_states
        tangent = units.state * self.tangent(states, np.array([end.slope for end in nearest])) / units.psi
        gradient = np.einsum("ti,tij->j", by_states, tangent)
        scale = weighed(by_states, tangent, unit, units.state / units.psi)
        without_units = units.psi[0] / units.state**seen.power
        if self.law.follow and not self._holds(seen, without_units * gradient[0], without_units * scale[0]):
            return nothing
        return Truth(gradient, scale)

    def _holds(self, seen: Seen, slope: float, scale: float) -> bool:
        """Whether the slope of the loss by p is that to both sides, over as much of p as a certificate speaks of."""
        law, psi = self.law, np.abs(self.psi)
        length = REACH * max(psi[0], 1e-3 * psi.max()) / self.units.psi[0]

        def value(p: float) -> float:
            drift = law.follow_drift(p) if law.follow_drift else None
            return seen.value(self.states(np.tile(law.follow(p), (self.steps, 1)), drift))

        here = value(law.p)
        far, near = (
            np.array([(value(law.p + side) - here) / side for side in (share * length, -share * length)]) - slope
            for share in (1.0, 0.1)
        )
        beyond = np.minimum(np.abs(far), np.abs(near - 0.1 * far)).max()  # what is proportional is curvature
        return bool(beyond <= HOLDS * max(scale, np.abs(far).max()) + 1e-14 * abs(here) / length)


def dress(family: str, law: Law, rng, scaled: bool, solver=None, seen=None) -> Case:
    """The case of a law.

    seen: (rng, true states) -> what is observed and how it is compared; by default squares.
    """
    dressed = Dressed(law, rng, Units.draw(rng) if scaled else Units())
    v = np.tile(law.branches[0].v if law.branches else np.zeros(law.n), (dressed.steps, 1))
    looks = (seen or squares)(rng, dressed.states(v))
    units = dressed.units
    start = None if law.start is None else dressed.trajectory(np.tile(law.start, (dressed.steps, 1)))
    return Case(
        family=family,
        problem=dressed.problem(looks.observation),
        demonstration=Demonstration(units.state * dressed.s0, np.zeros(0), units.state * looks.observations),
        psi=dressed.psi,
        truth=lambda plan: dressed.truth(plan, looks),
        due=law.due and looks.due and dressed.swings_smoothly(dressed.states(v)),
        scaled=scaled,
        guess=start,
        loss=looks.in_unit(units.state) if looks.in_unit else looks.loss,
        solver=solver or Riccati(),
    )
