"""Camera data: what moves in each data set, recordings on disk, and collections that are interrupted."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("cv2")
pytest.importorskip("pybullet")
pytest.importorskip("torch")

from kpirl_ocp.episodes import episode_path, read_episode, read_meta
from kpirl_ocp.errors import EpisodeError, FileError, ProblemError, SceneError
from kpirl_ocp.perception.data.clips import read_recordings, read_videos
from kpirl_ocp.perception.data.collection import collect
from kpirl_ocp.perception.data.motions import MOTIONS, HandPlacing, HandWandering, LastJoint, Placing, Reaching, Sines
from kpirl_ocp.perception.data.recordings import ArmRecording, GroundTruth, Recording, read_hand
from kpirl_ocp.perception.detector.tracks import detect_tracks
from kpirl_ocp.perception.scene.hand import RATE, HandScene, placing_path, wandering_path
from kpirl_ocp.perception.scene.scene import Scene

IN_PLANE, OTHERS = [1, 3, 5], [0, 2, 4, 6]  # joints 2, 4, 6 and the others
SEED = 5


def play(motion, episodes=2):
    return [motion.record(np.random.default_rng([SEED, index])) for index in range(episodes)]


@pytest.fixture(scope="module")
def played():
    """Two episodes of each motion of the robot."""
    motions = {"keypoints": LastJoint(), "sines": Sines(), "placing": Placing(), "reaching": Reaching()}
    return {name: play(motion) for name, motion in motions.items()}


def travel(clip):
    """How far each joint goes (7,) [rad]."""
    return np.ptp(clip.joints, axis=0)


# Motions


def test_only_the_last_joint_moves_in_the_data_of_the_detector(played):
    for clip in played["keypoints"]:
        assert len(clip.images) == LastJoint().frames
        assert travel(clip)[:6].max() < 1e-3
        assert 0.1 < travel(clip)[6] < 2 * LastJoint().swing
        assert np.ptp(clip.place, axis=0).max() < 0.5  # the bottle turns about its middle


def test_joints_2_4_and_6_move_the_most_in_the_sines(played):
    most, least = (np.mean([travel(clip)[joints] for clip in played["sines"]], axis=0) for joints in (IN_PLANE, OTHERS))
    assert most.min() > 2 * least.max()
    assert least.min() > 1e-3  # but all move
    assert most.max() < 2 * Sines().amplitude


def test_placing_goes_to_the_right_and_then_down_in_the_image(played):
    for clip in played["placing"]:
        moved = clip.place - clip.place[0]
        half = len(moved) // 2
        assert moved[half, 0] > 20
        assert moved[half, 0] > 2 * abs(moved[half, 1])
        assert moved[-1, 1] - moved[half, 1] > 20


def test_the_noise_of_placing_is_that_of_its_actions():
    noisy, calm = (play(motion, 1)[0] for motion in (Placing(), Placing(noise=0.0, others=0.0)))
    np.testing.assert_array_equal(noisy.joints[0], calm.joints[0])
    first = noisy.actions[0] - calm.actions[0]
    assert 0 < np.abs(first[IN_PLANE]).max() < 5 * Placing().noise
    assert 0 < np.abs(first[OTHERS]).max() < 5 * Placing().others
    np.testing.assert_allclose(calm.actions[:, OTHERS], 0.0, atol=1e-4)  # [rad], what gravity does between two actions


def test_the_object_of_reaching_moves_along_image_x_only(played):
    for clip in played["reaching"]:
        moved = clip.place - clip.place[0]
        assert moved[-1, 0] > 20
        assert np.diff(moved[:, 0]).min() > -0.5
        assert np.abs(moved[:, 1]).max() < 0.05 * moved[-1, 0]


@pytest.mark.parametrize("name", ["keypoints", "sines", "placing", "reaching"])
def test_a_recording_is_consistent_with_the_camera_and_shows_the_bottle(name, played):
    with Scene() as scene:
        for clip in played[name]:
            steps = len(clip.actions)
            assert clip.images.shape == (steps + 1, 240, 240, 3)
            np.testing.assert_allclose(clip.times, np.arange(steps + 1) / MOTIONS[name]().rate, rtol=1e-14)
            for theta, place, mask in zip(clip.joints, clip.place, clip.bottle, strict=True):
                scene.reset(theta)
                np.testing.assert_allclose(scene.camera.project(scene.link_pose("bottle")[1]), place, rtol=0, atol=1e-6)
                assert mask.sum() > 100
            assert (clip.place > 0).all()
            assert (clip.place < 240).all()
            assert not clip.velocities[0].any()  # at rest
            low, high = scene.joint_limits
            assert (clip.joints >= low).all()
            assert (clip.joints <= high).all()


def test_actions_aim_from_where_the_arm_is_at_where_it_should_be(played):
    for clip in played["keypoints"]:
        aims = (clip.joints[:-1] + clip.actions)[:, :6]
        np.testing.assert_allclose(aims, np.broadcast_to(clip.joints[0, :6], aims.shape), rtol=0, atol=1e-12)


def test_a_motion_that_never_fits_into_the_image_is_refused():
    with pytest.raises(SceneError, match="smaller amplitudes"):
        play(Sines(amplitude=20.0, steps=20), 1)


# A hand


def test_a_hand_is_read_at_5_hz_with_its_truth_frame_by_frame(tmp_path):
    motion, path = HandPlacing(seconds=0.4), tmp_path / "episode_000.npz"
    motion.write(path, np.random.default_rng(3))
    clip = read_hand(path)
    with HandScene() as scene:
        frames = [scene.look(p) for p in placing_path(np.random.default_rng(3), seconds=0.4)[::6]]
    assert len(frames) == 3
    np.testing.assert_array_equal(clip.images, [frame.rgb for frame in frames])
    np.testing.assert_array_equal(clip.bottle, [frame.bottle for frame in frames])
    np.testing.assert_array_equal(clip.place, [frame.place for frame in frames])
    np.testing.assert_allclose(clip.times, [0.0, 0.2, 0.4], rtol=1e-12)


def test_a_wandering_hand_rests_at_a_new_place_every_second_and_stays_in_the_plane():
    path = wandering_path(np.random.default_rng(4), seconds=5.0, tremor=0.0)
    assert path.shape == (151, 3)
    assert not path[:, 1].any()
    rests = path[:: int(RATE)]
    assert np.linalg.norm(np.diff(rests, axis=0), axis=1).min() > 0.02
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) * RATE  # [m/s]
    legs = speed.reshape(5, int(RATE))
    assert (legs[:, [0, -1]].max(axis=1) < 0.02 * legs.max(axis=1)).all()
    distance = np.linalg.norm(np.diff(rests, axis=0), axis=1)
    np.testing.assert_allclose(legs.max(axis=1), 1.875 * distance, rtol=1e-2)  # minimum jerk: 15/8 of the mean speed


def test_every_frame_of_a_wandering_hand_shows_the_bottle(tmp_path):
    HandWandering(seconds=3.0, rate=5).write(tmp_path / "episode_000.npz", np.random.default_rng(5))
    clip = read_hand(tmp_path / "episode_000.npz")
    assert len(clip.images) == 16
    assert clip.bottle.sum(axis=(1, 2)).min() > 400
    assert (clip.place > 0).all()
    assert (clip.place < 240).all()


def test_a_collection_of_a_hand_is_read_as_recordings_or_as_videos(tmp_path):
    collect(tmp_path, HandPlacing(seconds=0.4), 2)
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        *(f"episode_{i:03d}.{suffix}" for i in range(2) for suffix in ("avi", "npz")),
        "meta.json",
    ]
    clips = read_recordings(tmp_path)
    for clip, frames in zip(clips, read_videos([tmp_path]), strict=True):
        np.testing.assert_array_equal(clip.images, frames)
    (single,) = read_videos([tmp_path / "episode_001.avi"])
    np.testing.assert_array_equal(single, clips[1].images)


def test_a_directory_without_videos_is_refused(tmp_path):
    with pytest.raises(FileError, match=f"{tmp_path.name} holds no"):
        read_videos([tmp_path])


# Collections

MOTION = LastJoint(frames=3)


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    return collect(tmp_path_factory.mktemp("data") / "one", MOTION, 3, SEED)


@pytest.fixture
def collection(collected, tmp_path):
    """A copy to spoil."""
    for file in collected.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    return tmp_path


def assert_same(one, two):
    for name in ArmRecording.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_an_episode_depends_on_its_seed_and_index_only(collected):
    for clip, expected in zip(read_recordings(collected), play(MOTION, 3), strict=True):
        np.testing.assert_array_equal(clip.images, expected.images)
    assert_same(read_episode(episode_path(collected, 2), ArmRecording), play(MOTION, 3)[2])
    assert not np.array_equal(*(read_recordings(collected)[i].images for i in (0, 1)))


def test_two_processes_write_the_same_as_one(collected, tmp_path):
    collect(tmp_path, MOTION, 3, SEED, jobs=2)
    for index in range(3):
        assert_same(*(read_episode(episode_path(d, index), ArmRecording) for d in (collected, tmp_path)))
    assert read_meta(tmp_path) == read_meta(collected)


def test_the_meta_data_say_all_that_the_data_depend_on(collected):
    meta = read_meta(collected)
    assert (meta["motion"], meta["seed"], meta["episodes"], meta["fps"]) == ("keypoints", SEED, 3, 5)
    assert meta["settings"]["frames"] == 3
    assert meta["size"] == [240, 240]
    assert np.shape(meta["camera"]["intrinsics"]) == (3, 3)


def test_an_interrupted_collection_goes_on_and_keeps_what_it_has(collection):
    complete = read_episode(episode_path(collection, 1), ArmRecording)
    episode_path(collection, 1).unlink()
    (collection / ".abc.part").write_bytes(b"half an episode")
    before = {index: episode_path(collection, index).stat().st_mtime_ns for index in (0, 2)}
    with pytest.raises(EpisodeError, match=r"episode_001\.npz is missing.*interrupted"):
        read_recordings(collection)
    collect(collection, MOTION, 3, SEED)
    assert {index: episode_path(collection, index).stat().st_mtime_ns for index in (0, 2)} == before
    assert_same(read_episode(episode_path(collection, 1), ArmRecording), complete)


def test_a_collection_can_grow_and_does_not_shrink(collection):
    collect(collection, MOTION, 4, SEED)
    assert len(read_recordings(collection)) == 4
    collect(collection, MOTION, 1, SEED)
    assert len(read_recordings(collection)) == 4
    assert_same(read_episode(episode_path(collection, 3), ArmRecording), play(MOTION, 4)[3])


@pytest.mark.parametrize(
    ("motion", "seed", "message"),
    [
        (MOTION, SEED + 1, "another seed"),
        (LastJoint(frames=4), SEED, "another settings"),
        (LastJoint(frames=3, rate=10), SEED, "another settings, fps"),
        (Reaching(), SEED, "another motion, settings"),
    ],
)
def test_other_settings_in_the_same_directory_are_refused(collection, motion, seed, message):
    before = {file.name: file.read_bytes() for file in collection.iterdir()}
    with pytest.raises(EpisodeError, match=f"{collection.name} holds data with {message}: choose"):
        collect(collection, motion, 5, seed)
    assert {file.name: file.read_bytes() for file in collection.iterdir()} == before


@pytest.mark.parametrize(("count", "jobs"), [(0, 1), (-1, 1), (1, 0)])
def test_no_episode_or_no_process_is_refused_before_anything_is_written(tmp_path, count, jobs):
    with pytest.raises(ProblemError, match="at least one"):
        collect(tmp_path / "data", MOTION, count, jobs=jobs)
    assert not (tmp_path / "data").exists()


def test_a_negative_seed_is_refused(tmp_path):
    with pytest.raises(ProblemError, match="a seed >= 0, got 1, 1 and -1"):
        collect(tmp_path / "data", MOTION, 1, seed=-1)
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    ("motion", "setting", "error"),
    [
        (LastJoint, {"frames": 1}, ProblemError),
        (Sines, {"steps": 0}, ProblemError),
        (Placing, {"noise": -0.1}, ProblemError),
        (Reaching, {"rate": 7}, SceneError),
    ],
)
def test_settings_that_cannot_be_played_are_refused(motion, setting, error):
    with pytest.raises(error, match=next(iter(setting))):
        motion(**setting)


def test_a_truncated_episode_is_named(collection):
    path = episode_path(collection, 1)
    whole = path.read_bytes()
    for length in (1, 4, 1000, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(EpisodeError, match=r"episode_001\.npz cannot be read"):
            read_recordings(collection)


@pytest.mark.parametrize("damage", ["empty", "flipped", "npy"])
def test_a_damaged_episode_is_named(collection, damage):
    path = episode_path(collection, 1)
    if damage == "empty":
        path.write_bytes(b"")
    elif damage == "flipped":
        content = bytearray(path.read_bytes())
        content[80:90] = bytes(byte ^ 0xFF for byte in content[80:90])
        path.write_bytes(content)
    else:
        with path.open("wb") as file:
            np.save(file, np.zeros(3))
    with pytest.raises(EpisodeError, match=r"episode_001\.npz"):
        read_recordings(collection)


def test_an_episode_without_images_is_named_with_what_it_lacks(collection):
    clip = read_episode(episode_path(collection, 0), GroundTruth)
    assert not isinstance(clip, Recording)
    np.savez(episode_path(collection, 0), timestamp=clip.times)
    with pytest.raises(EpisodeError, match=r"episode_000.*masks"):
        read_episode(episode_path(collection, 0), GroundTruth)
    (collection / "meta.json").write_text(json.dumps({"version": 1}))
    with pytest.raises(EpisodeError, match=r"meta\.json must hold"):
        read_recordings(collection)


def test_tracks_are_what_the_detector_sees_with_what_the_encoders_measured(collected):
    def detect(images):
        means = images.mean(axis=(1, 2)) / 255  # (n, 3)
        return means[:, None]

    tracks = detect_tracks(SimpleNamespace(detect=detect), collected)
    for track, clip in zip(tracks, play(MOTION, 3), strict=True):
        np.testing.assert_array_equal(track.keypoints, detect(clip.images))
        for name in ("joints", "velocities", "actions", "times"):
            np.testing.assert_array_equal(getattr(track, name), getattr(clip, name))
