"""`kpirl learn-video --dynamics`: person and arm seen by one detector, and a network that says how keypoints move."""

import json
from dataclasses import replace

import numpy as np
import pytest
from problems import TABLE

pytest.importorskip("av")
pytest.importorskip("cv2")
pytest.importorskip("pybullet")
pytest.importorskip("torch")

from kpirl_ocp import Riccati, Status
from kpirl_ocp.assets import shipped_model
from kpirl_ocp.cli.imitation.learned_dynamics import Plan, in_half_images, plans_from
from kpirl_ocp.cli.main import run
from kpirl_ocp.episodes import read_episode
from kpirl_ocp.errors import FileError, SolveError
from kpirl_ocp.irl.visual.learning import CONVERGED
from kpirl_ocp.irl.visual.planning_costs import ArmLimits, PlanningCost, read_planning_cost, write_planning_cost
from kpirl_ocp.ocp.models.dynamics_files import load_dynamics
from kpirl_ocp.ocp.models.robot import Robot
from kpirl_ocp.perception.data.encoding import write_video
from kpirl_ocp.perception.data.motions import Placing
from kpirl_ocp.perception.data.recordings import ArmRecording
from kpirl_ocp.perception.scene.hand import HandScene, placing_path
from kpirl_ocp.perception.tracking.tracks import Tracks

MODELS = [f"--{name}={shipped_model(model)}" for name, model in (("detector", "detector"), ("dynamics", "placing"))]


@pytest.fixture(scope="module")
def placing(tmp_path_factory):
    """A person places the bottle; without loss, because x264 differs from run to run."""
    with HandScene() as scene:
        frames = scene.film(placing_path(np.random.default_rng(0), rate=10))
    return write_video(tmp_path_factory.mktemp("film") / "placing.mp4", frames, 10, codec="h264", quality=0)


def test_half_images_are_those_of_the_square_in_the_middle_and_displacements_are_scaled():
    positions = np.array([[[320.0, 180.0]], [[380.0, 120.0]], [[500.0, 180.0]]])
    tracks = Tracks(np.array([0.0, 0.5, 1.0]), positions, np.full((3, 1), 0.8), (640, 360))
    found = in_half_images(tracks, 2, 0.5)
    np.testing.assert_allclose(found.keypoints[:, 0], [[0, 0, 0.8], [1 / 6, -1 / 6, 0.8], [0.5, 0, 0.8]])
    np.testing.assert_allclose(found.times, [0, 0.5, 1])


class Planner:
    """Plans for a point that is pushed, of which those from far starts need a guess."""

    def __init__(self):
        self.case, self.guesses = TABLE["integrator"](), []

    def plan(self, state, goal, guess=None):
        self.guesses.append(guess)
        solver = Riccati(max_iterations=1 if guess is None and state[0] > 0 else 100)
        return solver.solve(self.case.problem, state, self.case.psi, goal, guess)


def test_a_start_from_which_no_plan_is_found_from_rest_begins_with_the_plan_of_the_first():
    planner = Planner()
    seen = planner.case.demonstration
    near, far = (replace(seen, s0=np.array([x, 0.0])) for x in (-0.1, 0.1))
    first, same, second = plans_from(planner, [near, near, far])
    assert [found.status for found in (first, same, second)] == [Status.CONVERGED] * 3
    assert planner.guesses == [None, None, first, None, first]
    np.testing.assert_array_equal(second.states[0], far.s0)
    with pytest.raises(SolveError, match="iteration limit"):
        plans_from(planner, [far])


def test_an_arm_repeats_a_film_with_dynamics_that_were_learned(placing, tmp_path, capsys):
    words = [*MODELS, "--steps", "10", "--export", "--out", str(tmp_path)]
    assert run(["learn-video", str(placing), *words]) == 0, capsys.readouterr()
    results = json.loads((tmp_path / "metrics.json").read_text())["results"]
    assert len(results["executed"]) == 3
    assert max(results["planned"]) < 0.1
    assert max(results["executed"]) < 0.1
    assert np.shape(results["weights"]) == (10, 8)
    assert (tmp_path / "c" / "Makefile").exists()
    assert (tmp_path / "paths.png").stat().st_size > 0
    content = json.loads((tmp_path / "cost.json").read_text())
    assert (content["robot"], content["keypoints"], content["unit"]) == ("iiwa", 4, "half an image")
    lower, upper = Robot.iiwa().joint_limits
    np.testing.assert_allclose([content["limits"][side] for side in ("lower", "upper")], [lower, upper])
    plan = read_episode(tmp_path / "plan.npz", Plan)
    assert np.all((plan.joints >= lower) & (plan.joints <= upper))
    again = [*MODELS, "--steps", "10", "--cost", str(tmp_path / "cost.json")]
    assert run(["learn-video", str(placing), *again, "--out", str(tmp_path / "again")]) == 0, capsys.readouterr()
    assert not (tmp_path / "again" / "cost.json").exists()
    found = json.loads((tmp_path / "again" / "metrics.json").read_text())["results"]
    np.testing.assert_allclose(found["planned"], results["planned"], rtol=1e-5)
    other = [*again, "--seed", "5", "--export", "--out", str(tmp_path / "other")]  # from another start
    assert run(["learn-video", str(placing), *other]) == 0, capsys.readouterr()
    found = json.loads((tmp_path / "other" / "metrics.json").read_text())["results"]
    assert max(found["planned"]) < 0.1
    assert np.abs(read_episode(tmp_path / "other" / "plan.npz", Plan).joints[0] - plan.joints[0]).max() > 1e-3
    assert (tmp_path / "other" / "c" / "Makefile").exists()
    assert run(["learn-video", str(placing), *again, "--robot", "ur5", "--out", str(tmp_path / "ur5")]) == 2
    assert run(["export", "--cost", str(tmp_path / "cost.json"), "--out", str(tmp_path / "never")]) == 2
    assert "kpirl learn-video FILM" in capsys.readouterr().err


def test_a_cost_over_detected_keypoints_survives_the_disk_and_fits_its_dynamics_alone(tmp_path):
    dynamics = load_dynamics(shipped_model("placing"))
    limits = ArmLimits("my_arm.urdf", (-1.0, -np.inf, *[-2.0] * 5), (1.0, np.inf, *[2.0] * 5), 0.25)
    cost = PlanningCost(np.arange(24.0).reshape(3, 8), np.ones(3), CONVERGED, limits)
    path = write_planning_cost(tmp_path / "cost.json", cost, dynamics)
    found = read_planning_cost(path, dynamics)
    np.testing.assert_array_equal(found.weights, cost.weights)
    np.testing.assert_array_equal(found.efforts, cost.efforts)
    assert found.solver == CONVERGED
    assert found.limits == limits
    content = json.loads(path.read_text())
    assert (content["unit"], content["rate"]) == ("half an image", 1.0)
    path.write_text(json.dumps(content | {"joints": 6}))
    with pytest.raises(FileError, match="6 joints; the dynamics have 4 keypoints and 7 joints"):
        read_planning_cost(path, dynamics)
    path.write_text(json.dumps(content | {"limits": content["limits"] | {"lower": [0.0]}}))
    with pytest.raises(FileError, match="limits of 1 joints"):
        read_planning_cost(path, dynamics)
    path.write_text("{}")
    with pytest.raises(FileError, match="not a cost over detected keypoints"):
        read_planning_cost(path, dynamics)


def test_a_plan_begins_where_a_recording_of_the_arm_does(placing, tmp_path, capsys):
    recording = Placing(steps=1).record(np.random.default_rng(3))
    path = tmp_path / "arm.npz"
    np.savez(
        path,
        **{
            "observation.images.camera": recording.images,
            "observation.state": recording.joints,
            "action": recording.actions,
            "timestamp": recording.times,
        },
    )
    words = [*MODELS, "--recording", str(path), "--steps", "10", "--iterations", "3", "--out", str(tmp_path)]
    assert run(["learn-video", str(placing), *words, "--robot", "ur5"]) == 2
    assert "ur5 has 6 joints, the dynamics have 7" in capsys.readouterr().err
    assert run(["learn-video", str(placing), *words]) in (0, 1)
    content = json.loads((tmp_path / "cost.json").read_text())
    assert content["robot"] is content["limits"] is None  # the recording does not name its arm
    plan = read_episode(tmp_path / "plan.npz", Plan)
    assert isinstance(recording, ArmRecording)
    np.testing.assert_allclose(plan.joints[0], recording.joints[0], atol=1e-12)
    np.testing.assert_allclose(np.diff(plan.joints, axis=0), plan.actions, atol=1e-9)
    assert plan.keypoints.shape == (11, 4, 2)
    assert not json.loads((tmp_path / "metrics.json").read_text())["results"]["executed"]  # it has no scene


def test_a_film_in_which_the_detector_does_not_see_its_object_is_refused(tmp_path, capsys):
    frames = np.full((12, 240, 240, 3), 150, np.uint8)
    for index, frame in enumerate(frames):
        frame[100:140, 60 + 8 * index : 100 + 8 * index] = 200, 40, 40
    path = write_video(tmp_path / "other.mp4", frames, 10, codec="h264")
    assert run(["learn-video", str(path), MODELS[0], "--scale", "1", "--out", str(tmp_path)]) == 2
    assert "not seen for sure" in capsys.readouterr().err
    assert (tmp_path / "refused.png").exists()
