"""The iterates of the interior-point method in numpy, and what is computed at them by compiled functions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kpirl_ocp.ocp.codegen.numpy_calls import call, call_one_of
from kpirl_ocp.ocp.conditions.stage_derivatives import by_time, first, second, values
from kpirl_ocp.ocp.interior_point.feedback_rollout import follow
from kpirl_ocp.ocp.interior_point.newton_step import BOUNDARY, CENTRE, Rows, corrected_step, newton_step, rows
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, KKTResiduals, Multipliers, Solution, Trajectory, largest, max_or_nan

_PUSH = 1e-2  # how far a cold start is moved inside its bounds, relative to their size and distance
_REMAINDER = 0.1  # a step along the dynamics may end this much closer to the boundary than its linearisation


@dataclass(frozen=True)
class Iterate:
    """A point: s_0 (n_s,), w (n_w,), costates (T n_s,), slacks y and multipliers z (m,), nu of fixed entries."""

    s0: Array
    w: Array
    costates: Array
    y: Array
    z: Array
    nu: Array

    def moved(self, step: Step, length: float, dual_length: float | None = None) -> Iterate:
        """The point after a step of this length; z moves by `dual_length`, or not at all."""
        return Iterate(
            s0=self.s0 + length * step.ds0,
            w=self.w + length * step.dw,
            costates=self.costates + length * step.dcostates,
            y=self.y + length * step.dy,
            z=self.z if dual_length is None else self.z + dual_length * step.dz,
            nu=self.nu + length * step.dnu,
        )


@dataclass(frozen=True)
class Step:
    """A Newton step, its longest lengths that keep y and z positive, and whether all pivots were positive.

    tau: that it leads towards. gains: K (n_u, n_s T), flat.
    """

    ds0: Array
    dw: Array
    dcostates: Array
    dy: Array
    dz: Array
    dnu: Array
    tau: float
    primal_length: float
    dual_length: float
    regularisation: float
    positive: bool
    gains: Array

    def slope(self, at: Derivatives) -> float:
        """Directional derivative of J - tau sum log y."""
        moved = np.concatenate([self.ds0, self.dw])
        return float(at.cost_gradient @ moved - self.tau * np.sum(self.dy / at.iterate.y))


@dataclass(frozen=True)
class Derivatives:
    """What is known at an iterate; `matrices` are F, G, H, H_T and `slopes` r, r_T of `stages.second`, flat.

    cost_gradient: with respect to s_0 and w. gradient: (n_w,) of the Lagrangian, all multipliers included.
    defects: (T n_s,). gap: (n_s,) the given s_0 minus that of the iterate. off: violation of the fixed entries.
    rows: (m,) values of the inequalities.
    """

    iterate: Iterate
    objective: float
    cost_gradient: Array
    gradient: Array
    defects: Array
    gap: Array
    off: Array
    rows: Array
    slopes: list[Array]
    matrices: list[Array]
    n_bounds: int

    @cached_property
    def finite(self) -> bool:
        """True if no value and no first derivative is NaN or infinite."""
        parts = (self.cost_gradient, self.gradient, self.defects, self.rows)
        return bool(np.isfinite(self.objective)) and all(np.isfinite(part).all() for part in parts)

    @cached_property
    def violation(self) -> float:
        """theta: sum of absolute residuals of all constraints."""
        parts = (self.defects, self.gap, self.off, self.rows + self.iterate.y)
        return float(sum(np.abs(part).sum() for part in parts))

    @cached_property
    def _stationarity(self) -> float:
        return largest(self.gradient)

    @cached_property
    def _feasibility(self) -> float:
        return largest(np.concatenate([self.defects, self.gap, self.off, np.maximum(self.rows, 0.0)]))

    @cached_property
    def scale(self) -> float:
        """What the residuals of stationarity and complementarity are relative to, as in `KKTResiduals`."""
        it = self.iterate
        sizes = map(largest, (self.cost_gradient[len(self.gap) :], it.costates, it.z[self.n_bounds :]))
        return max_or_nan(1.0, *sizes)

    def merit(self, tau: float) -> tuple[float, float]:
        """theta, and phi = J - tau sum log y."""
        return self.violation, self.objective - tau * float(np.log(self.iterate.y).sum())

    def residuals(self, tau: float) -> KKTResiduals:
        """The first-order conditions at the iterate, with complementarity tau."""
        forces = self.iterate.z
        return KKTResiduals(
            stationarity=self._stationarity,
            feasibility=self._feasibility,
            complementarity=largest(-self.rows * forces - tau),
            sign=0.0,  # z > 0 always
            scale=self.scale,
        )


class Newton:
    """The functions of one problem with its numbers s0, psi and context."""

    def __init__(self, problem: OCP, s0: Array, psi: Array, context: Array) -> None:
        self.problem, self.s0, self.psi, self.context = problem, s0, psi, context
        self._values, self._first, self._second, self._follow = (
            call(problem, build) for build in (values, first, second, follow)
        )
        steps = newton_step, corrected_step
        self._step, self._corrected = (call_one_of(problem, steps, build) for build in steps)
        self._rows: Rows = rows(problem)

    def start(self, guess: Trajectory | None) -> Iterate:
        """A cold start at a trajectory, or at the rollout of no action: inside the bounds, without multipliers."""
        problem = self.problem
        if guess is None:
            guess = problem.simulate(self.s0, np.zeros((problem.horizon, problem.n_actions)), self.psi)
        states, actions = problem.as_states(guess.states), problem.as_actions(guess.actions)
        w = self._inside(np.concatenate([states[1:].ravel(), actions.ravel()]))
        g = self._rows.evaluate(w, self._path(states[0], w))
        y = np.maximum(-g, _PUSH)
        y[: len(self._rows.bounds)] = -g[: len(self._rows.bounds)]
        costates = np.zeros(problem.horizon * problem.n_states)
        return Iterate(states[0], w, costates, y, np.zeros(len(y)), np.zeros(len(self._rows.fixed)))

    def resume(self, guess: Solution, tau: float) -> Iterate:
        """A warm start: slacks and multipliers of the guess, lifted until their products are at least tau."""
        problem, at, multipliers = self.problem, self._rows, guess.multipliers
        states, actions = problem.as_states(guess.states), problem.as_actions(guess.actions)
        w = np.concatenate([states[1:].ravel(), actions.ravel()])
        nu = np.concatenate([multipliers.state[1:].ravel(), multipliers.action.ravel()])
        z = np.concatenate([np.maximum(at.signs * nu[at.entries], 0.0), np.maximum(multipliers.path.ravel(), 0.0)])
        y = np.maximum(-at.evaluate(w, self._path(states[0], w)), 0.0)
        with np.errstate(divide="ignore"):
            y = np.maximum(y, np.minimum(tau / z, np.sqrt(tau)))
        return Iterate(states[0], w, multipliers.dynamics.ravel(), y, np.maximum(z, tau / y), nu[at.fixed])

    def differentiate(self, at: Iterate, matrices: bool = True) -> Derivatives:
        """Everything that a Newton step needs, or without matrices what residuals need."""
        forces = at.z[len(self._rows.bounds) :]
        outputs = (self._second if matrices else self._first)(
            *self._point(at.s0, at.w), self.psi, self.context, at.costates, forces
        )
        (objective,), defects, path, cost, cost_last, r, r_last = outputs[:7]
        return Derivatives(
            iterate=at,
            objective=float(objective),
            cost_gradient=by_time(self.problem, cost, cost_last),
            gradient=by_time(self.problem, r, r_last)[len(self.s0) :] + self._rows.push(at.z, at.nu, len(at.w)),
            defects=defects,
            gap=self.s0 - at.s0,
            off=at.w[self._rows.fixed] - self._rows.values,
            rows=self._rows.evaluate(at.w, path),
            slopes=[r, r_last],
            matrices=outputs[7:],
            n_bounds=len(self._rows.bounds),
        )

    def step(self, at: Derivatives, tau: float, regularisation: float) -> Step:
        """The Newton step towards tau at an iterate whose derivatives are finite."""
        *changes, pivots, gains = self._step(*self._arguments(at), np.array([tau]), np.array([regularisation]))
        return self._made(at, changes, pivots, gains, tau, regularisation)

    def corrected_step(self, at: Derivatives, least: float, most: float) -> Step:
        """The same, towards a tau between least and most that it chooses, with Mehrotra's correction."""
        limits = (np.array([number]) for number in (least, most))
        *changes, pivots, gains, (tau,) = self._corrected(*self._arguments(at), *limits)
        return self._made(at, changes, pivots, gains, float(tau), 0.0)

    def _arguments(self, at: Derivatives) -> tuple[Array, ...]:
        it = at.iterate
        return (*at.slopes, at.defects, *at.matrices, at.rows, at.off, at.gap, it.y, it.z, it.nu)

    def _made(
        self, at: Derivatives, changes: list[Array], pivots: Array, gains: Array, tau: float, regularisation: float
    ) -> Step:
        ds, du, dcostates, dy, dz, dnu = changes
        return Step(
            ds0=ds[: len(self.s0)],
            dw=np.concatenate([ds[len(self.s0) :], du]),
            dcostates=dcostates,
            dy=dy,
            dz=dz,
            dnu=dnu,
            tau=tau,
            primal_length=longest(at.iterate.y, dy, BOUNDARY),
            dual_length=longest(at.iterate.z, dz, max(BOUNDARY, 1 - tau)),
            regularisation=regularisation,
            positive=bool(((pivots > 0) & (pivots < np.inf)).all() and np.isfinite(du).all()),
            gains=gains,
        )

    def trial(self, at: Derivatives, step: Step, length: float) -> tuple[Iterate, float, float]:
        """The point after a step of this length along the dynamics; its theta and phi, NaN included.

        Bounds keep the share 1 - length of their residual: one that holds holds on. Where that leaves too little of
        a slack, phi is infinite.
        """
        it, n_b, n_s = at.iterate, len(self._rows.bounds), len(at.iterate.s0)
        point = (*self._point(it.s0, it.w), *self._point(step.ds0, step.dw))
        states, actions, (objective,), path = self._follow(
            *point, step.gains, at.defects, np.array([length]), self.psi, self.context
        )
        moved = replace(it.moved(step, length), s0=states[:n_s], w=np.concatenate([states[n_s:], actions]))
        g = self._rows.evaluate(moved.w, path)
        y = np.maximum(moved.y, -g)
        y[:n_b] = (1 - length) * (at.rows + it.y)[:n_b] - g[:n_b]
        off = moved.w[self._rows.fixed] - self._rows.values
        parts = ((1 - length) * at.defects, self.s0 - moved.s0, off, g + y)
        theta = sum(np.abs(part).sum() for part in parts)
        outside = (y < _REMAINDER * (1 - BOUNDARY) * it.y).any()
        phi = np.inf if outside else objective - step.tau * np.log(y).sum()
        return replace(moved, y=y), float(theta), float(phi)

    def centre(self, at: Iterate, tau: float) -> Iterate:
        """The same point with slacks no smaller than what is left of the constraint, and multipliers near tau / y."""
        g = self._rows.evaluate(at.w, self._path(at.s0, at.w))
        y = np.maximum(at.y, -g)
        return replace(at, y=y, z=np.clip(at.z, tau / y / CENTRE, tau / y * CENTRE))

    def trajectory(self, at: Iterate) -> Trajectory:
        """States and actions, time first."""
        steps, n_s, n_u = self.problem.horizon, self.problem.n_states, self.problem.n_actions
        states = np.concatenate([at.s0, at.w[: steps * n_s]])
        return Trajectory(states.reshape(steps + 1, n_s), at.w[steps * n_s :].reshape(steps, n_u).copy())

    def multipliers(self, at: Iterate) -> Multipliers:
        """The multipliers as named arrays, both sides of a bound in one number."""
        steps, n_s, n_u = self.problem.horizon, self.problem.n_states, self.problem.n_actions
        net = self._rows.push(at.z, at.nu, len(at.w))
        return Multipliers.of_given_start(
            dynamics=at.costates.reshape(steps, n_s),
            state=net[: steps * n_s].reshape(steps, n_s),
            action=net[steps * n_s :].reshape(steps, n_u),
            path=at.z[len(self._rows.bounds) :].reshape(steps, self.problem.n_path),
        )

    def _point(self, s0: Array, w: Array) -> tuple[Array, Array]:
        split = self.problem.horizon * self.problem.n_states
        return np.concatenate([s0, w[:split]]), w[split:]

    def _path(self, s0: Array, w: Array) -> Array:
        """Path constraints (T n_h,)."""
        if not self._rows.n_path:
            return np.zeros(0)
        return self._values(*self._point(s0, w), self.psi, self.context)[2]

    def _inside(self, w: Array) -> Array:
        """w moved inside its bounds (Waechter and Biegler, section 3.6), and onto them where they coincide."""
        at, n_low, w = self._rows, len(self._rows.lower), w.copy()
        low, high = np.full(len(w), -np.inf), np.full(len(w), np.inf)
        low[at.lower], high[at.upper] = at.bounds[:n_low], at.bounds[n_low:]
        margin = _PUSH * np.minimum(np.maximum(1.0, np.abs(at.bounds)), (high - low)[at.entries])
        w[at.lower] = np.maximum(w[at.lower], low[at.lower] + margin[:n_low])
        w[at.upper] = np.minimum(w[at.upper], high[at.upper] - margin[n_low:])
        w[at.fixed] = at.values
        return w


def shortened(length: float, before: Iterate, after: Iterate) -> float:
    """Half the length; or more, up to what would have kept the share 1 - BOUNDARY of slacks that shrank too much."""
    share = longest(before.y, after.y - before.y, BOUNDARY)
    return length * (min(max(share, 0.5), 0.95) if share < 1 else 0.5)


def longest(value: Array, change: Array, share: float) -> float:
    """The longest step in (0, 1] that keeps value + length * change at least (1 - share) value; value > 0."""
    return min(1.0, share / max(float(np.max(-change / value, initial=0.0)), share))
