"""A learned cost on disk: one JSON file with everything needed to plan with it again."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from kpirl_ocp.episodes import write_whole
from kpirl_ocp.errors import FileError
from kpirl_ocp.irl.cases.json_fields import a_list, a_value, an_object, fields_of
from kpirl_ocp.ocp.models.keypoint_costs import RBF, Basis, Default, KeypointCost, TimeDependent, Weighted
from kpirl_ocp.ocp.models.keypoint_problems import keypoint_ocp, keypoint_state
from kpirl_ocp.ocp.models.pinhole import Pinhole
from kpirl_ocp.ocp.models.robot import Keypoint, Robot
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.statement.checks import horizon_of, number, numbers, shown
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent
from kpirl_ocp.ocp.solvers.ipopt import Ipopt
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.sizes import read_json
from kpirl_ocp.types import Array

VISUAL = "kpirl_ocp.visual_cost"  # another kind of cost.json: over detected keypoints, with learned dynamics
BASES: dict[str, type] = {"weighted": Weighted, "time": TimeDependent, "rbf": RBF, "default": Default}
_OPEN = "max_displacement"  # null stands for no limit
SOLVERS: dict[str, type] = {"gradient_descent": GradientDescent, "riccati": Riccati, "ipopt": Ipopt}


def robot_called(name: str, keypoints: tuple[Keypoint, ...] = ()) -> Robot:
    """The iiwa, a robot of example-robot-data, or that of a .urdf file."""
    if name == "iiwa":
        return Robot.iiwa(keypoints)
    own = "." in name or "/" in name
    return Robot.from_urdf(name, keypoints) if own else Robot.from_example_data(name, keypoints)


@dataclass(frozen=True, eq=False)
class ArmSetting:
    """The arm, and its keypoints as the cost sees them.

    robot: "iiwa", a name of example-robot-data, or the path of a URDF. keypoints: on it; () for its own three.
    unit: of a keypoint coordinate [m], or [pixels] with a camera. camera: that sees them; None for points in space.
    joint_limits: theta keeps to those of the URDF. max_displacement: |u| per step and joint [rad].
    """

    robot: str = "iiwa"
    keypoints: tuple[Keypoint, ...] = ()
    unit: float = 1.0
    camera: Pinhole | None = None
    joint_limits: bool = True
    max_displacement: float = np.inf

    def build(self) -> Robot:
        """The robot with its keypoints. Raises RobotError if there is none of that name."""
        return robot_called(self.robot, self.keypoints)

    def problem(self, robot: Robot, cost: KeypointCost, horizon: int, goals: Array | None = None) -> OCP:
        """Plan with a cost over T steps; goals: as in `keypoint_ocp`."""
        return keypoint_ocp(
            robot,
            cost,
            horizon,
            unit=self.unit,
            camera=self.camera,
            joint_limits=self.joint_limits,
            max_displacement=self.max_displacement,
            goals=goals,
        )

    def state(self, robot: Robot, theta: Array) -> Array:
        """The state (n_s,) of the arm at rest at theta (n_joints,) [rad]."""
        return keypoint_state(robot, theta, self.unit, self.camera)


@dataclass(frozen=True, eq=False)
class LearnedCost:
    """A keypoint cost with its parameters, and the inner solver it was learned for.

    psi: (n_psi,). horizon: T. solver: of gradient descent, steps and step size are part of the learned cost.
    setting: the arm it was learned with. start: (n_joints,) joint positions at the start of the demonstration [rad].
    displacement: (n_z,) from the keypoints there to the goal. Both are empty if the goal comes from elsewhere.
    rate: [Hz] of the steps in the demonstration; 0 if it is unknown.
    goals: (T, n_z) of the steps, from the goal, as in `keypoint_ocp`; None where the goal is that of all steps.
    """

    cost: KeypointCost
    psi: Array
    horizon: int
    solver: GradientDescent | Riccati | Ipopt
    setting: ArmSetting = field(default_factory=ArmSetting)
    start: Array = field(default_factory=lambda: np.zeros(0))
    displacement: Array = field(default_factory=lambda: np.zeros(0))
    rate: float = 0.0
    goals: Array | None = None

    def problem(self, robot: Robot) -> OCP:
        """The planning problem of this cost; without constraints if the solver is gradient descent."""
        problem = self.setting.problem(robot, self.cost, self.horizon, self.goals)
        return problem.unconstrained() if isinstance(self.solver, GradientDescent) else problem

    def preview(self) -> Array:
        """Rows (T-1, n_d) that follow the schedule of the problem; see `KeypointCost.preview`."""
        rows = self.cost.preview(self.horizon)
        return rows if self.goals is None else np.hstack([rows, np.zeros_like(self.goals[1:])])

    def goal(self, s0: Array) -> Array:
        """z_goal (n_z,) of the learned displacement from a state s0 (n_s,)."""
        return np.asarray(s0[: len(self.displacement)] + self.displacement, float)

    def write(self, path: Path) -> None:
        """Write the JSON file."""
        content = {
            "basis": _name_of(BASES, self.cost.basis) | asdict(self.cost.basis),  # type: ignore[call-overload]
            "effort": self.cost.effort,
            "learn_effort": self.cost.learn_effort,
            "positivity": self.cost.positivity,
            "psi": self.psi.tolist(),
            "horizon": self.horizon,
            "solver": solver_as_json(self.solver),
            "arm": _setting_as_json(self.setting),
            "start": self.start.tolist(),
            "displacement": self.displacement.tolist(),
            "rate": self.rate,
            "goals": None if self.goals is None else self.goals.tolist(),
        }
        write_whole(path, json.dumps(content, indent=2) + "\n")

    @classmethod
    def read(cls, path: Path) -> LearnedCost:
        """The cost of a file that `write` wrote.

        Raises:
            FileError: the file is missing or is no learned cost; the message names it.
        """
        try:
            content = an_object("it", read_json(path))
            if content.get("kind") == VISUAL:
                raise ValueError(
                    "it is a cost over detected keypoints: plan with it, or export it, by "
                    f"`kpirl learn-video FILM --detector CARD --dynamics CARD --cost {path} [--export]`."
                )
            effort = numbers("effort", content["effort"])
            cost = KeypointCost(
                basis=_build(BASES, "basis", content["basis"]),
                effort=tuple(effort) if effort.ndim else float(effort),
                learn_effort=a_value("learn_effort", content["learn_effort"], "bool"),
                positivity=a_value("positivity", content["positivity"], "str"),
            )
            psi, horizon = _numbers("psi", content["psi"]), horizon_of(content["horizon"])
            cost.basis.matrix(horizon)  # refuses what does not fit the horizon
            learned = cls(cost, psi, horizon, solver_of_json(content["solver"]))
            return replace(
                learned,
                setting=_setting_of_json(content.get("arm", {})),
                start=_numbers("start", content.get("start", ())),
                displacement=_numbers("displacement", content.get("displacement", ())),
                rate=number("rate", content.get("rate", 0.0), "a number of at least 0", np.nextafter(0, -1)),
                goals=_goals(content.get("goals"), horizon),
            )
        except FileNotFoundError:
            raise FileError(f"{path} does not exist: learn a cost with `kpirl learn`.") from None
        except KeyError as error:
            raise FileError(f"{path} is not a learned cost: it has no {error}.") from error
        except ValueError as error:
            raise FileError(f"{path} is not a learned cost: {str(error).removesuffix('.')}.") from error


def _numbers(name: str, values: Any) -> Array:
    """A list of finite numbers (n,)."""
    array = numbers(name, values)
    if array.ndim != 1 or not np.isfinite(array).all():
        raise ValueError(f"{name} must be a list of finite numbers, got {shown(values)}")
    return array


def _goals(values: Any, horizon: int) -> Array | None:
    """A row (n_z,) of finite numbers for each step; None for none."""
    if values is None:
        return None
    array = numbers("goals", values)
    if array.ndim != 2 or len(array) != horizon or not np.isfinite(array).all():
        raise ValueError(f"goals must be {horizon} rows of finite numbers, got {shown(values)}")
    return array


def make_basis(name: str) -> Basis:
    """A basis by the name the scripts use."""
    return BASES[name]()


def solver_as_json(solver: GradientDescent | Riccati | Ipopt) -> dict[str, Any]:
    """Kind and settings of a solver."""
    return _name_of(SOLVERS, solver) | asdict(solver)


def solver_of_json(content: Any) -> GradientDescent | Riccati | Ipopt:
    """The solver of `solver_as_json`. Raises ValueError if the content is of something else."""
    solver: GradientDescent | Riccati | Ipopt = _build(SOLVERS, "solver", content)
    return solver


def _setting_as_json(setting: ArmSetting) -> dict[str, Any]:
    camera = setting.camera
    names = ("intrinsics", "rotation", "translation")
    return {
        "robot": setting.robot,
        "keypoints": [asdict(keypoint) for keypoint in setting.keypoints],
        "unit": setting.unit,
        "camera": None if camera is None else {name: getattr(camera, name).tolist() for name in names},
        "joint_limits": setting.joint_limits,
        "max_displacement": setting.max_displacement if np.isfinite(setting.max_displacement) else None,
    }


def _setting_of_json(content: Any) -> ArmSetting:
    present = {name: value for name, value in an_object("arm", content).items() if value is not None or name != _OPEN}
    given = fields_of(ArmSetting, "arm", present)
    camera, most = given.get("camera"), given.get(_OPEN)
    entries = a_list("arm.keypoints", given.get("keypoints", []))
    keypoints = [_keypoint_of_json(f"arm.keypoints[{i}]", entry) for i, entry in enumerate(entries)]
    return ArmSetting(
        robot=given.get("robot", "iiwa"),
        keypoints=tuple(keypoints),
        unit=number("arm.unit", given.get("unit", 1.0), "a positive number", 0),
        camera=None if camera is None else Pinhole(**fields_of(Pinhole, "camera", camera)),
        joint_limits=given.get("joint_limits", True),
        max_displacement=np.inf if most is None else number(f"arm.{_OPEN}", most, "a positive number", 0),
    )


def _keypoint_of_json(name: str, content: Any) -> Keypoint:
    given = fields_of(Keypoint, name, content)
    position = _numbers(f"{name}.position", given["position"])
    if len(position) != 3:
        raise ValueError(f"{name}.position must be three numbers, got {shown(given['position'])}")
    return Keypoint(given["link"], tuple(position.tolist()))


def _name_of(kinds: dict[str, type], value: object) -> dict[str, object]:
    return {"kind": next(name for name, kind in kinds.items() if isinstance(value, kind))}


def _build(kinds: dict[str, type], name: str, content: Any):  # type: ignore[no-untyped-def]
    arguments = dict(an_object(name, content))
    kind = arguments.pop("kind", None)
    if not isinstance(kind, str) or kind not in kinds:
        raise ValueError(f"{name}.kind must be one of {', '.join(kinds)}, got {shown(kind)}")
    return kinds[kind](**fields_of(kinds[kind], name, arguments))
