"""A case as a nonlinear program in CasADi's symbols, without the package's own transcription."""

from __future__ import annotations

from functools import cached_property

import casadi as ca
import numpy as np

from kpirl_ocp import Trajectory
from kpirl_ocp.irl.hypergradients import data_of
from stress.certificates.case import Case

IPOPT = {"tol": 1e-10, "print_level": 0, "sb": "yes", "max_iter": 500}


class CannotState(Exception):
    """The peer has no way to state this case."""


class Refused(Exception):
    """The peer failed, or flagged its own answer."""


class Program:
    """min f(x, p)  subject to  lbg <= g(x, p) <= ubg,  lbx <= x <= ubx,  with x = (s_1 .. s_T, u_0 .. u_{T-1})."""

    def __init__(self, case: Case) -> None:
        problem, steps = case.problem, case.problem.horizon
        self.case, self.n_states, self.n_actions, self.steps = case, problem.n_states, problem.n_actions, steps
        self.s0 = np.asarray(case.demonstration.s0, float)
        self.x = ca.SX.sym("x", steps * (self.n_states + self.n_actions))
        self.p = ca.SX.sym("p", problem.n_parameters)
        split = steps * self.n_states
        self.states = ca.horzcat(ca.DM(self.s0), ca.reshape(self.x[:split], self.n_states, steps))
        self.actions = ca.reshape(self.x[split:], self.n_actions, steps)
        self._stages = np.asarray(problem.schedule)
        rows = [self._along(problem.dynamics, t) - self.states[:, t + 1] for t in range(steps)]
        equalities = [self._along(problem.path_equality, t) for t in range(steps) if problem.path_equality]
        limits = [self._along(problem.path_constraint, t) for t in range(steps) if problem.path_constraint]
        end = self.states[:, steps], self.p, [], self._stages[steps]
        last = [problem.terminal_inequality(*end)] if problem.n_terminal else []
        self.f = sum(self._along(problem.stage_cost, t) for t in range(steps)) + problem.terminal_cost(*end)
        self.g = ca.vertcat(*rows, *equalities, *limits, *last)
        fixed = ca.vertcat(*rows, *equalities).numel()
        self.ubg = np.zeros(self.g.numel())
        self.lbg = np.concatenate([np.zeros(fixed), np.full(self.g.numel() - fixed, -np.inf)])
        lower, upper = zip(problem.state_bounds, problem.action_bounds, strict=True)
        self.lbx, self.ubx = (np.concatenate([s[1:].ravel(), u.ravel()]) for s, u in (lower, upper))

    def _along(self, function, t: int):
        return function(self.states[:, t], self.actions[:, t], self.p, [], self._stages[t])

    @cached_property
    def loss(self):
        """L(x, p)."""
        data = data_of(self.case.loss, self.case.problem, self.case.demonstration)
        return self.case.loss(self.case.problem)(self.states, self.actions, ca.DM(data))

    @property
    def start(self) -> np.ndarray:
        """x to start from: the case's guess; without one, s_0 at all stages."""
        guess = self.case.guess
        if guess is None:
            return np.concatenate([np.tile(self.s0, self.steps), np.zeros(self.steps * self.n_actions)])
        return np.concatenate([guess.states[1:].ravel(), guess.actions.ravel()])

    @property
    def bounds(self) -> dict:
        """For CasADi's solvers."""
        return {name: getattr(self, name) for name in ("lbx", "ubx", "lbg", "ubg")}

    @property
    def symbols(self) -> dict:
        """For CasADi's `nlpsol`."""
        return {"x": self.x, "p": self.p, "f": self.f, "g": self.g}

    def plan(self, x: np.ndarray) -> Trajectory:
        """The trajectory in x."""
        split = self.steps * self.n_states
        states = np.vstack([self.s0, x[:split].reshape(self.steps, self.n_states)])
        return Trajectory(states, x[split:].reshape(self.steps, self.n_actions))

    def chain(self, x: np.ndarray, tangent: np.ndarray) -> np.ndarray:
        """dL/dp (n_p,) with dx/dp (n_x, n_p)."""
        by_x, by_p = ca.gradient(self.loss, self.x), ca.gradient(self.loss, self.p)
        slope, direct = ca.Function("slopes", [self.x, self.p], [by_x, by_p])(x, self.case.psi)
        return np.array(slope).ravel() @ tangent + np.array(direct).ravel()
