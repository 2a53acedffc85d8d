"""The closed loop in the scene, driven by the exported controller, ends where the Python solver takes it."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("cv2")
pytest.importorskip("torch")
pytest.importorskip("pybullet")

from exported import loaded

from kpirl_ocp import Riccati
from kpirl_ocp.assets import shipped_model
from kpirl_ocp.irl.cases.planar_arm import planar_dynamics
from kpirl_ocp.irl.visual.closed_loop import KeypointController
from kpirl_ocp.irl.visual.demonstrations import positions
from kpirl_ocp.irl.visual.planning_costs import PlanningCost, planning_problem
from kpirl_ocp.ocp.export import export_c
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.plant.camera_plant import CameraPlant
from kpirl_ocp.perception.scene.scene import Scene

HORIZON, RATE = 4, 1  # Hz, of the placing model
START = np.array([0.0, 0.3, 0.0, -1.7, 0.0, -0.42, 0.0])
MOVE = np.array([0.0, 0.15, 0.0, -0.1, 0.0, 0.1, 0.0])


def drive(loop, detector):
    """Keypoints at the end, and the goal that was seen before."""
    with Scene(rate=RATE) as scene:
        scene.reset(START + MOVE)
        goal = positions(CameraPlant(scene, detector).look().keypoints)
        scene.reset(START)
        done = loop.run(CameraPlant(scene, detector), goal)
    return positions(done.keypoints), goal, done


def test_the_compiled_controller_reaches_the_same_final_distance(tmp_path):
    detector = KeypointDetector.load(shipped_model("detector"))
    dynamics = planar_dynamics(shipped_model("placing"))
    python = Riccati(1e-8)
    cost = PlanningCost(np.ones((HORIZON, dynamics.n_z)), np.full(HORIZON, 0.1), python)
    problem = planning_problem(dynamics, HORIZON)
    compiled = loaded(export_c(problem, python, tmp_path, psi=cost.psi))

    seen, goal, done = drive(KeypointController.build(dynamics, cost), detector)
    ours, _, same = drive(KeypointController.build(dynamics, replace(cost, solver=compiled)), detector)
    distances = [float(np.linalg.norm(path[-1] - goal)) for path in (seen, ours)]
    assert distances[0] < 0.5 * np.linalg.norm(seen[0] - goal)
    assert distances[1] == pytest.approx(distances[0], abs=1e-6)
    np.testing.assert_allclose(same.actions, done.actions, rtol=0, atol=1e-6)
    assert all("kpirl_mpc" in plan.message for plan in same.plans)
