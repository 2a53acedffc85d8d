"""Problems and their solutions in other units of cost, states, actions and constraints."""

from dataclasses import replace

import casadi as ca
import numpy as np

from kpirl_ocp.types import Trajectory


def drawn_units(problem, seed):
    """Between 1e-3 and 1e3 for the cost, the constraints, and every state and action on its own."""
    rng = np.random.default_rng(seed)
    cost, rows = (float(10 ** rng.uniform(-3, 3)) for _ in range(2))
    state, action = (10 ** rng.uniform(-3, 3, count) for count in (problem.n_states, problem.n_actions))
    return {"cost": cost, "rows": rows, "state": state, "action": action}


def start_in_units(problem, s0, guess, units):
    """The initial state, completed, and a guess, if there is one, for `in_units`."""
    if guess is not None:
        states, actions = problem.as_states(guess.states), problem.as_actions(guess.actions)
        guess = Trajectory(states / units["state"], actions / units["action"])
    return s0 / units["state"], guess


def in_units(problem, cost=1.0, state=1.0, action=1.0, rows=1.0):
    """The problem whose states are s / state and actions u / action, with cost times `cost` and constraints `rows`.

    state: (n_s,) or a number. action: (n_u,) or a number.
    """
    of = (np.broadcast_to(state, problem.n_states), np.broadcast_to(action, problem.n_actions))

    def inside(function, factor):
        if function is None:
            return None
        kind = ca.SX if function.is_a("SXFunction") else ca.MX
        given = [kind.sym(f"x{i}", *function.size_in(i)) for i in range(function.n_in())]
        last = function.n_in() < problem.stage_cost.n_in()
        moved = [x * ca.DM(unit) if unit is not None else x for x, unit in zip(given, units_of(last), strict=False)]
        return ca.Function(function.name(), given, [factor * function(*moved)])

    def units_of(last):
        return [of[0], *([] if last else [of[1]]), None, None, None]

    def bounds(pair, unit):
        return None if pair is None else tuple(np.asarray(side) / unit for side in pair)

    return replace(
        problem,
        dynamics=inside(problem.dynamics, ca.DM(1 / of[0])),
        stage_cost=inside(problem.stage_cost, cost),
        terminal_cost=inside(problem.terminal_cost, cost),
        path_constraint=inside(problem.path_constraint, rows),
        path_equality=inside(problem.path_equality, rows),
        terminal_constraint=inside(problem.terminal_constraint, rows),
        terminal_equality=inside(problem.terminal_equality, rows),
        observation=None,
        state_bounds=bounds(problem.state_bounds, of[0]),
        action_bounds=bounds(problem.action_bounds, of[1]),
        initial_bounds=bounds(problem.initial_bounds, of[0]),
        derivatives=None,
    )


def solution_in_units(solution, cost=1.0, state=1.0, action=1.0, rows=1.0):
    """The same solution of `in_units`; residuals stay as they are."""
    m = solution.multipliers
    forces = {name: getattr(m, name) * cost / rows for name in ("path", "terminal", "path_equality")}
    return replace(
        solution,
        trajectory=Trajectory(solution.states / state, solution.actions / action),
        multipliers=replace(
            m,
            dynamics=m.dynamics * cost * state,
            state=m.state * cost * state,
            action=m.action * cost * action,
            terminal_equality=m.terminal_equality * cost / rows,
            **forces,
        ),
        objective=solution.objective * cost,
    )
