"""The optimal-control problem: one class, of which keypoint planning is an instance.

    minimise   sum_{t=0}^{T-1} l(s_t, u_t; psi, c, d_t)  +  l_T(s_T; psi, c, d_T)     over u_0 .. u_{T-1}
    subject to s_{t+1} = f(s_t, u_t; psi),  s_0 given,
               u_min <= u_t <= u_max,  s_min <= s_{t+1} <= s_max,  h(s_t, u_t; psi, c, d_t) <= 0,   t = 0 .. T-1

psi are the learned parameters, c is the context of one demonstration, and d_t, the schedule, holds numbers that change
from stage to stage (a time basis, a reference), so that one stage function serves all stages.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.dynamics import DynamicsDerivatives
from kpirl_ocp.types import Array, Trajectory

Bounds = tuple[ArrayLike, ArrayLike]
UNBOUNDED: Bounds = (-np.inf, np.inf)


@dataclass(frozen=True, eq=False)
class OCP:
    """An optimal-control problem in stage functions (`ca.Function`, SX or MX).

    dynamics: f(s, u, psi) -> s_next (n_s,).
    stage_cost: l(s, u, psi, c, d) -> scalar.
    terminal_cost: l_T(s, psi, c, d) -> scalar.
    horizon: T, number of actions.
    path_constraint: h(s, u, psi, c, d) -> (n_h,), to be <= 0; None for none.
    observation: s -> z (n_z,), what a demonstration shows of a state; None for the state itself.
    action_bounds, state_bounds: (lower, upper), each broadcast to (n_u,) or (n_s,). The given s_0 is not bounded.
    schedule: (T+1, n_d), row t is d_t.
    derivatives: of the dynamics, where something better than CasADi's AD is known.

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
    schedule: ArrayLike | None = field(default=None, repr=False)
    derivatives: DynamicsDerivatives | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if not isinstance(self.horizon, int | np.integer) or isinstance(self.horizon, bool) or self.horizon < 1:
            raise ProblemError(f"horizon must be a whole number of at least 1 step, got {self.horizon!r}.")
        object.__setattr__(self, "horizon", int(self.horizon))
        schedule = np.zeros((self.horizon + 1, 0)) if self.schedule is None else np.asarray(self.schedule, float)
        if schedule.ndim != 2 or len(schedule) != self.horizon + 1 or not np.isfinite(schedule).all():
            raise ProblemError(
                f"schedule must be finite and (T+1, n_d) = ({self.horizon + 1}, n_d), got {schedule.shape}."
            )
        object.__setattr__(self, "schedule", schedule)
        self._check_signatures(schedule.shape[1])
        object.__setattr__(self, "action_bounds", broadcast_bounds("action_bounds", self.action_bounds, self.n_actions))
        object.__setattr__(self, "state_bounds", broadcast_bounds("state_bounds", self.state_bounds, self.n_states))

    @classmethod
    def from_expressions(
        cls,
        *,
        state: ca.MX | ca.SX,
        action: ca.MX | ca.SX,
        dynamics: ca.MX | ca.SX,
        stage_cost: ca.MX | ca.SX,
        horizon: int,
        terminal_cost: ca.MX | ca.SX | float = 0.0,
        parameters: ca.MX | ca.SX | None = None,
        context: ca.MX | ca.SX | None = None,
        stage: ca.MX | ca.SX | None = None,
        path_constraint: ca.MX | ca.SX | None = None,
        observation: ca.MX | ca.SX | None = None,
        action_bounds: Bounds = UNBOUNDED,
        state_bounds: Bounds = UNBOUNDED,
        schedule: ArrayLike | None = None,
    ) -> OCP:
        """State a problem in CasADi expressions of the symbols state, action, parameters, context and stage (d_t).

        Symbols that do not occur may be left out. All must be of one kind, SX or MX.
        """
        s, u = state, action
        nothing = type(state).sym("none", 0)
        psi, c, d = (nothing if symbol is None else symbol for symbol in (parameters, context, stage))

        def function(name: str, inputs: Sequence[ca.MX | ca.SX], output: ca.MX | ca.SX | float) -> ca.Function:
            try:
                return ca.Function(name, inputs, [output])
            except RuntimeError as error:
                raise ProblemError(
                    f"{name}: its symbols are not among those passed in. CasADi says: {error}"
                ) from error

        return cls(
            dynamics=function("dynamics", [s, u, psi], dynamics),
            stage_cost=function("stage_cost", [s, u, psi, c, d], stage_cost),
            terminal_cost=function("terminal_cost", [s, psi, c, d], terminal_cost),
            horizon=horizon,
            path_constraint=None if path_constraint is None else function("path", [s, u, psi, c, d], path_constraint),
            observation=None if observation is None else function("observation", [s], observation),
            action_bounds=action_bounds,
            state_bounds=state_bounds,
            schedule=schedule,
        )

    @cached_property
    def n_states(self) -> int:
        """n_s."""
        return self.dynamics.size1_in(0)

    @cached_property
    def n_actions(self) -> int:
        """n_u."""
        return self.dynamics.size1_in(1)

    @cached_property
    def n_parameters(self) -> int:
        """Length of psi."""
        return self.dynamics.size1_in(2)

    @cached_property
    def n_context(self) -> int:
        """Length of c."""
        return self.stage_cost.size1_in(3)

    @cached_property
    def n_path(self) -> int:
        """n_h, path constraints per stage."""
        return 0 if self.path_constraint is None else self.path_constraint.size1_out(0)

    @cached_property
    def n_observations(self) -> int:
        """n_z, length of what a demonstration shows of one state."""
        return self.n_states if self.observation is None else self.observation.size1_out(0)

    @cached_property
    def has_action_bounds(self) -> bool:
        """True if any action bound is finite."""
        return bool(np.isfinite(np.asarray(self.action_bounds, float)).any())

    @cached_property
    def has_state_constraints(self) -> bool:
        """True if any state bound is finite or there are path constraints."""
        return bool(np.isfinite(np.asarray(self.state_bounds, float)).any()) or self.n_path > 0

    def unconstrained(self) -> OCP:
        """The same problem without bounds and path constraints, as in the paper."""
        return replace(self, path_constraint=None, action_bounds=UNBOUNDED, state_bounds=UNBOUNDED)

    @cached_property
    def dynamics_derivatives(self) -> DynamicsDerivatives:
        """The derivatives of the dynamics: those given, else by AD."""
        return self.derivatives or DynamicsDerivatives.by_ad(self.dynamics)

    @cached_property
    def rollout(self) -> ca.Function:
        """(s0 (n_s,), U (n_u, T), psi) -> states (n_s, T+1); time runs along columns, as everywhere inside CasADi."""
        s0, actions, psi = ca.MX.sym("s0", self.n_states), self._actions(), ca.MX.sym("psi", self.n_parameters)
        states = self.dynamics.mapaccum(self.horizon)(s0, actions, ca.repmat(psi, 1, self.horizon))
        return ca.Function("rollout", [s0, actions, psi], [ca.horzcat(s0, states)])

    @cached_property
    def cost(self) -> ca.Function:
        """(S (n_s, T+1), U (n_u, T), psi, c) -> the objective of this states-and-actions pair, dynamics or not."""
        steps = self.horizon
        states, actions = ca.MX.sym("S", self.n_states, steps + 1), self._actions()
        psi, context = ca.MX.sym("psi", self.n_parameters), ca.MX.sym("c", self.n_context)
        schedule = ca.DM(np.asarray(self.schedule)).T  # (n_d, T+1)
        stages = self.stage_cost.map(steps)(
            states[:, :steps], actions, ca.repmat(psi, 1, steps), ca.repmat(context, 1, steps), schedule[:, :steps]
        )
        total = ca.sum2(stages) + self.terminal_cost(states[:, steps], psi, context, schedule[:, steps])
        return ca.Function("cost", [states, actions, psi, context], [total])

    @cached_property
    def path(self) -> ca.Function:
        """(S (n_s, T+1), U (n_u, T), psi, c) -> path constraints (n_h, T)."""
        steps = self.horizon
        states, actions = ca.MX.sym("S", self.n_states, steps + 1), self._actions()
        psi, context = ca.MX.sym("psi", self.n_parameters), ca.MX.sym("c", self.n_context)
        values = ca.MX(0, steps)
        if self.path_constraint is not None:
            schedule = ca.DM(np.asarray(self.schedule)).T[:, :steps]
            values = self.path_constraint.map(steps)(
                states[:, :steps], actions, ca.repmat(psi, 1, steps), ca.repmat(context, 1, steps), schedule
            )
        return ca.Function("path", [states, actions, psi, context], [values])

    @cached_property
    def observe(self) -> ca.Function:
        """States (n_s, T+1) -> observations (n_z, T+1)."""
        states = ca.MX.sym("S", self.n_states, self.horizon + 1)
        seen = states if self.observation is None else self.observation.map(self.horizon + 1)(states)
        return ca.Function("observe", [states], [seen])

    def simulate(self, s0: ArrayLike, actions: ArrayLike, psi: ArrayLike = ()) -> Trajectory:
        """Roll the dynamics out from s0 (n_s,) with actions (T, n_u)."""
        actions = self.as_actions(actions)
        states = self.rollout(_vector("s0", s0, self.n_states), actions.T, _vector("psi", psi, self.n_parameters))
        return Trajectory(np.array(states).T, actions)

    def inputs(self, s0: ArrayLike, psi: ArrayLike, context: ArrayLike) -> tuple[Array, Array, Array]:
        """The three as float64 vectors. Raises ProblemError when a length is wrong."""
        return (
            _vector("s0", s0, self.n_states),
            _vector("psi", psi, self.n_parameters),
            _vector("context", context, self.n_context),
        )

    def as_actions(self, actions: ArrayLike) -> Array:
        """Actions as a float64 array (T, n_u). Raises ProblemError for another shape."""
        return _matrix("actions", "(T, n_u)", actions, (self.horizon, self.n_actions))

    def as_states(self, states: ArrayLike) -> Array:
        """States as a float64 array (T+1, n_s). Raises ProblemError for another shape."""
        return _matrix("states", "(T+1, n_s)", states, (self.horizon + 1, self.n_states))

    def _actions(self) -> ca.MX:
        return ca.MX.sym("U", self.n_actions, self.horizon)

    def _check_signatures(self, n_schedule: int) -> None:
        if self.dynamics.n_in() != 3:
            raise ProblemError(f"dynamics must be f(s, u, psi), got {self.dynamics}.")
        s, u, psi = (self.dynamics.size1_in(i) for i in range(3))
        n_context = self.stage_cost.size1_in(3) if self.stage_cost.n_in() == 5 else 0
        expected = {
            "dynamics": (self.dynamics, (s, u, psi), s),
            "stage_cost": (self.stage_cost, (s, u, psi, n_context, n_schedule), 1),
            "terminal_cost": (self.terminal_cost, (s, psi, n_context, n_schedule), 1),
            "path_constraint": (self.path_constraint, (s, u, psi, n_context, n_schedule), None),
            "observation": (self.observation, (s,), None),
        }
        for name, (function, sizes, size_out) in expected.items():
            if function is None:
                continue
            found = tuple(function.size1_in(i) for i in range(function.n_in()))
            columns = all(function.size2_in(i) == 1 for i in range(function.n_in()))
            out = (function.n_out(), *function.size_out(0))
            if found != sizes or not columns or out != (1, size_out if size_out is not None else out[1], 1):
                raise ProblemError(
                    f"{name} must take column vectors of lengths {sizes} and return one column"
                    f"{'' if size_out is None else f' of length {size_out}'}; it is {function}."
                )


def _vector(name: str, value: ArrayLike, length: int) -> Array:
    array = np.asarray(value, float).reshape(-1)
    if len(array) != length:
        raise ProblemError(f"{name} must have length {length}, got {len(array)}.")
    return array


def _matrix(name: str, axes: str, value: ArrayLike, shape: tuple[int, int]) -> Array:
    array = np.asarray(value, float)
    if array.shape != shape:
        raise ProblemError(f"{name} must be {axes} = {shape}, got {array.shape}.")
    return array


def broadcast_bounds(name: str, bounds: Bounds, length: int) -> tuple[Array, Array]:
    """Lower and upper (length,) of bounds that may be numbers. Raises ProblemError when they make no interval."""
    try:
        lower, upper = (np.array(np.broadcast_to(np.asarray(bound, float), (length,))) for bound in bounds)
    except (TypeError, ValueError) as error:
        raise ProblemError(f"{name} must be (lower, upper), each a number or ({length},).") from error
    if not ((lower <= upper) & (lower < np.inf) & (upper > -np.inf)).all():
        raise ProblemError(
            f"{name} must be numbers: no lower bound above its upper bound or at inf, no upper bound at -inf."
        )
    return lower, upper
