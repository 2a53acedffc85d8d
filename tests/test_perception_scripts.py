"""The scripts of the perception, end to end with tiny numbers, as a user runs them."""

import json
import os
import runpy
import signal
import subprocess
import sys
import time
from contextlib import redirect_stderr
from io import StringIO
from pathlib import Path

import pytest

pytest.importorskip("cv2")
pytest.importorskip("pybullet")
pytest.importorskip("torch")
from safetensors.numpy import load_file

from kpirl_ocp.cli.main import run
from kpirl_ocp.perception.data.clips import read_recordings
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.dynamics.model import DynamicsModel

ROOT = Path(__file__).parents[1]


def command(script, *arguments):
    return [sys.executable, str(ROOT / "scripts" / script), *map(str, arguments)]


def call(script, *arguments):
    return subprocess.run(command(script, *arguments), capture_output=True, text=True, timeout=300, check=False)


def here(script, *arguments):
    """Exit code and lines on stderr of a script in this process, which has imported torch already."""
    with pytest.MonkeyPatch.context() as patch, redirect_stderr(StringIO()) as said:
        patch.setattr(sys, "argv", command(script, *arguments)[1:])
        with pytest.raises(SystemExit) as left:
            runpy.run_path(sys.argv[0], run_name="__main__")
    return left.value.code, said.getvalue().splitlines()


def succeed(script, *arguments):
    result = call(script, *arguments)
    assert result.returncode == 0, result.stderr
    return result.stdout


def assert_is_figure(path):
    assert path.read_bytes().startswith(b"\x89PNG")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Clips for the detector, clips of a hand, and trajectories for the dynamics."""
    base = tmp_path_factory.mktemp("data")
    for motion, *arguments in (
        ("keypoints", "--episodes", 2, "--frames", 6),
        ("hand-wandering", "--episodes", 1, "--seconds", 1.0),
        ("sines", "--episodes", 3, "--steps", 6),
    ):
        out = succeed("collect_data.py", motion, *arguments, "--jobs", 1, "--out", base / motion)
        assert f"episodes: {base / motion}" in out
    return base


@pytest.fixture(scope="module")
def trained(data):
    """A detector and a dynamics model, with what the scripts printed."""
    detector, dynamics = data / "detector", data / "dynamics"
    tiny = ["--preset", "tiny", "--steps", 3, "--threads", 1]
    clips = ["--data", data / "keypoints", "--videos", data / "hand-wandering", "--test", data / "keypoints"]
    result = call("train_keypoints.py", *clips, *tiny, "--out", detector)
    assert result.returncode == 2
    assert "the detector is not good" in result.stderr  # after three steps
    printed = result.stdout
    model = ["--detector", detector / "rejected.json", "--epochs", 2, "--ahead", 3]
    tracks = ["--data", data / "sines", "--test", data / "sines"]
    return {"detector": printed, "dynamics": succeed("train_dynamics.py", *model, *tracks, "--out", dynamics)}


def metrics(directory):
    def refuse(constant):
        raise AssertionError(f"{constant} in {directory}")

    found = json.loads((directory / "metrics.json").read_text(), parse_constant=refuse)
    assert set(found) == {"settings", "versions", "results"}
    return found["results"]


def test_collected_data_are_read_back(data):
    assert [len(clip.images) for clip in read_recordings(data / "keypoints")] == [6, 6]
    assert [len(clip.images) for clip in read_recordings(data / "hand-wandering")] == [6]
    assert json.loads((data / "sines" / "meta.json").read_text())["settings"]["steps"] == 6


def test_training_keypoints_writes_a_detector_its_scores_and_pictures_and_says_that_it_is_not_good(data, trained):
    out = data / "detector"
    assert not (out / "detector.json").exists()
    detector = KeypointDetector.load(out / "rejected.json")
    keypoints = detector.detect(read_recordings(data / "keypoints")[0].images)
    assert keypoints.shape == (6, detector.model.head.out_channels, 3)
    found = metrics(out)
    assert found["steps"] == 3
    assert len(found["scores"]["keypoints"]["error"]) == keypoints.shape[1]
    for figure in ("contact_sheet.png", "curves.png"):
        assert_is_figure(out / figure)
        assert figure in trained["detector"]
    assert (out / "tracks_keypoints.mp4").stat().st_size > 0
    assert "rejected.json" in trained["detector"]


def test_a_robust_detector_is_trained_scored_and_judged_by_one_command(data, trained):
    teacher, out = data / "detector" / "rejected.json", data / "robust"
    tiny = ["--clips", "0.005", "--steps", "2", "--batch", "4", "--threads", "1"]  # one clip of each motion
    words = ["--teacher", teacher, *tiny, "--test", data / "keypoints", "--out", out]
    assert run(["train-robust", *map(str, words)]) == 2  # two steps are too few
    card = json.loads((out / "rejected.json").read_text())
    assert card["training"]["steps"] == 2
    assert set(card["metrics"]) == {"keypoints"}
    assert card["confidence"]["centre"] == card["architecture"]["keypoints"] * [0.0]
    assert metrics(out)["steps"] == 2
    assert_is_figure(out / "curves.png")


def test_training_again_goes_on_where_it_was(data, trained):
    out = data / "detector"
    before = load_file(out / "rejected.safetensors")
    clips = ["--data", data / "keypoints", "--videos", data / "hand-wandering"]
    here("train_keypoints.py", *clips, "--preset", "tiny", "--steps", 3, "--threads", 1, "--out", out)
    after = load_file(out / "rejected.safetensors")
    assert all((after[name] == value).all() for name, value in before.items())


def test_training_dynamics_writes_a_model_and_its_scores_beside_persistence(data, trained):
    out = data / "dynamics"
    model, detector = DynamicsModel.load(out / "dynamics.json"), KeypointDetector.load(data / "detector/rejected.json")
    assert model.sizes == {
        "keypoints": 2 * detector.model.head.out_channels,
        "joints": 7,
        "velocities": 7,
        "actions": 7,
    }
    scores = metrics(out)["scores"]["sines"]
    for name in ("model", "persistence"):
        assert [len(row) for row in scores[name]] == 3 * [model.sizes["keypoints"]]
    card = json.loads((out / "dynamics.json").read_text())
    assert card["rate"] == pytest.approx(5.0)
    assert card["training"]["trajectories"] == 3
    assert_is_figure(out / "dynamics.png")
    assert "nothing moves" in trained["dynamics"]


def test_a_collection_that_was_killed_goes_on(tmp_path):
    arguments = ("collect_data.py", "keypoints", "--episodes", 12, "--frames", 2, "--jobs", 2, "--out", tmp_path)
    process = subprocess.Popen(
        command(*arguments), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob("episode_*.npz")) and time.monotonic() < deadline:
        time.sleep(0.005)
    os.killpg(process.pid, signal.SIGKILL)  # the workers as well
    process.wait()
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("episode_*.npz")}
    assert kept
    succeed(*arguments)
    assert len(read_recordings(tmp_path)) == 12
    assert {path: path.stat().st_mtime_ns for path in kept} == kept


WRONG = {
    "other settings": (["collect_data.py", "sines", "--episodes", 3, "--out", "{data}/keypoints"], "choose another"),
    "negative seed": (
        ["collect_data.py", "sines", "--episodes", 1, "--seed", -1],
        "--seed: expected a whole number of at least 0",
    ),
    "no data": (["train_keypoints.py", "--data", "{data}"], "meta.json does not exist"),
    "no detector": (
        ["train_dynamics.py", "--detector", "{data}/dynamics/dynamics.json", "--data", "{data}", "--test", "{data}"],
        "dynamics.json: 'kind' must be 'kpirl_ocp.detector'",
    ),
}


KEYPOINTS = "train-keypoints --data {data}/keypoints --preset tiny"
ROBUST = "train-robust --teacher {data}/detector/rejected.json"
DYNAMICS = "train-dynamics --detector {data}/detector/rejected.json --data {data}/sines"
EARLY = {  # words, beginning of the sentence
    f"{KEYPOINTS} --test {{data}}": "--test: {data}/meta.json does not exist",
    f"{KEYPOINTS} --test {{data}}/keypoints {{data}}/keypoints": "--test: takes directories of different names, got",
    f"{KEYPOINTS} --test {{data}}/hand-wandering": "--test: {data}/hand-wandering must hold two clips",
    f"{KEYPOINTS} --start {__file__}": f"--start: {__file__}",
    f"{KEYPOINTS} --videos {{data}}/detector/nothing": "--videos: there is no file or directory",
    f"{KEYPOINTS} --videos {{data}}/sines": "--videos: {data}/sines holds no video",
    f"{KEYPOINTS} --videos {__file__}": f"--videos: {__file__}",
    f"{KEYPOINTS} --device cdua": "--device: torch cannot use the device 'cdua'",
    f"{ROBUST} --test {{data}}": "--test: {data}/meta.json does not exist",
    f"{ROBUST} --device cdua": "--device: torch cannot use the device 'cdua'",
    f"train-robust --teacher {__file__}": f"--teacher: {__file__}",
    f"{DYNAMICS} --test {{data}}": "--test: {data}/meta.json does not exist",
    f"{DYNAMICS} --test {{data}}/keypoints {{data}}/keypoints": "--test: takes directories of different names, got",
    f"{DYNAMICS} --test {{data}}/hand-wandering": "--test: {data}/hand-wandering/episode_000.npz has no key",
    f"{DYNAMICS} --test {{data}}/sines": "--ahead: must be at most 6, the steps of the shortest test, got 10.",
    f"{DYNAMICS} --test {{data}}/sines --ahead 3 --steps 9": "--steps: must be at most 6, the steps of the longest",
}


@pytest.mark.parametrize("words", EARLY)
def test_whatever_is_needed_at_the_end_is_read_before_anything_is_trained(
    words, data, trained, tmp_path, monkeypatch, capsys
):
    def work(*arguments, **more):
        raise AssertionError("work has begun")

    for place in ("train_keypoints.train_detector", "train_robust.train_robust", "train_dynamics.detect_tracks"):
        monkeypatch.setattr(f"kpirl_ocp.cli.commands.{place}", work)
    assert run([*words.format(data=data).split(), "--out", str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {EARLY[words].format(data=data)}")


@pytest.fixture(scope="module")
def failures(data, trained, tmp_path_factory):
    """Exit code and lines on stderr of every wrong command."""
    out = tmp_path_factory.mktemp("wrong")
    found = {}
    for name, (arguments, _) in WRONG.items():
        filled = [str(argument).format(data=data) for argument in arguments]
        found[name] = here(*filled, *(() if "--out" in filled else ("--out", out / "x")))
    return found


@pytest.mark.parametrize("name", WRONG)
def test_wrong_input_is_one_readable_line(failures, name):
    code, lines = failures[name]
    (line,) = lines
    assert code == 2
    assert line.startswith("error: ")
    assert WRONG[name][1] in line
