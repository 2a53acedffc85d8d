"""A learned cost on disk: one JSON file with everything needed to plan with it again."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from kpirl_ocp.errors import FileError
from kpirl_ocp.ocp.models.keypoint_costs import RBF, Basis, Default, KeypointCost, TimeDependent, Weighted
from kpirl_ocp.ocp.models.keypoint_problems import keypoint_ocp
from kpirl_ocp.ocp.models.robot import Robot
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent
from kpirl_ocp.ocp.solvers.ipopt import Ipopt
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.types import Array

BASES: dict[str, type] = {"weighted": Weighted, "time": TimeDependent, "rbf": RBF, "default": Default}
SOLVERS: dict[str, type] = {"gradient_descent": GradientDescent, "riccati": Riccati, "ipopt": Ipopt}


@dataclass(frozen=True)
class LearnedCost:
    """A keypoint cost with its parameters, and the inner solver it was learned for.

    psi: (n_psi,). horizon: T. solver: of gradient descent, steps and step size are part of the learned cost.
    """

    cost: KeypointCost
    psi: Array
    horizon: int
    solver: GradientDescent | Riccati | Ipopt

    def problem(self, robot: Robot) -> OCP:
        """The planning problem of this cost; without constraints if the solver is gradient descent."""
        problem = keypoint_ocp(robot, self.cost, self.horizon)
        return problem.unconstrained() if isinstance(self.solver, GradientDescent) else problem

    def write(self, path: Path) -> None:
        """Write the JSON file."""
        content = {
            "basis": _name_of(BASES, self.cost.basis) | asdict(self.cost.basis),  # type: ignore[call-overload]
            "effort": self.cost.effort,
            "learn_effort": self.cost.learn_effort,
            "positivity": self.cost.positivity,
            "psi": self.psi.tolist(),
            "horizon": self.horizon,
            "solver": _name_of(SOLVERS, self.solver) | asdict(self.solver),
        }
        path.write_text(json.dumps(content, indent=2) + "\n")

    @classmethod
    def read(cls, path: Path) -> LearnedCost:
        """The cost of a file that `write` wrote.

        Raises:
            FileError: the file is missing or is no learned cost; the message names it.
        """
        try:
            content = json.loads(path.read_text())
            effort = content["effort"]
            cost = KeypointCost(
                basis=_build(BASES, content["basis"]),
                effort=tuple(effort) if isinstance(effort, list) else effort,
                learn_effort=content["learn_effort"],
                positivity=content["positivity"],
            )
            psi, horizon = np.array(content["psi"], float), content["horizon"]
            return cls(cost, psi, horizon, _build(SOLVERS, content["solver"]))
        except FileNotFoundError:
            raise FileError(f"{path} does not exist: learn a cost with scripts/learn_cost.py.") from None
        except (KeyError, TypeError, ValueError) as error:
            raise FileError(f"{path} is not a learned cost: {error!r}.") from error


def make_basis(name: str) -> Basis:
    """A basis by the name the scripts use."""
    return BASES[name]()


def _name_of(kinds: dict[str, type], value: object) -> dict[str, object]:
    return {"kind": next(name for name, kind in kinds.items() if isinstance(value, kind))}


def _build(kinds: dict[str, type], content: dict[str, object]):  # type: ignore[no-untyped-def]
    arguments = dict(content)
    return kinds[str(arguments.pop("kind"))](**arguments)
