"""Costs over detected keypoints that are ready to plan with, however they were found.

Every member of the family is its weights W (T, n_z) and efforts rho (T,), so one planning problem serves all of them,
with psi = (W row by row, rho). It also serves the rest of a plan: after t steps the weights move up by t rows, and
the steps beyond the horizon get no weight.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import FileError, ProblemError
from kpirl_ocp.irl.cases.cost_files import solver_as_json, solver_of_json
from kpirl_ocp.ocp.models.keypoint_costs import Default, KeypointCost, TimeDependent
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.ocp.models.keypoint_problems import network_ocp
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Solver
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent
from kpirl_ocp.sizes import read_json
from kpirl_ocp.types import Array

_KIND = "kpirl_ocp.visual_cost"


@dataclass(frozen=True, eq=False)
class PlanningCost:
    """A cost and the solver it was learned with, whose number of gradient steps is part of the cost.

    weights: W (T, n_z), row t-1 for z_t. efforts: rho (T,), of u_0 .. u_{T-1}.
    """

    weights: Array
    efforts: Array
    solver: Solver

    @classmethod
    def of(cls, cost: KeypointCost, psi: ArrayLike, horizon: int, n_observations: int, solver: Solver) -> PlanningCost:
        """The member psi (n_psi,) of a family of costs."""
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
        """The remaining cost after `steps` of the plan; effort alone keeps the steps beyond the end at zero."""
        if not 0 <= steps <= self.horizon:
            raise ProblemError(f"steps must be within the plan of {self.horizon}, got {steps}.")
        past_the_end = np.full(steps, self.efforts.max())
        return replace(
            self,
            weights=np.vstack([self.weights[steps:], np.zeros_like(self.weights[:steps])]),
            efforts=np.concatenate([self.efforts[steps:], past_the_end]),
        )


def write_planning_cost(path: Path, cost: PlanningCost, dynamics: NetworkDynamics) -> Path:
    """Write a JSON file with the cost, and the keypoints, joints and rate of the dynamics it was learned with."""
    content = {
        "kind": _KIND,
        "keypoints": dynamics.n_z // 2,
        "unit": "half an image",
        "joints": dynamics.n_joints,
        "rate": dynamics.rate,
        "weights": cost.weights.tolist(),
        "efforts": cost.efforts.tolist(),
        "solver": solver_as_json(cost.solver),  # type: ignore[arg-type]
    }
    path.write_text(json.dumps(content, indent=2) + "\n")
    return path


def read_planning_cost(path: Path, dynamics: NetworkDynamics) -> PlanningCost:
    """The cost of a file that `write_planning_cost` wrote, for dynamics of the same keypoints and joints.

    Raises FileError if the file holds something else, or the cost is for other dynamics.
    """
    try:
        content = read_json(path)
        kind = content["kind"]
        cost = PlanningCost(
            np.array(content["weights"], float), np.array(content["efforts"], float), solver_of_json(content["solver"])
        )
        sizes = content["keypoints"], content["joints"]
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(f"{path} is not a cost over detected keypoints: {error!r}.") from error
    if kind != _KIND or cost.weights.shape != (len(cost.efforts), 2 * sizes[0]):
        raise FileError(f"{path} is not a cost over detected keypoints.")
    if sizes != (dynamics.n_z // 2, dynamics.n_joints):
        needed = f"{dynamics.n_z // 2} keypoints and {dynamics.n_joints} joints"
        raise FileError(f"{path} is for {sizes[0]} keypoints and {sizes[1]} joints; the dynamics have {needed}.")
    return cost


@lru_cache(maxsize=8)
def planning_problem(dynamics: NetworkDynamics, horizon: int) -> OCP:
    """Plan with any `PlanningCost`; context is z_goal (n_z,)."""
    family = KeypointCost(TimeDependent(), effort=(0.0,) * horizon, learn_effort=True)
    return network_ocp(dynamics, family, horizon)
