"""Costs over detected keypoints in one common form, with which to plan.

Every cost is given by its weights W (T, n_z) and efforts rho (T,), so that one planning problem serves them all, with
psi = (W row by row, rho). It also serves to plan again during execution: after t steps the weights are shifted by t
rows, and steps beyond the horizon get zero weight.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.episodes import write_whole
from kpirl_ocp.errors import FileError, ProblemError
from kpirl_ocp.irl.cases.cost_files import VISUAL, solver_as_json, solver_of_json
from kpirl_ocp.irl.cases.json_fields import a_list, a_value, an_object
from kpirl_ocp.ocp.models.keypoint_costs import Default, KeypointCost, TimeDependent
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.ocp.models.keypoint_problems import network_ocp
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Solver
from kpirl_ocp.ocp.problem.statement.checks import numbers
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent
from kpirl_ocp.sizes import read_json
from kpirl_ocp.types import Array


@dataclass(frozen=True)
class ArmLimits:
    """An arm and the limits within which to plan.

    robot: "iiwa", a name of example-robot-data, or the path of a URDF. lower, upper: of n_joints joints [rad].
    max_displacement: largest |u| per step and joint [rad].
    """

    robot: str
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    max_displacement: float = np.inf


@dataclass(frozen=True, eq=False)
class PlanningCost:
    """A cost and the solver it was learned with, whose number of gradient steps is part of the cost.

    weights: W (T, n_z), row t-1 for z_t. efforts: rho (T,), of u_0 .. u_{T-1}.
    limits: of the arm; None where they are not known, or the solver knows no bounds.
    """

    weights: Array
    efforts: Array
    solver: Solver
    limits: ArmLimits | None = None

    @classmethod
    def of(cls, cost: KeypointCost, psi: ArrayLike, horizon: int, n_observations: int, solver: Solver) -> PlanningCost:
        """The cost with parameters psi (n_psi,) of a family of costs."""
        return cls(*cost.weights(psi, horizon, n_observations), solver)

    @classmethod
    def default(cls, horizon: int, n_observations: int, solver: GradientDescent) -> PlanningCost:
        """The paper's Default cost: W = 1, no effort."""
        return cls.of(KeypointCost(Default()), (), horizon, n_observations, solver)

    @property
    def horizon(self) -> int:
        """T."""
        return len(self.weights)

    @property
    def psi(self) -> Array:
        """The parameters of `planning_problem`."""
        return np.concatenate([self.weights.ravel(), self.efforts])

    def after(self, steps: int) -> PlanningCost:
        """The remaining cost after `steps` of the plan; steps beyond the end cost effort only, and so stay at zero."""
        if not 0 <= steps <= self.horizon:
            raise ProblemError(f"steps must be within the plan of {self.horizon}, got {steps}.")
        past_the_end = np.full(steps, self.efforts.max())
        return replace(
            self,
            weights=np.vstack([self.weights[steps:], np.zeros_like(self.weights[:steps])]),
            efforts=np.concatenate([self.efforts[steps:], past_the_end]),
        )


def write_planning_cost(path: Path, cost: PlanningCost, dynamics: NetworkDynamics) -> Path:
    """Write a JSON file: the cost, its arm with limits, and keypoints, joints and rate of the dynamics."""
    content = {
        "kind": VISUAL,
        "robot": None if cost.limits is None else cost.limits.robot,
        "limits": None if cost.limits is None else _limits_as_json(cost.limits),
        "keypoints": dynamics.n_z // 2,
        "unit": "half an image",
        "joints": dynamics.n_joints,
        "rate": dynamics.rate,
        "weights": cost.weights.tolist(),
        "efforts": cost.efforts.tolist(),
        "solver": solver_as_json(cost.solver),  # type: ignore[arg-type]
    }
    write_whole(path, json.dumps(content, indent=2) + "\n")
    return path


def read_planning_cost(path: Path, dynamics: NetworkDynamics) -> PlanningCost:
    """The cost of a file that `write_planning_cost` wrote, for dynamics of the same keypoints and joints.

    Raises FileError if the file holds something else, or the cost is for other dynamics.
    """
    try:
        content = an_object("it", read_json(path))
        kind = content["kind"]
        cost = PlanningCost(
            numbers("weights", content["weights"]),
            numbers("efforts", content["efforts"]),
            solver_of_json(content["solver"]),
            _limits_of_json(content.get("robot"), content.get("limits")),
        )
        sizes = tuple(a_value(name, content[name], "int") for name in ("keypoints", "joints"))
    except KeyError as error:
        raise FileError(f"{path} is not a cost over detected keypoints: it has no {error}.") from error
    except ValueError as error:
        raise FileError(f"{path} is not a cost over detected keypoints: {str(error).removesuffix('.')}.") from error
    if kind != VISUAL or cost.efforts.ndim != 1 or cost.weights.shape != (len(cost.efforts), 2 * sizes[0]):
        raise FileError(f"{path} is not a cost over detected keypoints.")
    if sizes != (dynamics.n_z // 2, dynamics.n_joints):
        needed = f"{dynamics.n_z // 2} keypoints and {dynamics.n_joints} joints"
        raise FileError(f"{path} is for {sizes[0]} keypoints and {sizes[1]} joints; the dynamics have {needed}.")
    if cost.limits is not None and len(cost.limits.lower) != dynamics.n_joints:
        raise FileError(f"{path} has limits of {len(cost.limits.lower)} joints; the dynamics have {dynamics.n_joints}.")
    return cost


def _limits_as_json(limits: ArmLimits) -> dict[str, Any]:
    """null stands for no limit."""
    rows = {"lower": limits.lower, "upper": limits.upper}
    content: dict[str, Any] = {name: [_finite(value) for value in row] for name, row in rows.items()}
    return content | {"unit": "rad", "max_displacement": _finite(limits.max_displacement)}


def _limits_of_json(robot: Any, content: Any) -> ArmLimits | None:
    if robot is None or content is None:
        return None
    given = an_object("limits", content)
    lower, upper = (
        tuple(_limit(f"limits.{name}", value, sign * np.inf) for value in a_list(f"limits.{name}", given[name]))
        for name, sign in (("lower", -1), ("upper", 1))
    )
    most = _limit("limits.max_displacement", given["max_displacement"], np.inf)
    return ArmLimits(a_value("robot", robot, "str"), lower, upper, most)


def _limit(name: str, value: Any, none: float) -> float:
    """A number; null stands for none."""
    return none if value is None else float(a_value(name, value, "float"))


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


@lru_cache(maxsize=8)
def planning_problem(dynamics: NetworkDynamics, horizon: int, limits: ArmLimits | None = None) -> OCP:
    """Plan with any `PlanningCost`, within the limits of its arm; context is z_goal (n_z,)."""
    return limited_network_ocp(dynamics, all_weights(horizon), horizon, limits)


@lru_cache(maxsize=16)
def learning_problem(dynamics: NetworkDynamics, cost: KeypointCost, horizon: int) -> OCP:
    """`network_ocp` to learn a cost with, without limits: one for all who learn, so that its functions are built once.

    The basis of the cost must be hashable.
    """
    return network_ocp(dynamics, cost, horizon)


def all_weights(horizon: int) -> KeypointCost:
    """The family of `planning_problem`, whose parameters are the weights and efforts of every step themselves."""
    return KeypointCost(TimeDependent(), effort=(0.0,) * horizon, learn_effort=True)


def limited_network_ocp(
    dynamics: NetworkDynamics, cost: KeypointCost, horizon: int, limits: ArmLimits | None = None
) -> OCP:
    """`network_ocp` within the limits of an arm."""
    if limits is None:
        return network_ocp(dynamics, cost, horizon)
    bounds = np.array(limits.lower), np.array(limits.upper)
    return network_ocp(dynamics, cost, horizon, joint_limits=bounds, max_displacement=limits.max_displacement)
