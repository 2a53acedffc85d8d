"""From tracks in an image to an arm that repeats them: the camera in the plan, scales, refusals, files, the command."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

pytest.importorskip("av")
pytest.importorskip("cv2")
pytest.importorskip("pybullet")
pytest.importorskip("torch")
from films import WALL, film, pose, shaken

from kpirl_ocp.assets import iiwa_urdf, shipped_model
from kpirl_ocp.cli.commands import learn_video
from kpirl_ocp.cli.imitation.arm import Scale, arm_for, other_starts
from kpirl_ocp.cli.imitation.checks import check_cost_arm
from kpirl_ocp.cli.imitation.drawing import side_by_side
from kpirl_ocp.cli.imitation.execution import Executed, execute
from kpirl_ocp.cli.main import run
from kpirl_ocp.errors import DemonstrationError, FileError, OptionError, ProblemError, SceneError
from kpirl_ocp.irl.cases.cost_files import ArmSetting, LearnedCost
from kpirl_ocp.irl.visual.camera_learning import (
    camera_demonstration,
    held_points,
    learn_in_image,
    learn_on,
    path_distance,
    plan_from,
)
from kpirl_ocp.irl.visual.reach import check_reach, impossible_motions
from kpirl_ocp.motion import minimum_jerk
from kpirl_ocp.ocp.models.keypoint_costs import KeypointCost, Weighted
from kpirl_ocp.ocp.models.keypoint_problems import keypoint_ocp, keypoint_state
from kpirl_ocp.ocp.models.pinhole import Pinhole
from kpirl_ocp.ocp.models.robot import Keypoint, Robot
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.perception.data.encoding import write_video
from kpirl_ocp.perception.data.video import iterate_frames
from kpirl_ocp.perception.scene.camera import Camera
from kpirl_ocp.perception.scene.scene import Scene
from kpirl_ocp.perception.tracking.tracks import Tracks, read_tracks
from kpirl_ocp.perception.tracking.watch import Film, seen_at_rest
from kpirl_ocp.types import Demonstration, Status

CAMERA = Camera()
PINHOLE = Pinhole(CAMERA.intrinsics, *CAMERA.extrinsics)
THETA = np.array([0.1, 0.6, -0.1, -1.4, 0.2, 1.1, 0.0])
HELD = (Keypoint("lbr_iiwa_link_7", (0.0, 0.0, 0.12)), Keypoint("lbr_iiwa_link_7", (0.1, 0.0, 0.12)))
FIGURE = np.array([[280.0, 180], [320, 180], [300, 150]])  # keypoints in a film [pixels]
SCALE = Scale(0.5, 0.25, None)


def way(steps=6, across=60.0, down=0.0, turn=0.0):
    """Keypoints (T+1, 3, 2) [pixels of the film] that move with a person's speed, and turn."""
    progress = minimum_jerk(np.linspace(0, 1, steps + 1))
    middle = FIGURE.mean(axis=0)
    places = []
    for t in progress:
        rotation = np.array([[np.cos(turn * t), -np.sin(turn * t)], [np.sin(turn * t), np.cos(turn * t)]])
        places.append(middle + (FIGURE - middle) @ rotation.T + t * np.array([across, down]))
    return np.array(places)


@pytest.fixture(scope="module")
def iiwa():
    return arm_for("iiwa", None, way(turn=0.4), SCALE)


@pytest.fixture(scope="module")
def learned(iiwa):
    arm, wanted = iiwa
    demonstration = camera_demonstration(arm.setting, arm.robot, arm.start, wanted)
    return learn_in_image(arm.setting, arm.robot, [demonstration], rate=5.0, iterations=40)


# The camera in the plan


def test_the_symbolic_camera_is_that_of_the_scene():
    points = np.random.default_rng(0).uniform([0.3, -0.3, 0.2], [0.9, 0.3, 0.9], (5, 3))
    symbol = ca.SX.sym("p", 15)
    project = ca.Function("project", [symbol], [PINHOLE.project(symbol)])
    np.testing.assert_allclose(np.array(project(points.ravel())).reshape(5, 2), CAMERA.project(points), atol=1e-10)


def test_the_problem_plans_pixels_of_the_keypoints():
    robot = Robot.iiwa(HELD)
    problem = keypoint_ocp(robot, KeypointCost(Weighted()), 3, unit=120.0, camera=PINHOLE)
    s0 = keypoint_state(robot, THETA, 120.0, PINHOLE)
    np.testing.assert_allclose(120 * s0[:4].reshape(2, 2), CAMERA.project(robot.locate(THETA)), atol=1e-10)
    actions = np.random.default_rng(1).normal(0, 0.05, (3, 7))
    moved = problem.simulate(s0, actions, np.ones(4)).states[-1]
    seen = CAMERA.project(robot.locate(THETA + actions.sum(axis=0)))
    np.testing.assert_allclose(120 * moved[:4].reshape(2, 2), seen, atol=1e-9)
    assert problem.n_context == 4


@pytest.mark.parametrize("change", [{"rotation": np.eye(2)}, {"translation": [0, np.nan, 0]}])
def test_a_camera_of_the_wrong_kind_is_refused(change):
    with pytest.raises(ProblemError, match=next(iter(change))):
        replace(PINHOLE, **change)


def test_held_points_appear_where_they_are_asked_to():
    offsets = np.array([[10.0, 0], [-5, 20], [0, 0]])
    with Scene() as scene:
        scene.reset(THETA)
        rotation, position = scene.link_pose("bottle")
    points = held_points(PINHOLE, rotation, position, offsets) @ rotation.T + position
    np.testing.assert_allclose(CAMERA.project(points) - CAMERA.project(position), offsets, atol=1e-9)


# Scales


def test_the_scale_follows_from_the_length_of_the_object():
    assert Scale(0.7, 0.25, 100).at(300, 1.5) == 0.7
    assert Scale(None, 0.25, 100).at(300, 1.5) == pytest.approx(300 / 1.5 * 0.25 / 100)
    with pytest.raises(DemonstrationError, match="--scale"):
        Scale(None, 0.25, None).at(300, 1.5)


def test_the_arms_keypoints_make_the_figure_of_the_film(iiwa):
    arm, wanted = iiwa
    start = arm.setting.unit * arm.setting.state(arm.robot, arm.start)[:6].reshape(3, 2)
    np.testing.assert_allclose(start - start.mean(axis=0), 0.5 * (FIGURE - FIGURE.mean(axis=0)), atol=1e-3)
    np.testing.assert_allclose(wanted, 0.5 * (way(turn=0.4) - way()[0]), atol=1e-12)


def test_a_path_that_leaves_the_image_is_refused_with_what_to_do():
    with pytest.raises(DemonstrationError, match="smaller scale"):
        arm_for("iiwa", None, way(across=500.0), SCALE)


def test_a_path_that_hardly_moves_the_arm_is_refused_with_a_scale_that_does():
    with pytest.raises(DemonstrationError, match="choose a larger one") as refused:
        arm_for("iiwa", None, way(), Scale(0.01, None, None))
    larger = float(re.search(r"as --scale (\S+), or", str(refused.value))[1])
    assert arm_for("iiwa", None, way(), Scale(larger, None, None))[0].scale == larger


@pytest.mark.parametrize("name", ["iiwa", "ur5"])
def test_an_object_of_unknown_length_is_taken_to_be_so_short_that_its_path_fits(name):
    places = way(across=700.0)
    arm, wanted = arm_for(name, None, places, Scale(None, None, 200.0))
    assert arm.smaller
    np.testing.assert_allclose(wanted, arm.scale * (places - places[0]), atol=1e-9)
    with pytest.raises(DemonstrationError, match=f"as --scale {arm.scale:.2g}, or a smaller --object-size"):
        arm_for(name, None, places, Scale(None, 0.25, 200.0))
    assert not arm_for(name, None, way(), Scale(None, None, 200.0))[0].smaller


@pytest.mark.parametrize("name", ["iiwa", "ur5"])
@pytest.mark.parametrize("path", [way(across=700.0), way(across=-150.0, down=-600.0, turn=0.5)])
def test_the_scale_that_the_refusal_names_fits(name, path):
    with pytest.raises(DemonstrationError, match="leaves its image") as refused:
        arm_for(name, None, path, Scale(0.9, 0.25, None))
    smaller = float(re.search(r"as --scale (\S+), or", str(refused.value))[1])
    assert 0.1 < smaller < 0.9
    arm_for(name, None, path, Scale(smaller, 0.25, None))


def test_a_path_that_the_arm_cannot_follow_is_refused(iiwa):
    arm, _ = iiwa
    too_far = 0.5 * (way(across=700.0) - way()[0])
    demonstration = camera_demonstration(arm.setting, arm.robot, arm.start, too_far)
    with pytest.raises(DemonstrationError, match="cannot follow"):
        check_reach(arm.setting, arm.robot, demonstration)


def planar_arm(path, axis):
    """A URDF of three joints with parallel axes, 0.3 m apart."""
    links = "".join(f'<link name="l{i}"/>' for i in range(5))
    kinds, places = 3 * ["revolute"] + ["fixed"], ["0 0 0.3"] + 3 * ["0.3 0 0"]
    joints = "".join(
        f'<joint name="j{i}" type="{kind}"><parent link="l{i}"/><child link="l{i + 1}"/><origin xyz="{place}"/>'
        f'<axis xyz="{axis}"/><limit lower="-2.8" upper="2.8" effort="100" velocity="3"/></joint>'
        for i, (kind, place) in enumerate(zip(kinds, places, strict=True))
    )
    path.write_text(f'<robot name="arm">{links}{joints}</robot>')
    return str(path)


@pytest.fixture
def planar(tmp_path):
    """For an axis of the joints: an arm, and a path sideways, upwards and in a turn; the camera looks along y."""

    def build(axis):
        places = way(across=20.0, down=-20.0, turn=0.4)
        return arm_for(planar_arm(tmp_path / "arm.urdf", axis), None, places, Scale(0.3, 0.25, None))

    return build


@pytest.mark.parametrize(
    ("axis", "theta", "missing"),
    [
        ("0 1 0", [0.6, -1.4, 0.8], []),  # bent, in the plane of the image
        ("0 1 0", [0.0, 0.0, 0.0], ["sideways", "in a turn"]),  # stretched: a turn comes with a motion sideways
        ("0 0 1", [0.4, -0.4, 0.4], ["up or down", "in a turn"]),  # in a horizontal plane
    ],
)
def test_a_planar_arm_hardly_moves_across_its_plane_nor_along_itself_when_stretched(planar, axis, theta, missing):
    arm, wanted = planar(axis)
    observations = camera_demonstration(arm.setting, arm.robot, np.array(theta), wanted).observations
    assert impossible_motions(arm.setting, arm.robot, np.array(theta), observations) == missing
    still = np.repeat(observations[:1], 2, axis=0)
    assert impossible_motions(arm.setting, arm.robot, np.array(theta), still) == []  # a path that shows none of them


def test_a_path_across_the_plane_of_a_planar_arm_is_refused_with_that_reason(planar):
    arm, wanted = planar("0 0 1")
    demonstration = camera_demonstration(arm.setting, arm.robot, arm.start, wanted)
    with pytest.raises(DemonstrationError, match=r"moves up or down and in a turn .* 3 joints .*--robot"):
        check_reach(arm.setting, arm.robot, demonstration)


def test_another_number_of_keypoints_is_refused(iiwa):
    arm, wanted = iiwa
    with pytest.raises(ProblemError, match="3 keypoints, the demonstration 2"):
        camera_demonstration(arm.setting, arm.robot, arm.start, wanted[:, :2])


# Learning and doing


def test_the_path_distance_is_relative_to_the_extent_of_the_path():
    demonstrated = np.zeros((3, 2))
    demonstrated[:, 0] = [0, 1, 2]
    assert path_distance(demonstrated, demonstrated) == 0
    assert path_distance(demonstrated + np.array([0, 0.5]), demonstrated) == pytest.approx(0.25)


def test_a_cost_is_learned_whose_executed_plan_follows_the_demonstration(iiwa, learned):
    arm, wanted = iiwa
    assert learned.history.loss < 0.05 * learned.history.losses[0]
    for start in other_starts(arm, 2, seed=0):
        done = execute(arm, learned.cost, wanted, start)
        assert done.reached < 0.1
        assert abs(done.reached - done.planned) < 0.01
        assert done.images.shape == (7, 240, 240, 3)
        between = (len(done.postures) - 1) // 6  # postures a step, for a film at ten hertz or more
        assert 10 <= done.film_rate == between * done.rate <= 30
        np.testing.assert_allclose(arm.keypoints(done.postures[::between]), done.keypoints)
        *_, last = arm.images(done.postures)
        np.testing.assert_array_equal(last, done.images[-1])


def test_a_cost_is_learned_from_all_the_starts_that_it_is_given(iiwa):
    arm, wanted = iiwa
    starts = other_starts(arm, 3, seed=(0, 1))
    demonstrations = [camera_demonstration(arm.setting, arm.robot, start, wanted) for start in starts]
    first, *others = (
        learn_in_image(arm.setting, arm.robot, [one], rate=5.0, iterations=1).history.losses[0]
        for one in demonstrations
    )
    together = learn_in_image(arm.setting, arm.robot, demonstrations, rate=5.0, iterations=30)
    assert together.history.losses[0] == pytest.approx(np.mean([first, *others]))
    assert together.cost.start == pytest.approx(arm.start)
    reached = [execute(arm, together.cost, wanted, start).planned for start in other_starts(arm, 4, seed=0)]
    assert max(reached) < 0.1


def test_a_cost_is_learned_for_the_plans_that_it_gives_from_a_cold_start():
    u, psi = ca.SX.sym("u"), ca.SX.sym("psi")
    s = ca.SX.sym("s")
    two_valleys = OCP.from_expressions(
        state=s, action=u, parameters=psi, horizon=1, dynamics=s + u, stage_cost=(u**2 - 1) ** 2 + 0.3 * psi * u
    )
    demonstration = Demonstration([0.0], [], [[0.0], [0.9]])  # best at psi = 2.28, if the plan stays in its valley
    result = learn_on(two_valleys, [demonstration], np.array([-0.5]), 30)
    plan = Riccati(tolerance=1e-9).solve(two_valleys, [0.0], result.psi)
    assert result.losses[0] > result.loss == pytest.approx((plan.states[-1, 0] - 0.9) ** 2)
    assert plan.states[-1, 0] > 0
    np.testing.assert_array_equal(result.solutions[0].states, plan.states)


def test_a_learned_cost_says_all_that_planning_with_it_needs(tmp_path, iiwa, learned):
    arm, _ = iiwa
    learned.cost.write(tmp_path / "cost.json")
    content = json.loads((tmp_path / "cost.json").read_text())
    assert content["arm"]["robot"] == "iiwa"
    assert [entry["link"] for entry in content["arm"]["keypoints"]] == ["lbr_iiwa_link_7"] * 3
    assert content["arm"]["unit"] == 120
    assert content["arm"]["max_displacement"] == 0.3
    again = LearnedCost.read(tmp_path / "cost.json")
    np.testing.assert_array_equal(again.goals, learned.cost.goals)
    robot = again.setting.build()
    for start in (again.start, again.start + 0.05):
        one, other = plan_from(learned.cost, arm.robot, start), plan_from(again, robot, start)
        np.testing.assert_allclose(other.states, one.states, atol=1e-9)


@pytest.mark.parametrize("change", [{"objective": 1e3}, {"status": Status.STALLED}], ids=["dear", "stalled"])
def test_a_plan_is_the_cheaper_one_of_those_from_rest_and_from_the_learned_start(iiwa, learned, monkeypatch, change):
    arm, _ = iiwa
    start = arm.start + 0.05
    s0, plan, solve = arm.setting.state(arm.robot, start), plan_from(learned.cost, arm.robot, start), Riccati.solve

    def leaps_from_rest(solver, problem, s, *numbers):
        solution = solve(solver, problem, s, *numbers)
        at_rest = len(numbers) == 2 and np.array_equal(s, s0)
        return replace(solution, **change) if at_rest else solution

    monkeypatch.setattr(Riccati, "solve", leaps_from_rest)
    again = plan_from(learned.cost, arm.robot, start)
    assert again.status.ok
    assert again.objective == pytest.approx(plan.objective, rel=1e-8)


def test_costs_written_before_they_named_their_arm_are_read(tmp_path):
    path = tmp_path / "cost.json"
    content = {"basis": {"kind": "weighted"}, "effort": 1.0, "learn_effort": False, "positivity": "softplus"}
    content |= {"psi": [1.0] * 9, "horizon": 5, "solver": {"kind": "ipopt"}}
    path.write_text(json.dumps(content))
    assert LearnedCost.read(path).setting.robot == ArmSetting().robot == "iiwa"
    assert LearnedCost.read(path).goals is None
    for wrong in ([[0.0] * 9] * 4, [0.0] * 5, [[np.nan]] * 5):
        path.write_text(json.dumps(content | {"goals": wrong}))
        with pytest.raises(FileError, match="goals must be 5 rows of finite numbers"):
            LearnedCost.read(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": np.zeros(6)}, "is for an arm of 6 joints; this one has 7"),
        ({"setting": ArmSetting(keypoints=HELD)}, "is for 2 keypoints; those of this film are 3"),
        (
            {"setting": ArmSetting(keypoints=(Keypoint("lbr_iiwa_link_6", (0, 0, 0)),) * 3)},
            "is for a bottle on the link 'lbr_iiwa_link_6', not 'lbr_iiwa_link_7'; give --flange lbr_iiwa_link_6",
        ),
    ],
)
def test_a_cost_for_another_arm_of_the_name_is_refused(change, message, iiwa, learned):
    arm, _ = iiwa
    check_cost_arm("cost.json", learned.cost, arm.setting.keypoints, arm.robot.n_joints)
    with pytest.raises(OptionError, match=message):
        check_cost_arm("cost.json", replace(learned.cost, **change), arm.setting.keypoints, arm.robot.n_joints)


# Other arms


def test_the_scene_takes_an_arm_from_a_urdf(tmp_path):
    shape = '<visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual>'
    links = "".join(f'<link name="l{i}">{shape}</link>' for i in range(4))
    joints = "".join(
        f'<joint name="j{i}" type="revolute"><parent link="l{i}"/><child link="l{i + 1}"/><origin xyz="0.3 0 0"/>'
        '<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="100" velocity="2"/></joint>'
        for i in range(3)
    )
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(f'<robot name="arm">{links}{joints}</robot>')
    places = way(across=30.0)
    arm, wanted = arm_for(str(urdf), "l3", places, Scale(0.3, 0.25, None))
    assert arm.robot.n_joints == 3
    with arm.scene() as scene:
        scene.reset(arm.start)
        seen = scene.render()
    assert seen.bottle.sum() > 200
    np.testing.assert_allclose(seen.place, 120, atol=1e-6)  # the camera looks at the bottle
    assert camera_demonstration(arm.setting, arm.robot, arm.start, wanted).observations.shape == (7, 6)


def test_a_missing_mesh_or_link_is_named(tmp_path):
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(
        '<robot name="a"><link name="l0"><visual><geometry><mesh filename="package://p/x.stl"/></geometry></visual>'
        "</link></robot>"
    )
    with pytest.raises(SceneError, match=r"package://p/x.stl"), Scene(arm=urdf, flange="l0"):
        pass
    with pytest.raises(SceneError, match="no link 'hand'"), Scene(arm=urdf, flange="hand"):
        pass


# The command


@pytest.fixture(scope="module")
def moving_film(tmp_path_factory):
    poses = [pose(80 + 100 * t, 100 - 30 * t, 0.3 * t) for t in minimum_jerk(np.linspace(0, 1, 40))]
    frames = [image for _, image in film(poses)]
    return write_video(tmp_path_factory.mktemp("film") / "mine.mp4", frames, 30, codec="h264")


def test_one_command_leads_from_a_film_to_a_robot_that_does_it(tmp_path, moving_film, capsys):
    words = ["learn-video", str(moving_film), "--box", "54,74,106,126", "--scale", "0.4", "--steps", "5"]
    words += ["--iterations", "25", "--starts", "1", "--out", str(tmp_path)]
    assert run(words) == 0, capsys.readouterr()
    written = {path.name for path in tmp_path.iterdir()}
    assert {"tracks.npz", "tracks.png", "tracks.mp4", "cost.json", "paths.png"} <= written
    assert {"imitation.mp4", "imitation.png", "object.png"} <= written
    tracks = str(tmp_path / "tracks.npz")
    again = ["learn-video", str(moving_film), "--tracks", tracks, "--scale", "0.4", "--steps", "5", "--starts", "2"]
    assert run([*again, "--cost", str(tmp_path / "cost.json"), "--out", str(tmp_path / "again")]) == 0
    assert not (tmp_path / "again" / "cost.json").exists()


def test_an_execution_that_stays_far_from_the_film_says_whether_the_arm_or_the_cost_is_why(
    tmp_path, moving_film, capsys
):
    words = ["learn-video", str(moving_film), "--scale", "0.4", "--steps", "5", "--starts", "1", "--out", str(tmp_path)]
    assert run([*words, "--box", "54,74,106,126", "--iterations", "1"]) == 1
    said = capsys.readouterr().out
    assert re.search(r"start 1: the arm could follow the path to within \d\.\d% of the way, .* learn longer", said)
    cost = ["--tracks", str(tmp_path / "tracks.npz"), "--cost", str(tmp_path / "cost.json")]
    assert run([*words, *cost]) == 1
    said = capsys.readouterr().out
    assert re.search(r"start 1: the arm could follow the path .* learn from this one, without --cost", said)
    assert "--iterations" not in said


def test_a_film_in_which_nothing_was_marked_is_refused_with_a_picture_of_what_was_taken_for_the_object(
    tmp_path, capsys
):
    frames = [image for _, image in film([pose(80 + 6 * i, 100) for i in range(30)])]
    frames[12:26] = 14 * [WALL]  # the object vanishes
    path = write_video(tmp_path / "mine.mp4", frames, 30, codec="h264")
    assert run(["learn-video", str(path), "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert re.search(r"not seen for sure .*--box X0,Y0,X1,Y1 or --points X,Y.*--end 0\.36 takes that part", said)
    assert (tmp_path / "object.png").exists()


def test_three_joints_begin_bent_enough_to_move_the_bottle_along_themselves(tmp_path):
    for path in (way(across=20.0, down=-20.0, turn=0.4), way(across=0.0, down=60.0)):
        arm, wanted = arm_for(planar_arm(tmp_path / "arm.urdf", "0 1 0"), None, path, Scale(0.6, 0.25, None))
        assert (
            check_reach(arm.setting, arm.robot, camera_demonstration(arm.setting, arm.robot, arm.start, wanted)) < 0.02
        )


def test_a_film_that_shows_no_motion_is_refused_with_a_picture(tmp_path, capsys):
    frames = [image for _, image in film([pose(80 + 0.05 * i, 100) for i in range(20)])]
    path = write_video(tmp_path / "still.mp4", frames, 30, codec="h264")
    words = ["learn-video", str(path), "--box", "54,74,106,126", "--out", str(tmp_path)]
    assert run(words) == 2
    assert re.search(r"hardly move.*What was marked is outlined in .*object\.png", capsys.readouterr().err)
    assert (tmp_path / "refused.png").exists()


@pytest.mark.parametrize(("count", "said"), [(1, "has 1 frame from"), (3, "has 3 frames from 0 s to its end")])
def test_a_film_of_a_few_frames_is_refused_for_that(tmp_path, count, said, capsys):
    frames = [image for _, image in film([pose(80 + 10 * i, 100) for i in range(count)])]
    path = write_video(tmp_path / "short.mp4", frames, 30, codec="h264")
    assert run(["learn-video", str(path), "--out", str(tmp_path)]) == 2
    assert said in capsys.readouterr().err


def test_a_part_of_a_film_without_frames_is_named(tmp_path, moving_film, capsys):
    assert run(["learn-video", str(moving_film), "--start", "0.5", "--end", "0.55", "--out", str(tmp_path)]) == 2
    assert "has 2 frames from 0.5 s to 0.55 s" in capsys.readouterr().err


def test_a_refusal_tells_the_times_that_start_and_end_mean(tmp_path, moving_film, capsys):
    times = np.arange(40) / 30
    places = np.full((40, 2, 2), 60.0) + np.where(times < 0.99, 0.0, 50.0)[:, None, None]
    np.savez(tmp_path / "jump.npz", tracks=places, times=times)
    words = ["learn-video", str(moving_film), "--tracks", str(tmp_path / "jump.npz"), "--scale", "1"]
    assert run([*words, "--start", "0.4", "--out", str(tmp_path)]) == 2
    assert "jump at 1.00 s" in capsys.readouterr().err


def test_a_detector_that_does_not_know_the_object_is_refused_with_what_to_do(tmp_path, moving_film, capsys):
    words = ["learn-video", str(moving_film), "--detector", str(shipped_model("detector")), "--scale", "1"]
    assert run([*words, "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert re.search(r"not seen for sure from 0\.00 to 1\.30 s .*to follow something else, leave --detector out", said)


def test_the_person_and_the_arm_are_shown_at_the_same_share_of_the_way(tmp_path, moving_film):
    """The film is 1.3 s long, and the arm passes four postures: frames 0, 13, 26 and 39, with the arm's four images."""
    tracks = Tracks(np.arange(40) / 30, np.zeros((40, 1, 2)), np.ones((40, 1)), (320, 180))
    images = np.arange(4, dtype=np.uint8)[:, None, None, None] * 60 + np.zeros((4, 90, 90, 3), np.uint8)
    arm = SimpleNamespace(keypoints=lambda postures: np.zeros((4, 1, 2)), images=lambda postures: images)
    run = Executed(np.zeros((4, 1, 2)), np.zeros((4, 1, 2)), 0.0, 0.0, 2, images, np.zeros((4, 7)))
    found = list(iterate_frames(side_by_side(tmp_path / "pair.mp4", Film(moving_film), tracks, arm, run)))
    frames = [image for _, image in iterate_frames(moving_film)]
    np.testing.assert_allclose([time for time, _ in found], [0, 0.5, 1, 1.5])
    for step, (_, pair) in enumerate(found):
        assert pair.shape == (180, 320 + 180, 3)
        assert abs(pair[90:, 330:].mean() - 60 * step) < 3
        apart = [np.abs(pair[20:, 20:320].astype(int) - frame[20:, 20:]).mean() for frame in frames]
        assert np.argmin(apart) == 13 * step


def test_a_still_film_in_which_nothing_is_marked_is_refused_with_what_to_do(tmp_path, capsys):
    path = write_video(tmp_path / "still.mp4", [film([pose(80, 100)])[0][1]] * 20, 30, codec="h264")
    assert run(["learn-video", str(path), "--out", str(tmp_path)]) == 2
    assert "say what to follow" in capsys.readouterr().err


def test_the_film_of_a_shaking_phone_leads_to_a_robot_as_one_from_a_fixed_place_does(tmp_path, capsys):
    poses = [pose(80 + 100 * t, 100 - 30 * t, 0.3 * t) for t in minimum_jerk(np.linspace(0, 1, 40))]
    frames = [image for _, image in shaken(poses, jitter=10, drift=(15, 5))[0]]
    path = write_video(tmp_path / "phone.mp4", frames, 30, codec="h264")
    words = ["learn-video", str(path), "--scale", "0.4", "--steps", "5", "--iterations", "25", "--starts", "1"]
    assert run([*words, "--out", str(tmp_path)]) == 0, capsys.readouterr()
    assert "camera:  moves its picture by up to" in capsys.readouterr().out
    tracks = seen_at_rest(Film(path).steadied(), read_tracks(tmp_path / "tracks.npz"))
    way = tracks.centre[-1] - tracks.centre[0]
    np.testing.assert_allclose(way, [100, -30], atol=2)


def test_tracks_that_were_written_are_those_of_the_film_and_its_part_when_they_are_read_again(tmp_path, monkeypatch):
    poses = [pose(80 + 100 * t, 100 - 30 * t, 0.3 * t) for t in minimum_jerk(np.linspace(0, 1, 50))]
    frames = [image for _, image in shaken(poses, jitter=10, drift=(15, 5))[0]]
    path = write_video(tmp_path / "phone.mp4", frames, 30, codec="h264")
    admitted = []
    monkeypatch.setattr(
        learn_video, "_imitate", lambda args, film, tracks, length: admitted.append((film, tracks)) or 0
    )
    part = ["learn-video", str(path), "--start", "0.5", "--end", "1.4"]
    assert run([*part, "--box", "60,65,112,117", "--out", str(tmp_path)]) == 0
    for words in (part, part[:2]):
        assert (
            run([*words, "--tracks", str(tmp_path / "tracks.npz"), "--scale", "1", "--out", str(tmp_path / "again")])
            == 0
        )
    (film, tracks), *again = admitted
    assert film.camera is not None
    for other, read in again:
        assert other.start == pytest.approx(film.start, abs=1e-9)
        np.testing.assert_allclose(read.times, tracks.times, atol=1e-9)
        np.testing.assert_allclose(read.positions, tracks.positions, atol=1e-6)


def test_the_command_learns_plans_executes_and_exports_for_an_arm_from_a_urdf(tmp_path, moving_film, capsys):
    urdf = str(iiwa_urdf())  # as a file of one's own: another posture and camera than those of `--robot iiwa`
    words = ["learn-video", str(moving_film), "--robot", urdf, "--scale", "0.3", "--steps", "5", "--starts", "1"]
    watched = ["--box", "54,74,106,126", "--out", str(tmp_path / "mine")]
    assert run([*words, *watched, "--export"]) == 0, capsys.readouterr()
    learned = LearnedCost.read(tmp_path / "mine" / "cost.json")
    assert learned.setting.robot == urdf
    assert learned.setting.build().n_joints == 7
    assert learned.setting.camera is not None
    assert (tmp_path / "mine" / "c" / "CMakeLists.txt").exists()
    cost = ["--tracks", str(tmp_path / "mine" / "tracks.npz"), "--cost", str(tmp_path / "mine" / "cost.json")]
    assert run([*words, *cost, "--out", str(tmp_path / "again")]) == 0, capsys.readouterr()
    other = ["learn-video", str(moving_film), "--scale", "0.3", "--steps", "5", *cost, "--out", str(tmp_path / "iiwa")]
    assert run(other) == 2
    assert f"is for the robot '{urdf}', not 'iiwa'" in capsys.readouterr().err


def test_an_arm_that_does_not_exist_is_named(tmp_path, moving_film, capsys):
    words = ["learn-video", str(moving_film), "--box", "54,74,106,126", "--scale", "0.4", "--out", str(tmp_path)]
    for name in ("no_such_arm", "missing.urdf"):
        assert run([*words, "--robot", name]) == 2
        assert name in capsys.readouterr().err
