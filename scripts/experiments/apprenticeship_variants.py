"""Does apprenticeship learning oscillate, as the paper says? Its choices that the paper leaves open, side by side.

Features: squared distances to the goal (the Weighted cost), or the per-step IRL losses of appendix A.4, per coordinate.
Rule: the largest margin, the program of the code that the paper cites, the projection; and the signs as printed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from experiments.study import Case
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.learning.apprenticeship import apprenticeship
from kpirl_ocp.irl.learning.margins import Rule, largest_margin, max_margin, projection, two_sided
from kpirl_ocp.ocp.models.keypoint_costs import KeypointCost, Weighted
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.reporting import spread
from kpirl_ocp.types import Array, Demonstration

RULES: Mapping[str, Rule] = {
    "largest margin": largest_margin,
    "the cited code's program": two_sided,
    "projection": projection,
    "signs as printed": lambda found, expert: max_margin(expert - found),
}
FEATURES = ("distance to the goal", "per-step IRL loss")
_LATE = 0.5  # oscillation is counted over this last share of the epochs
_SWING = 0.1  # a change of the loss by this share counts


@dataclass(frozen=True)
class Variant:
    """One choice on one task and seed.

    losses: (epochs,) training IRL loss; empty if the rule had no solution from the start. swings: share of late epochs
    in which it rises by more than a tenth. test: mean test loss of the best psi, as a Weighted cost.
    """

    losses: Array
    test: float
    swings: float


def rows_of(runs: Mapping[str, list[dict[str, Variant]]]) -> list[list[str]]:
    """Best and last training loss and test loss, mean ± deviation over seeds, and late swings: task -> its runs."""
    rows = []
    for task, found in runs.items():
        for name in found[0]:
            solved = [run[name] for run in found if len(run[name].losses)]
            if not solved:
                rows.append([f"{task}: {name}", "no solution", "", "", ""])
                continue
            columns = ([v.losses.min() for v in solved], [v.losses[-1] for v in solved], [v.test for v in solved])
            spreads = [spread(column) for column in columns]
            rows.append([f"{task}: {name}", *spreads, f"{100 * np.mean([v.swings for v in solved]):.0f} %"])
    return rows


HEADER = ["apprenticeship: features, rule", "best train loss [m²]", "last", "test loss [m²]", "late swings"]


def run_variants(case: Case) -> dict[str, Variant]:
    """Every pair of features and rule, as "<features>, <rule>"."""
    return {
        f"{features}, {name}": _run(case, features == FEATURES[1], rule)
        for features in FEATURES
        for name, rule in RULES.items()
    }


def _run(case: Case, following: bool, rule: Rule) -> Variant:
    problem, train = case.problem(KeypointCost(Weighted())), case.train
    learned_in, seen = (_following(problem), [_target(demo) for demo in train]) if following else (problem, train)
    settings, rng = case.settings, np.random.default_rng(case.seed)
    try:
        result = apprenticeship(learned_in, seen, settings.inner, settings.iterations, rng, rule=rule)
    except ProblemError:  # no cost to begin with
        return Variant(np.zeros(0), np.nan, np.nan)
    late = result.losses[-max(2, int(_LATE * len(result.losses))) :]
    curve = case.curve(problem, settings.inner, result.psi[None], result.seconds)
    return Variant(result.losses, float(curve.test[0]), float(np.mean(np.diff(late) > _SWING * late[:-1])))


def _target(demonstration: Demonstration) -> Demonstration:
    """The demonstration as its own target, step by step."""
    return replace(demonstration, context=demonstration.observations[1:].ravel())


def _following(problem: OCP) -> OCP:
    """The Weighted problem with a target for every step as context: sum_t sum_i psi_i (z_t[i] - c_t[i])^2."""
    steps, n_z = problem.horizon, problem.n_observations
    state, action = ca.SX.sym("s", problem.n_states), ca.SX.sym("u", problem.n_actions)
    psi, targets, selector = ca.SX.sym("psi", n_z), ca.SX.sym("c", n_z * steps), ca.SX.sym("d", steps)
    error = problem.observation(state) - ca.reshape(targets, n_z, steps) @ selector
    cost = ca.sum1(selector) * ca.dot(psi, error**2)
    nothing = ca.SX.zeros(problem.n_context), ca.SX.zeros(np.shape(problem.schedule)[1])
    return replace(
        problem,
        dynamics=ca.Function("dynamics", [state, action, psi], [problem.dynamics(state, action, psi, *nothing)]),
        stage_cost=ca.Function("stage_cost", [state, action, psi, targets, selector], [cost]),
        terminal_cost=ca.Function("terminal_cost", [state, psi, targets, selector], [cost]),
        schedule=np.vstack([np.zeros(steps), np.eye(steps)]),
    )
