"""Random statements with any features together: every solver ends where Ipopt does, or says that there is nothing."""

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp import OCP, SQP, Fatrop, Ipopt, Riccati, Soft, Status


class Drawing:
    """A random problem with 1 to 3 states, 0 to 2 actions, 2 to 8 steps; psi (2,), context (1,), two stage numbers."""

    def __init__(self, seed):
        self.rng = rng = np.random.default_rng(seed)
        self.kind = ca.SX if seed % 2 == 0 else ca.MX
        n, self.m, self.T = (int(rng.integers(*ends)) for ends in ((1, 4), (0, 3), (2, 9)))
        sizes = {"s": n, "u": self.m, "psi": 2, "c": 1, "d": 2, "q": 1}
        self.s, self.u, self.psi, self.c, self.d, self.q = (self.kind.sym(*pair) for pair in sizes.items())
        self.target = rng.normal(size=n)
        off = ca.sumsqr(self.s - self.target)
        moved = ca.DM(0.4 * rng.normal(size=(n, n))) @ self.s + 0.2 * self.psi[0] * ca.sin(self.s)
        self.given = {
            "state": self.s,
            "parameters": self.psi,
            "context": self.c,
            "stage": self.d,
            "schedule": np.column_stack([rng.normal(size=self.T + 1), np.arange(self.T + 1) % 2 == 0]),
            "horizon": self.T,
            "dynamics": moved + 0.2 * self.c * self.d[0] * self.on(0.4),
            "stage_cost": off,
            "terminal_cost": 2 * off,
        }
        if self.m:
            self.given["action"] = self.u
            self.given["dynamics"] += ca.DM(rng.normal(size=(n, self.m))) @ self.u
            self.given["stage_cost"] += 0.1 * ca.sumsqr(self.u) * (1 + self.psi[1] ** 2)
            self.with_actions()
        self.without_actions()

    def on(self, probability):
        return bool(self.rng.random() < probability)

    def with_actions(self):
        s, u, rng = self.s, self.u, self.rng
        if self.on(0.6):
            bound = 10 ** rng.uniform(-1, 0.5)
            moving = -bound * (1 + self.psi[1] ** 2), np.linspace(bound, 2 * bound, self.T)[:, None]
            self.given["action_bounds"] = moving if self.on(0.5) else (-bound, bound)
        if self.on(0.3):
            self.given["path_constraint"] = ca.vertcat(ca.sumsqr(u) + s[0] - 2, self.d[1] * (s[0] - 1.5))
        if self.m == 2 and self.on(0.3):
            self.given["path_equality"] = u[0] - 0.3 * u[1] - 0.1 * ca.sin(s[0])
        if self.on(0.3):
            self.given["terminal_equality"] = s[0] - 0.3 * self.target[0]
        if self.on(0.3):
            self.given["soft"] = Soft(s[0] - 0.3, linear=1.0, quadratic=0.5)

    def without_actions(self):
        rng, n = self.rng, self.s.numel()
        if self.on(0.3):
            self.given |= {"static": self.q, "static_bounds": (-1, 1)}
            self.given["dynamics"] += 0.3 * self.q
            self.given["terminal_cost"] += 0.1 * self.q**2
        if self.on(0.4) or not self.m:
            lower = np.where(rng.random(n) < 0.5, 0.0, -1.0)
            self.given["initial_bounds"] = lower, np.maximum(lower, rng.integers(0, 2, n))
        if self.on(0.3):
            self.given["state_bounds"] = (-1, 10 ** rng.uniform(-0.3, 0.5))
        if self.on(0.3):
            self.given["terminal_constraint"] = ca.sumsqr(self.s) - 2 * (1 + self.psi[0] ** 2)

    def problem(self):
        arguments = 0.3 * self.rng.normal(size=self.s.numel()), self.rng.normal(size=2), [self.rng.normal()]
        return OCP.from_expressions(**self.given), arguments


@pytest.mark.parametrize("first", range(0, 60, 15))
def test_solvers_agree_on_random_statements(first):
    agreed = {"Riccati": 0, "Fatrop": 0, "SQP": 0}
    for seed in range(first, first + 15):
        problem, arguments = Drawing(seed).problem()
        expected = Ipopt().solve(problem, *arguments)
        for solver in (Riccati(), Fatrop(), SQP()):
            found = solver.solve(problem, *arguments)
            assert (found.status is Status.CONVERGED) <= (expected.status is Status.CONVERGED), (seed, solver)
            if found.status is Status.CONVERGED:
                np.testing.assert_allclose(found.objective, expected.objective, rtol=1e-6, atol=1e-6, err_msg=str(seed))
                agreed[type(solver).__name__] += 1
    assert min(agreed.values()) >= 11
