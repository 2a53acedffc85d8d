"""Demonstrations: the expert, and their files."""

import json
import platform
import signal
import subprocess
import sys
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from kpirl_ocp.episodes import Episode, atomic_write, read_episode, read_episodes, write_episodes
from kpirl_ocp.errors import EpisodeError, ProblemError
from kpirl_ocp.irl.cases.tasks import as_demonstration, demonstrate
from kpirl_ocp.motion import minimum_jerk
from kpirl_ocp.ocp.models import Robot


@pytest.fixture(scope="module")
def robot():
    return Robot.iiwa()


@pytest.fixture(scope="module")
def episodes(robot):
    return demonstrate(robot, "placing", 2, seed=1)


def test_minimum_jerk_starts_and_ends_at_rest():
    h = 1e-4
    assert minimum_jerk(np.array([0.0, 0.5, 1.0])).tolist() == [0.0, 0.5, 1.0]
    assert minimum_jerk(np.array([h]))[0] < 11 * h**3
    assert 1 - minimum_jerk(np.array([1 - h]))[0] < 11 * h**3


def test_placing_moves_along_x_first_and_then_down(robot):
    for episode in demonstrate(robot, "placing", 4, seed=3):
        moved = episode.keypoints[:, 0] - episode.keypoints[0, 0]  # (T+1, 3)
        halfway = len(moved) // 2
        assert np.abs(moved[:, 1]).max() < 5e-3
        assert np.abs(moved[:halfway, 2]).max() < 5e-3
        assert np.abs(moved[halfway + 1 :, 0] - moved[-1, 0]).max() < 5e-3
        assert 0.11 < moved[-1, 0] < 0.23
        assert -0.23 < moved[-1, 2] < -0.11


def test_reaching_is_a_straight_line_without_turning_the_object(robot):
    for episode in demonstrate(robot, "reaching", 4, seed=3):
        shape = episode.keypoints - episode.keypoints[:, :1]
        assert np.abs(shape - shape[0]).max() < 1e-2
        moved = episode.keypoints[:, 0] - episode.keypoints[0, 0]
        direction = moved[-1] / np.linalg.norm(moved[-1])
        assert np.linalg.norm(moved - np.outer(moved @ direction, direction), axis=1).max() < 1e-2


def test_an_episode_is_consistent_with_the_arm_and_its_limits(robot, episodes):
    lower, upper = robot.joint_limits
    for episode in episodes:
        np.testing.assert_allclose(np.diff(episode.joints, axis=0), episode.actions, atol=1e-9)
        located = [robot.locate(theta) for theta in episode.joints]
        np.testing.assert_array_equal(located, episode.keypoints)
        assert (episode.joints >= lower).all()
        assert (episode.joints <= upper).all()
        np.testing.assert_allclose(np.diff(episode.times), 0.2, rtol=1e-12)


def test_a_seed_repeats_and_another_differs(robot, episodes):
    np.testing.assert_array_equal(demonstrate(robot, "placing", 2, seed=1)[1].joints, episodes[1].joints)
    assert not np.array_equal(demonstrate(robot, "placing", 2, seed=2)[1].joints, episodes[1].joints)


def test_unknown_tasks_and_other_arms_are_refused(robot):
    with pytest.raises(ProblemError, match="reaching"):
        demonstrate(robot, "juggling", 1, seed=0)
    with pytest.raises(ProblemError, match="6 joints"):
        demonstrate(Robot.from_example_data("ur5"), "placing", 1, seed=0)


def test_a_demonstration_starts_where_the_arm_is_and_ends_at_its_goal(robot, episodes):
    demo = as_demonstration(robot, episodes[0], unit=0.01)
    np.testing.assert_allclose(demo.s0[:9], 100 * episodes[0].keypoints[0].ravel(), rtol=1e-14)
    np.testing.assert_array_equal(demo.context, demo.observations[-1])
    assert not demo.s0[-7:].any()


def test_episodes_survive_the_disk_bit_by_bit(tmp_path, episodes):
    write_episodes(tmp_path, episodes, {"task": "placing"})
    again, meta = read_episodes(tmp_path, Episode)
    assert meta["task"] == "placing"
    for old, new in zip(episodes, again, strict=True):
        for field in ("joints", "keypoints", "actions", "times"):
            np.testing.assert_array_equal(getattr(old, field), getattr(new, field))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["episode_000.npz", "episode_001.npz", "meta.json"]


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"actions": np.zeros((3, 7))}, "action"),
        ({"keypoints": np.full((10, 3, 3), np.nan)}, "observation.keypoints"),
        ({"times": np.arange(10)}, "timestamp"),
        ({"joints": np.zeros((10, 6))}, "action"),
    ],
)
def test_a_malformed_episode_is_refused_before_anything_is_written(tmp_path, episodes, change, key):
    target = tmp_path / "data"
    with pytest.raises(EpisodeError, match=key):
        write_episodes(target, [episodes[0], replace(episodes[1], **change)], {})
    assert not target.exists()


def test_reading_names_the_file_and_what_is_wrong(tmp_path, episodes):
    with pytest.raises(EpisodeError, match="kpirl demonstrate"):
        read_episodes(tmp_path, Episode)
    write_episodes(tmp_path, episodes, {})
    (tmp_path / "episode_001.npz").write_bytes(b"PK not really")
    with pytest.raises(EpisodeError, match="episode_001"):
        read_episodes(tmp_path, Episode)
    np.savez(tmp_path / "episode_001.npz", action=np.zeros((9, 7)))
    with pytest.raises(EpisodeError, match=r"observation\.state"):
        read_episodes(tmp_path, Episode)
    (tmp_path / "meta.json").write_text(json.dumps({"version": 99}))
    with pytest.raises(EpisodeError, match="version"):
        read_episodes(tmp_path, Episode)


def test_a_failed_write_leaves_no_file_behind(tmp_path, episodes):
    with pytest.raises(TypeError):
        write_episodes(tmp_path, episodes[:1], {"not json": object()})
    assert [path.name for path in tmp_path.iterdir()] == ["episode_000.npz"]


def test_what_a_killed_process_left_of_a_file_is_removed_and_that_of_living_ones_is_not(tmp_path):
    """A real process that kills itself while it writes; one that lives, the first of all; one of another machine."""
    path = tmp_path / "episode [1].npz"
    dying = f"with atomic_write(Path({str(path)!r})) as file: file.write(b'half'); os.kill(os.getpid(), 9)"
    code = f"import os\nfrom pathlib import Path\nfrom kpirl_ocp.episodes import atomic_write\n{dying}"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) == 1
    elsewhere = tmp_path / f".{path.name}.elsewhere.{2**22 + 1}.part"
    elsewhere.touch()
    living = atomic_write(path)
    living.part = tmp_path / f".{path.name}.{platform.node()}.1.part"
    with living as slow:
        with atomic_write(path) as file:
            file.write(b"whole")
        assert set(tmp_path.iterdir()) == {path, living.part, elsewhere}
        slow.write(b"whole")
    assert path.read_bytes() == b"whole"


@pytest.mark.parametrize("count", [True, -1, 2.0, "2", None])
def test_a_number_of_episodes_that_is_none_is_refused(count, tmp_path, episodes):
    write_episodes(tmp_path, episodes[:1], {})
    meta = json.loads((tmp_path / "meta.json").read_text())
    (tmp_path / "meta.json").write_text(json.dumps(meta | {"episodes": count}))
    with pytest.raises(EpisodeError, match="the number of 'episodes'"):
        read_episodes(tmp_path, Episode)


def test_a_header_that_announces_more_than_is_there_is_refused(tmp_path):
    path = tmp_path / "episode_000.npz"
    with zipfile.ZipFile(path, "w") as archive, archive.open("action.npy", "w") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (10**15,)})
    with pytest.raises(EpisodeError, match="too short"):
        read_episode(path, Episode)
