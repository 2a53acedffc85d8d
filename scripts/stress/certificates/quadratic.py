"""Linear-quadratic problems whose active set was chosen first: the answer is a dense linear system in numpy.

    min  sum |s_t - p r_t|^2 / 2 + k_t u_t^2 / 2 + l_t.u_t     s' = A s + B u + e q,   u_t <= b_t,   s_t <= c_t

U, the active rows C U = h and their multipliers mu > 0 are drawn, and l, b and c follow from them.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from kpirl_ocp import OCP, Demonstration, Ipopt, Riccati, Trajectory
from stress.certificates.case import Case, Truth, weighed
from stress.certificates.distances import DUE, gap


class Quadratic:
    """One of them, with psi = (p, q)."""

    def __init__(self, rng) -> None:
        self.n, self.m, self.steps = int(rng.integers(1, 4)), int(rng.integers(1, 3)), int(rng.integers(2, 9))
        n, m, steps = self.n, self.m, self.steps
        self.A, self.B = np.eye(n) + 0.3 * rng.normal(size=(n, n)), rng.normal(size=(n, m))
        self.e, self.s0, self.psi = rng.normal(size=n), rng.normal(size=n), rng.normal(size=2)
        self.targets, self.efforts = rng.normal(size=(steps + 1, n)), rng.uniform(0.3, 2, (steps, m))
        self.actions = rng.normal(size=steps * m)
        powers = [np.linalg.matrix_power(self.A, k) for k in range(steps + 1)]
        zero = np.zeros((n, m))
        self.G = np.block(
            [[powers[t - k - 1] @ self.B if k < t else zero for k in range(steps)] for t in range(1, steps + 1)]
        )
        self.F = np.vstack(powers[1:])
        self.E = np.vstack([sum((powers[k] for k in range(t)), np.zeros((n, n))) @ self.e for t in range(1, steps + 1)])
        self.E = self.E.reshape(-1)

    @property
    def hessian(self) -> np.ndarray:
        """Of the cost by U."""
        return self.G.T @ self.G + np.diag(self.efforts.ravel())

    def states(self, actions: np.ndarray, psi: np.ndarray) -> np.ndarray:
        """(T n_s,) from s_1 on."""
        return self.F @ self.s0 + self.G @ actions + self.E * psi[1]

    @property
    def slope(self) -> np.ndarray:
        """Of the cost by U without its linear term."""
        off = self.states(self.actions, self.psi) - self.psi[0] * self.targets[1:].ravel()
        return self.G.T @ off + self.efforts.ravel() * self.actions

    @property
    def slope_by_psi(self) -> np.ndarray:
        """Its derivative by psi at fixed U, (n, 2)."""
        return self.G.T @ np.column_stack([-self.targets[1:].ravel(), self.E])

    def moves(self, active: np.ndarray, by_psi: np.ndarray) -> np.ndarray:
        """dU/dpsi (n, 2) with active rows C U + by_psi psi that stay where they are."""
        k, n = len(active), len(self.actions)
        system = np.block([[self.hessian, active.T], [active, np.zeros((k, k))]])
        return np.linalg.solve(system, np.vstack([-self.slope_by_psi, -by_psi]))[:n]


def constrained(rng, scaled: bool) -> Case:
    """Rows of U and of states are active, one of which may be weakly so, or about to begin or cease."""
    lq = Quadratic(rng)
    of_states = bool(rng.random() < 0.6)  # others have bounds of actions alone
    rows = np.vstack([np.eye(len(lq.actions)), lq.G[: of_states * len(lq.G)]])
    by_psi = np.zeros((len(rows), 2))
    by_psi[len(lq.actions) :, 1] = lq.E[: of_states * len(lq.E)]
    count = int(rng.integers(1, max(2, len(lq.actions) // 2)))
    chosen = _independent(rng, rows, count)
    multipliers, slack = np.zeros(len(rows)), rng.uniform(0.2, 2, len(rows))
    multipliers[chosen], slack[chosen] = rng.uniform(0.2, 2, count), 0.0
    g = gap(rng) if rng.random() < 0.5 else 1.0
    last = chosen[-1]
    if g != 1.0:
        multipliers[last], slack[last] = max(g, 0.0), max(-g, 0.0)
    active = chosen if g > 0 else chosen[:-1]
    linear = -lq.slope - rows.T @ multipliers
    values = np.concatenate([lq.actions, lq.states(lq.actions, lq.psi)])
    limits = np.full(len(values), np.inf)
    limits[: len(slack)] = values[: len(slack)] + slack
    moves = lq.moves(rows[active], by_psi[active])
    tangent = lq.G @ moves + np.column_stack([np.zeros_like(lq.E), lq.E])  # dS/dpsi (T n_s, 2)
    exists = g != 0 or not np.abs(rows[last] @ moves + by_psi[last]).any()
    return _case(rng, lq, linear, limits, tangent, exists, abs(g) > DUE, scaled)


def _independent(rng, rows, count):
    """Rows, well independent of each other."""
    while True:
        chosen = rng.choice(len(rows), count, replace=False)
        unit = rows[chosen] / np.linalg.norm(rows[chosen], axis=1, keepdims=True).clip(1e-9)
        if np.linalg.svd(unit, compute_uv=False)[-1] > 0.1:
            return chosen


def _case(rng, lq, linear, limits, tangent, exists, due, scaled) -> Case:
    cost = float(np.exp2(rng.integers(-20, 21))) if scaled else 1.0
    n, m, steps = lq.n, lq.m, lq.steps
    s, u, psi, d = (ca.SX.sym(*pair) for pair in (("s", n), ("u", m), ("psi", 2), ("d", n + 2 * m)))
    off = ca.sumsqr(s - psi[0] * d[:n]) / 2
    schedule = np.zeros((steps + 1, n + 2 * m))
    schedule[:, :n] = lq.targets
    schedule[:-1, n : n + m], schedule[:-1, n + m :] = lq.efforts, linear.reshape(steps, m)
    tops = np.vstack([np.full(n, np.inf), limits[steps * m :].reshape(steps, n)])
    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        stage=d,
        schedule=schedule,
        horizon=steps,
        dynamics=ca.DM(lq.A) @ s + ca.DM(lq.B) @ u + lq.e * psi[1],
        stage_cost=cost * (off + ca.dot(d[n : n + m], u**2) / 2 + ca.dot(d[n + m :], u)),
        terminal_cost=cost * off,
        action_bounds=(-np.inf, limits[: steps * m].reshape(steps, m)),
        state_bounds=(-np.inf, tops),
    )
    states = np.vstack([lq.s0, lq.states(lq.actions, lq.psi).reshape(steps, n)])
    observations = states + rng.normal(size=states.shape)
    by_states = 2 * (states - observations)
    moves = np.concatenate([np.zeros((1, n, 2)), tangent.reshape(steps, n, 2)])
    truth = Truth(
        np.einsum("ti,tij->j", by_states, moves) if exists else None, weighed(by_states, moves, 1.0, np.ones(2))
    )
    nothing = Truth(None, np.ones(2))

    def of(plan: Trajectory) -> Truth:
        right = np.abs(plan.actions.ravel() - lq.actions).max() < 1e-2
        return truth if right else nothing

    return Case(
        family="linear-quadratic with active constraints",
        problem=problem,
        demonstration=Demonstration(lq.s0, np.zeros(0), observations),
        psi=lq.psi,
        truth=of,
        due=due,
        scaled=scaled,
        solver=Ipopt() if rng.random() < 0.2 else Riccati(),
    )
