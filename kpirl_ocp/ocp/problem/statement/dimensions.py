"""Sizes of a problem, and other properties that follow from its stage functions and bounds."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.ocp.problem.statement.checks import UNBOUNDED, Bounds
from kpirl_ocp.ocp.problem.statement.draft import Additions
from kpirl_ocp.ocp.problem.statement.expressions import inputs_of, kind_of
from kpirl_ocp.ocp.problem.statement.switches import live_rows
from kpirl_ocp.types import Array, Indices, Mask


class Live(NamedTuple):
    """True for equalities that the schedule does not switch off, as d_t = 0 does with a row d_t g."""

    path_equality: Mask
    terminal_equality: Mask


class Dimensions:
    """Properties derived from the fields of an `OCP`, each when it is first read."""

    dynamics: ca.Function
    stage_cost: ca.Function
    terminal_cost: ca.Function
    path_constraint: ca.Function | None
    path_equality: ca.Function | None
    terminal_constraint: ca.Function | None
    terminal_equality: ca.Function | None
    observation: ca.Function | None
    action_bounds: Bounds
    state_bounds: Bounds
    initial_bounds: Bounds | None
    additions: Additions
    schedule: ArrayLike | None

    @cached_property
    def n_states(self) -> int:
        """n_s."""
        return self.dynamics.size1_in(0)

    @cached_property
    def n_actions(self) -> int:
        """n_u."""
        return self.dynamics.size1_in(1)

    @cached_property
    def n_stated_states(self) -> int:
        """Length of the state without the entries that `from_expressions` has added."""
        return self.n_states - len(self.additions.states)

    @cached_property
    def n_stated_actions(self) -> int:
        """Length of the action without the entries that `from_expressions` has added."""
        return self.n_actions - self.additions.slacks

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
        return _n_rows(self.path_constraint)

    @cached_property
    def n_path_equality(self) -> int:
        """n_e, path equalities per stage."""
        return _n_rows(self.path_equality)

    @cached_property
    def n_terminal(self) -> int:
        """n_gT, rows of `terminal_inequality`."""
        return _n_rows(self.terminal_inequality)

    @cached_property
    def n_terminal_equality(self) -> int:
        """n_eT, terminal equalities."""
        return _n_rows(self.terminal_equality)

    @cached_property
    def n_observations(self) -> int:
        """n_z, length of the observation of one state."""
        return self.n_states if self.observation is None else self.observation.size1_out(0)

    @cached_property
    def has_action_bounds(self) -> bool:
        """True if any action bound is finite."""
        return bool(np.isfinite(np.asarray(self.action_bounds, float)).any())

    @cached_property
    def has_state_constraints(self) -> bool:
        """True if there are constraints other than dynamics and action bounds."""
        rows = self.n_path + self.n_path_equality + self.n_terminal + self.n_terminal_equality
        return bool(np.isfinite(np.asarray(self.state_bounds, float)[:, 1:]).any()) or rows > 0

    @cached_property
    def free_start(self) -> Mask:
        """(n_s,) True where s_0 is a decision."""
        if self.initial_bounds is None:
            return np.zeros(self.n_states, bool)
        lower, upper = self.initial_bounds
        return np.asarray(lower) < np.asarray(upper)

    @cached_property
    def limits(self) -> tuple[Array, Array]:
        """Lower and upper bounds (T+1, n_s) of all states that solvers use: `state_bounds`, but for row 0.

        In row 0, given entries are not bounded, and free ones obey both `state_bounds` and `initial_bounds`.
        """
        lower, upper = (np.array(bound) for bound in self.state_bounds)
        initial = self.initial_bounds or UNBOUNDED
        lower[0] = np.where(self.free_start, np.maximum(lower[0], initial[0]), -np.inf)
        upper[0] = np.where(self.free_start, np.minimum(upper[0], initial[1]), np.inf)
        return lower, upper

    @cached_property
    def state_rows(self) -> Indices:
        """The rows of h that do not depend on the action, and hold at s_T too."""
        if self.path_constraint is None:
            return np.zeros(0, np.intp)
        depend_on_u = np.unique(self.path_constraint.jac_sparsity(0, 1).get_triplet()[0])
        return np.setdiff1d(np.arange(self.n_path), depend_on_u)

    @cached_property
    def terminal_inequality(self) -> ca.Function | None:
        """g_T(s, psi, c, d) <= 0: the rows `state_rows` of h, then h_T; None if there are none."""
        if not len(self.state_rows):
            return self.terminal_constraint
        parts = [part for part in (self.path_constraint, self.terminal_constraint) if part is not None]
        kind = kind_of(*parts)
        s, *numbers = (kind.sym(name, self.terminal_cost.size1_in(i)) for i, name in enumerate(("s", "psi", "c", "d")))
        rows = parts[0](s, kind.zeros(self.n_actions), *numbers)[self.state_rows.tolist()]
        own = [part(s, *numbers) for part in parts[1:]]
        return ca.Function("terminal_inequality", [s, *numbers], [ca.vertcat(rows, *own)])

    @cached_property
    def live(self) -> Live:
        """(T, n_e) and (n_eT,); equalities that are not live constrain nothing, and solvers may leave them out."""
        d = np.asarray(self.schedule, float)
        return Live(live_rows(self.path_equality, d[:-1]), live_rows(self.terminal_equality, d[-1:])[0])

    @cached_property
    def dynamics_see_stage(self) -> bool:
        """True if f depends on the context c or the stage's numbers d."""
        return any(self.dynamics.jac_sparsity(0, i).nnz() for i in (3, 4))

    @cached_property
    def transition(self) -> ca.Function:
        """f(s, u, p) with all its numbers in one vector: p is psi, or (psi, c, d) where f sees the context or d."""
        f = self.dynamics
        s, u, psi, *others = inputs_of(f)
        kind = type(s)
        if not self.dynamics_see_stage:
            unseen = [kind.zeros(other.shape) for other in others]
            return ca.Function("transition", [s, u, psi], f.call([s, u, psi, *unseen], True, False))
        ends = np.cumsum([0, psi.numel(), *(other.numel() for other in others)]).tolist()
        p = kind.sym("p", ends[-1])
        return ca.Function("transition", [s, u, p], f.call([s, u, *ca.vertsplit(p, ends)], True, False))


def _n_rows(function: ca.Function | None) -> int:
    return 0 if function is None else function.size1_out(0)
