"""Faults of a cost.json are said in the words of the file."""

import json
import re

import numpy as np
import pytest

from kpirl_ocp.errors import FileError
from kpirl_ocp.irl.cases.cost_files import SOLVERS, ArmSetting, LearnedCost
from kpirl_ocp.irl.visual.planning_costs import ArmLimits, PlanningCost, read_planning_cost, write_planning_cost
from kpirl_ocp.ocp.models.keypoint_costs import RBF, KeypointCost
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.ocp.models.mlp import MLP
from kpirl_ocp.ocp.models.pinhole import Pinhole
from kpirl_ocp.ocp.models.robot import Keypoint
from kpirl_ocp.ocp.solvers.riccati import Riccati

WRONG = (None, True, "x", -1, 1.5, [], [1], {}, {"a": 1}, [[1], [2, 3]])
PYTHON = re.compile(r"Error\(|object|not supported|unexpected|could not convert|inhomogeneous|iterable")


def a_cost(solver: str) -> LearnedCost:
    camera = Pinhole(np.eye(3), np.eye(3), np.zeros(3))
    setting = ArmSetting(keypoints=(Keypoint("link", (0.0, 0.0, 0.1)),), camera=camera, max_displacement=0.5)
    cost = KeypointCost(RBF(4), effort=(1.0,) * 10, learn_effort=True)
    numbers = {"start": np.zeros(7), "displacement": np.zeros(2), "rate": 1.0}
    return LearnedCost(cost, np.ones(18), 10, SOLVERS[solver](), setting, **numbers)


def faults(content):
    """The content with one field replaced by a value of another kind, with the field's name."""
    for name, value in content.items():
        for wrong in WRONG:
            yield name, {**content, name: wrong}
        if isinstance(value, dict):
            yield "surplus", {**content, name: {**value, "surplus": 1}}
            yield from ((inner, {**content, name: changed}) for inner, changed in faults(value))


@pytest.mark.parametrize("solver", SOLVERS)
def test_no_fault_of_a_cost_file_is_said_in_the_words_of_python(tmp_path, solver):
    path = tmp_path / "cost.json"
    a_cost(solver).write(path)
    refused = 0
    for name, changed in faults(json.loads(path.read_text())):
        path.write_text(json.dumps(changed))
        try:
            LearnedCost.read(path)
        except FileError as error:
            text = str(error).removeprefix(str(path)).replace("must be an object", "")
            assert name in text, (name, text)
            assert not PYTHON.search(text), (name, text)
            refused += 1
    assert refused > 200


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("learn_effort", "no"),
        ("basis.kernels", -1),
        ("basis.kernels", 4.0),
        ("solver.project", "yes"),
        ("solver.tolerance", 0.0),
        ("solver.steps", True),
        ("arm.unit", 0),
        ("arm.joint_limits", None),
        ("arm.max_displacement", -0.1),
        ("arm.robot", {}),
        ("arm.keypoints", [{"link": "link", "position": [0, 0]}]),
        ("arm.keypoints", [{"link": 1, "position": [0, 0, 0]}]),
    ],
)
def test_a_value_that_could_not_be_planned_with_is_refused_when_the_file_is_read(tmp_path, place, value):
    path = tmp_path / "cost.json"
    a_cost("gradient_descent").write(path)
    content = json.loads(path.read_text())
    *outer, name = place.split(".")
    (content[outer[0]] if outer else content)[name] = value
    path.write_text(json.dumps(content))
    with pytest.raises(FileError, match=name.rstrip("s")):
        LearnedCost.read(path)


def test_no_fault_of_a_cost_over_detected_keypoints_is_said_in_the_words_of_python(tmp_path):
    dynamics = NetworkDynamics(MLP((np.zeros((4, 10)),), (np.zeros(4),), ("identity",)), 4, 2)
    limits = ArmLimits("iiwa", (-1.0, -np.inf), (1.0, 2.0))
    cost = PlanningCost(np.ones((3, 4)), np.ones(3), Riccati(), limits)
    path = write_planning_cost(tmp_path / "cost.json", cost, dynamics)
    assert read_planning_cost(path, dynamics).limits == limits
    for name, changed in faults(json.loads(path.read_text())):
        path.write_text(json.dumps(changed))
        try:
            read_planning_cost(path, dynamics)
        except FileError as error:
            text = str(error).removeprefix(str(path)).replace("must be an object", "")
            assert not PYTHON.search(text), (name, text)
