"""A problem as one nonlinear program over w = (S, U), and what scipy and Ipopt make of it: no solver of the package."""

from __future__ import annotations

import casadi as ca
import numpy as np
from scipy.optimize import lsq_linear

from kpirl_ocp import OCP, Trajectory

_TOLERANCE = 1e-6
_IPOPT = {"print_level": 0, "sb": "yes", "tol": 1e-10, "max_iter": 500}


class Whole:
    """min J(w)  subject to  e(w) = 0, g(w) <= 0, at the numbers of one instance."""

    def __init__(self, problem: OCP, s0, psi, context) -> None:
        n, m, steps = problem.n_states, problem.n_actions, problem.horizon
        self.shape, self.problem = (n, m, steps), problem
        w = ca.MX.sym("w", (steps + 1) * n + steps * m)
        S, U = ca.reshape(w[: (steps + 1) * n], n, steps + 1), ca.reshape(w[(steps + 1) * n :], m, steps)
        d, numbers = np.asarray(problem.schedule), (ca.DM(psi), ca.DM(context))
        along = [(S[:, t], U[:, t], *numbers, d[t]) for t in range(steps)]
        end = S[:, steps], *numbers, d[steps]
        given = np.flatnonzero(~problem.free_start)
        start = ca.vertcat(*(S[i, 0] - float(problem.inputs(s0, psi, context)[0][i]) for i in given))
        equal = [start, *(problem.dynamics(*at) - S[:, t + 1] for t, at in enumerate(along))]
        equal += [problem.path_equality(*at) for at in along if problem.path_equality]
        equal += [problem.terminal_equality(*end)] if problem.terminal_equality else []
        unequal = [problem.path_constraint(*at) for at in along if problem.path_constraint]
        unequal += [problem.terminal_inequality(*end)] if problem.n_terminal else []
        pairs = zip(problem.limits, problem.action_bounds, strict=True)
        lower, upper = (np.concatenate([states.ravel(), np.ravel(actions)]) for states, actions in pairs)
        for bound, sign in ((lower, -1), (upper, 1)):
            unequal += [sign * (w[int(i)] - bound[i]) for i in np.flatnonzero(np.isfinite(bound))]
        objective = sum(problem.stage_cost(*at) for at in along) + problem.terminal_cost(*end)
        e, g = (ca.densify(ca.vertcat(ca.MX(0, 1), *parts)) for parts in (equal, unequal))
        self.w, self.e, self.g = w, e, g
        outputs = [ca.gradient(objective, w), e, ca.jacobian(e, w), g, ca.jacobian(g, w)]
        self._at = ca.Function("at", [w], [ca.densify(output) for output in outputs])

    def stationary(self, plan: Trajectory) -> bool:
        """Feasible, and balanced by multipliers of the right signs, complementary to 1e-7, that scipy finds.

        A slack itself may be larger: of a weak constraint in small units of the cost, slack times multiplier is little.
        """
        w = np.concatenate([plan.states.ravel(), plan.actions.ravel()])
        slope, e, A, g, C = (np.array(value) for value in self._at(w))
        if np.abs(e).max(initial=0) > _TOLERANCE or g.max(initial=-1) > _TOLERANCE:
            return False
        near = g.ravel() > -1e-2
        slack, size, off = np.maximum(-g.ravel()[near], 0), max(1.0, np.abs(slope).max(initial=0)), slope.ravel()
        normals = np.hstack([A.T, C[near].T])
        products = np.hstack([np.zeros((len(slack), len(A))), np.diag(slack)])
        if normals.shape[1]:
            least = np.concatenate([np.full(len(A), -np.inf), np.zeros(len(slack))])
            target = np.concatenate([-off, np.zeros(len(slack))])
            found = lsq_linear(np.vstack([normals, products]), target, (least, np.inf), tol=1e-14).x
            size, off, products = max(size, np.abs(found).max()), normals @ found + off, products @ found
        return bool(np.abs(off).max(initial=0) <= 1e-5 * size and np.abs(products).max(initial=0) <= 1e-7)

    def least_violation(self, starts: int = 4) -> float:
        """The smallest sum of violations that Ipopt finds from several places; zero: there is a feasible point."""
        a, b = (ca.MX.sym(name, size.numel()) for name, size in (("a", self.e), ("b", self.g)))
        program = {
            "x": ca.vertcat(self.w, a, b),
            "f": ca.sum1(a) + ca.sum1(b),
            "g": ca.vertcat(self.e - a, -self.e - a, self.g - b),
        }
        n = self.w.numel()
        solver = ca.nlpsol("violation", "ipopt", program, {"ipopt": _IPOPT, "print_time": False})
        low = np.concatenate([np.full(n, -np.inf), np.zeros(a.numel() + b.numel())])
        rng, least = np.random.default_rng(0), np.inf
        for k in range(starts):
            x0 = np.concatenate([k * rng.normal(size=n), np.ones(a.numel() + b.numel())])
            found = np.array(solver(x0=x0, lbx=low, ubg=0)["x"])[:n]
            _, e, _, g, _ = (np.array(value) for value in self._at(found))
            least = min(least, np.abs(e).sum() + np.maximum(g, 0).sum())
        return float(least)
