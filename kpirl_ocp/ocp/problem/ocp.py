"""The optimal-control problem: one class, of which keypoint planning is an instance.

    minimise   sum_{t=0}^{T-1} l(s_t, u_t; psi, c, d_t)  +  l_T(s_T; psi, c, d_T)     over u_0 .. u_{T-1}, free s_0
    subject to s_{t+1} = f(s_t, u_t; psi, c, d_t),
               h(s_t, u_t; psi, c, d_t) <= 0,  e(s_t, u_t; psi, c, d_t) = 0,  u_min,t <= u_t <= u_max,t,   t = 0 .. T-1
               h_T(s_T; psi, c, d_T) <= 0,     e_T(s_T; psi, c, d_T) = 0,     s_min,t <= s_t <= s_max,t,   t = 1 .. T

psi are the learned parameters, c is the context of one demonstration, and d_t, the schedule, holds numbers that change
from stage to stage (a time basis, a reference, a step length), so that one stage function serves all stages.

Rows of h that do not depend on the action hold at s_T too, with d_T: `OCP.terminal_inequality` lists them before those
of h_T. Rows of h and h_T that zeros and ones of d_t switch off, such as d_t g, have the value -1 there. s_0 is given,
and then not bounded; or it is free within `initial_bounds`, entry by entry.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.dynamics import DynamicsDerivatives
from kpirl_ocp.ocp.problem.guards import dense, one_at_a_time
from kpirl_ocp.ocp.problem.statement.arrays import Arrays
from kpirl_ocp.ocp.problem.statement.checks import (
    UNBOUNDED,
    Bounds,
    bounds_of,
    check_function,
    horizon_of,
    schedule_of,
)
from kpirl_ocp.ocp.problem.statement.complete import complete
from kpirl_ocp.ocp.problem.statement.draft import Additions, Draft
from kpirl_ocp.ocp.problem.statement.expressions import inputs_of, kind_of
from kpirl_ocp.ocp.problem.statement.soft import Soft
from kpirl_ocp.ocp.problem.statement.summary import summary
from kpirl_ocp.ocp.problem.statement.switches import with_interior
from kpirl_ocp.types import Trajectory


@dataclass(frozen=True, eq=False, repr=False)
class OCP(Arrays):
    """An optimal-control problem in stage functions (`ca.Function`, SX or MX).

    dynamics: f(s, u, psi, c, d) -> s_next (n_s,), or f(s, u, psi).
    stage_cost: l(s, u, psi, c, d) -> scalar.
    terminal_cost: l_T(s, psi, c, d) -> scalar.
    horizon: T, the number of actions.
    path_constraint: h(s, u, psi, c, d) -> (n_h,), to be <= 0 at t = 0 .. T-1; rows without u at s_T too. None for none.
    path_equality: e(s, u, psi, c, d) -> (n_e,), to be 0 at t = 0 .. T-1; None for none.
    terminal_constraint: h_T(s, psi, c, d) -> (n_hT,), to be <= 0 at s_T; None for none.
    terminal_equality: e_T(s, psi, c, d) -> (n_eT,), to be 0 at s_T; None for none.
    observation: s -> z (n_z,), what a demonstration shows of a state; None for the state itself.
    action_bounds: (lower, upper), each broadcast to (T, n_u).
    state_bounds: (lower, upper), each broadcast to (T+1, n_s). Row 0 counts for the free entries of s_0 alone.
    initial_bounds: (lower, upper) of s_0, each broadcast to (n_s,): free where they differ; where they are equal, s_0
        is given by the argument s0, whatever their value. None: all of s_0 is given.
    schedule: (T+1, n_d), row t is d_t.
    derivatives: those of the dynamics, where better ones than CasADi's AD are known, and f depends on neither c nor d.
    additions: the last states and actions, which `from_expressions` added for static decisions and soft constraints.

    Raises ProblemError when dimensions disagree. `OCP.from_expressions` builds one from symbols.
    """

    dynamics: ca.Function
    stage_cost: ca.Function
    terminal_cost: ca.Function
    horizon: int
    path_constraint: ca.Function | None = None
    observation: ca.Function | None = None
    action_bounds: Bounds = UNBOUNDED
    state_bounds: Bounds = UNBOUNDED
    schedule: ArrayLike | None = None
    derivatives: DynamicsDerivatives | None = None
    path_equality: ca.Function | None = field(default=None, kw_only=True)
    terminal_constraint: ca.Function | None = field(default=None, kw_only=True)
    terminal_equality: ca.Function | None = field(default=None, kw_only=True)
    initial_bounds: Bounds | None = field(default=None, kw_only=True)
    additions: Additions = field(default=Additions(), kw_only=True)

    def __post_init__(self) -> None:
        object.__setattr__(self, "horizon", horizon_of(self.horizon))
        object.__setattr__(self, "schedule", schedule_of(self.schedule, self.horizon))
        self._check_signatures(np.asarray(self.schedule).shape[1])
        for name in ("path_constraint", "terminal_constraint"):
            object.__setattr__(self, name, with_interior(getattr(self, name), np.asarray(self.schedule)))
        steps, n_s, n_u = self.horizon, self.n_states, self.n_actions
        shapes = {"action_bounds": (steps, n_u), "state_bounds": (steps + 1, n_s), "initial_bounds": (n_s,)}
        for name, shape in shapes.items():
            if getattr(self, name) is not None:
                object.__setattr__(self, name, bounds_of(name, getattr(self, name), shape))
        if (self.limits[0][0] > self.limits[1][0]).any():
            raise ProblemError("initial_bounds and row 0 of state_bounds must leave s_0 some value.")
        if self.derivatives is not None and self.dynamics_see_stage:
            raise ProblemError("derivatives must be left out where the dynamics depend on the context or the schedule.")

    @classmethod
    def from_expressions(
        cls,
        *,
        state: ca.MX | ca.SX,
        dynamics: ca.MX | ca.SX,
        horizon: int,
        action: ca.MX | ca.SX | None = None,
        stage_cost: ca.MX | ca.SX | float = 0.0,
        terminal_cost: ca.MX | ca.SX | float = 0.0,
        parameters: ca.MX | ca.SX | None = None,
        context: ca.MX | ca.SX | None = None,
        stage: ca.MX | ca.SX | None = None,
        path_constraint: ca.MX | ca.SX | None = None,
        path_equality: ca.MX | ca.SX | None = None,
        terminal_constraint: ca.MX | ca.SX | None = None,
        terminal_equality: ca.MX | ca.SX | None = None,
        observation: ca.MX | ca.SX | None = None,
        action_bounds: Bounds = UNBOUNDED,
        state_bounds: Bounds = UNBOUNDED,
        initial_bounds: Bounds | None = None,
        schedule: ArrayLike | None = None,
        static: ca.MX | ca.SX | None = None,
        static_bounds: Bounds = UNBOUNDED,
        soft: Soft | None = None,
    ) -> OCP:
        """State a problem in CasADi expressions of the symbols state, action, parameters, context and stage (d_t).

        Symbols that do not occur may be left out, even the action. All must be of one kind, SX or MX.

        Args:
            action_bounds, state_bounds, initial_bounds: as in `OCP`, or expressions of parameters, context, stage and
                static; these become rows of the path constraint, so that they are differentiated.
            static: q (n_q,), decisions that do not change over the horizon, for use in every expression; they are
                added to the state (`static_of` reads them). s0 may be given without them; with them, their values are
                where a solve without `guess` starts.
            static_bounds: (lower, upper) of q, each a number or (n_q,). Left out of s0, q starts in the middle; if one
                of them is infinite, at zero, or at lower + 1 or upper - 1 where zero is not between them.
            soft: a constraint that may be violated at a price; its slacks are added to the actions, and one for every
                row on states alone to the state (`stated` leaves them out).
        """
        symbols = {"state": state, "action": action, "parameters": parameters, "context": context, "stage": stage}
        draft = Draft(
            symbols,
            horizon,
            schedule,
            dynamics=dynamics,
            stage_cost=stage_cost,
            terminal_cost=terminal_cost,
            path_constraint=path_constraint,
            path_equality=path_equality,
            terminal_constraint=terminal_constraint,
            terminal_equality=terminal_equality,
            observation=observation,
        )
        return cls(**complete(draft, action_bounds, state_bounds, initial_bounds, static, static_bounds, soft))

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self.horizon} steps: {summary(self)}>"

    def __getstate__(self) -> dict[str, Any]:
        """The fields, without what was derived from them."""
        return {name: self.__dict__[name] for name in self.__dataclass_fields__}

    def unconstrained(self) -> OCP:
        """This problem without bounds and constraints other than the dynamics, as in the paper.

        Raises ProblemError where slacks of a soft constraint would be left without it.
        """
        if self.additions.slacks:
            raise ProblemError("state the problem without `soft` to leave its constraints out: its slacks need bounds.")
        return replace(
            self,
            path_constraint=None,
            path_equality=None,
            terminal_constraint=None,
            terminal_equality=None,
            action_bounds=UNBOUNDED,
            state_bounds=UNBOUNDED,
        )

    def transition_numbers(self, psi: ca.MX, context: ca.MX) -> ca.MX:
        """p of `transition` at t = 0 .. T-1, (n_p, T)."""
        wide = ca.repmat(psi, 1, self.horizon)
        if not self.dynamics_see_stage:
            return wide
        return ca.vertcat(wide, ca.repmat(context, 1, self.horizon), self.stages[:, :-1])

    @cached_property
    def dynamics_derivatives(self) -> DynamicsDerivatives:
        """The derivatives of `transition`: those given, else by AD."""
        return self.derivatives or DynamicsDerivatives.by_ad(self.transition)

    @cached_property
    def stages(self) -> ca.DM:
        """The schedule (n_d, T+1), time along columns as everywhere inside CasADi."""
        return ca.DM(np.asarray(self.schedule)).T

    @cached_property
    def rollout(self) -> ca.Function:
        """(s0 (n_s,), U (n_u, T), psi, c) -> states (n_s, T+1)."""
        s0, (_, actions, psi, context) = ca.MX.sym("s0", self.n_states), self.symbols()
        numbers = self.transition_numbers(psi, context)
        states = self.transition.mapaccum(self.horizon)(s0, actions, numbers)
        return ca.Function("rollout", [s0, actions, psi, context], [ca.horzcat(s0, states)])

    @cached_property
    def cost(self) -> ca.Function:
        """(S (n_s, T+1), U (n_u, T), psi, c) -> the objective of this states-and-actions pair, dynamics or not."""
        point = self.symbols()
        total = ca.sum2(self.at_stages(self.stage_cost, *point)) + self.at_end(self.terminal_cost, *point)
        return ca.Function("cost", point, [total])

    @cached_property
    def path(self) -> ca.Function:
        """(S (n_s, T+1), U (n_u, T), psi, c) -> path constraints (n_h, T)."""
        point = self.symbols()
        return ca.Function("path", point, [self.at_stages(self.path_constraint, *point)])

    @cached_property
    def observe(self) -> ca.Function:
        """States (n_s, T+1) -> observations (n_z, T+1)."""
        states = ca.MX.sym("S", self.n_states, self.horizon + 1)
        seen = states if self.observation is None else self.observation.map(self.horizon + 1)(states)
        return ca.Function("observe", [states], [seen])

    def symbols(self) -> list[ca.MX]:
        """S (n_s, T+1), U (n_u, T), psi and c."""
        shapes = {"S": (self.n_states, self.horizon + 1), "U": (self.n_actions, self.horizon)}
        shapes |= {"psi": (self.n_parameters, 1), "c": (self.n_context, 1)}
        return [ca.MX.sym(name, *shape) for name, shape in shapes.items()]

    def at_stages(self, function: ca.Function | None, states: ca.MX, actions: ca.MX, psi: ca.MX, c: ca.MX) -> ca.MX:
        """A stage function (s, u, psi, c, d) -> (n,) at t = 0 .. T-1 of S, U: (n, T); (0, T) for None."""
        if function is None:
            return ca.MX(0, self.horizon)
        wide = [ca.repmat(value, 1, self.horizon) for value in (psi, c)]
        return function.map(self.horizon)(states[:, :-1], actions, *wide, self.stages[:, :-1])

    def at_end(self, function: ca.Function | None, states: ca.MX, actions: ca.MX, psi: ca.MX, c: ca.MX) -> ca.MX:
        """A terminal function (s, psi, c, d) -> (n,) at s_T of S; (0,) for None."""
        return ca.MX(0, 1) if function is None else function(states[:, -1], psi, c, self.stages[:, -1])

    @one_at_a_time
    def simulate(
        self, s0: ArrayLike, actions: ArrayLike, psi: ArrayLike = (), context: ArrayLike | None = None
    ) -> Trajectory:
        """Roll the dynamics out from s0 (n_s,) with actions (T, n_u). The context may be left out if f ignores it."""
        actions = self.as_actions(actions)
        if context is None and not self.dynamics_see_stage:
            context = np.zeros(self.n_context)
        numbers = self.inputs(s0, psi, () if context is None else context)
        states = self.rollout(numbers[0], actions.T, *numbers[1:])
        return Trajectory(dense(states).T, actions)

    def _check_signatures(self, n_schedule: int) -> None:
        """Raise ProblemError when a function does not fit the others; dynamics of three inputs become ones of five."""
        given = {"dynamics": self.dynamics, "stage_cost": self.stage_cost}
        for name, function in given.items():
            if not isinstance(function, ca.Function):
                raise ProblemError(f"{name} must be a casadi.Function, got {function!r}.")
        n_context = self.stage_cost.size1_in(3) if self.stage_cost.n_in() == 5 else 0
        if self.dynamics.n_in() == 3:
            object.__setattr__(self, "dynamics", _with_stage(self.dynamics, n_context, n_schedule))
        if self.dynamics.n_in() != 5:
            raise ProblemError(f"dynamics must be f(s, u, psi, c, d) or f(s, u, psi), got {self.dynamics}.")
        s, u, psi = (self.dynamics.size1_in(i) for i in range(3))
        stage, end = (s, u, psi, n_context, n_schedule), (s, psi, n_context, n_schedule)
        check_function("dynamics", self.dynamics, stage, s)
        check_function("stage_cost", self.stage_cost, stage, 1)
        check_function("terminal_cost", self.terminal_cost, end, 1)
        optional = {"path_constraint": stage, "path_equality": stage, "observation": (s,)}
        optional |= {"terminal_constraint": end, "terminal_equality": end}
        for name, sizes in optional.items():
            if getattr(self, name) is not None:
                check_function(name, getattr(self, name), sizes, None)


def _with_stage(dynamics: ca.Function, n_context: int, n_schedule: int) -> ca.Function:
    """f(s, u, psi) as f(s, u, psi, c, d)."""
    inputs = inputs_of(dynamics)
    others = [kind_of(dynamics).sym(name, length) for name, length in (("c", n_context), ("d", n_schedule))]
    return ca.Function("dynamics", [*inputs, *others], dynamics.call(inputs, True, False))
