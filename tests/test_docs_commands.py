"""The commands on the pages: programs, options, extras and targets exist; the page about videos works word for word."""

import re
import runpy
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from kpirl_ocp.assets import iiwa_urdf, shipped_model
from kpirl_ocp.cli.main import run

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
PROGRAM = r"(?:kpirl|make|python scripts/\w+\.py|pip install) "


def blocks(page):
    """The commands of a page's blocks, one list of words for each, without comments."""
    text = "".join(re.findall(r"```console\n(.*?)```", page.read_text(), re.DOTALL))
    parts = [shlex.split(part, comments=True) for line in text.splitlines() for part in line.split(" && ")]
    return [words for words in parts if words]


def commands(page):
    """Those of the blocks and of the text."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    return blocks(page) + [shlex.split(found) for found in re.findall(rf"`({PROGRAM}[^`]*)`", text)]


COMMANDS = sorted({shlex.join(words) for page in PAGES for words in commands(page)})


def help_of(words, capsys, monkeypatch):
    """The help of a program, and the words behind its name."""
    if words[0] == "kpirl":
        assert run([*words[1:2], "--help"] if len(words) > 2 else ["--help"]) == 0
        return capsys.readouterr().out, words[2:]
    monkeypatch.setattr(sys, "argv", [words[1], "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(ROOT / words[1]), run_name="__main__")
    assert ended.value.code == 0
    return capsys.readouterr().out, words[2:]


def test_pages_have_commands():
    assert len(COMMANDS) > 25


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_on_a_page_can_be_given(command, capsys, monkeypatch):
    words = shlex.split(command)
    if words[0] == "make":
        targets = re.search(r"\.PHONY: (.*)", (ROOT / "Makefile").read_text()).group(1).split()
        assert {word for word in words[1:] if "=" not in word} <= set(targets)
    elif words[:2] == ["pip", "install"]:
        extras = re.findall(r"\.\[([\w,]+)\]", command)
        stated = re.findall(r"^([\w-]+) = \[", (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
        assert {name for extra in extras for name in extra.split(",")} <= set(stated)
    elif words[0] == "kpirl" or (words[0] == "python" and words[1].startswith("scripts/")):
        shown, options = help_of(words, capsys, monkeypatch)
        for word in options:
            if word.startswith("--"):
                assert re.search(rf"{word}\b", shown), word


def say(words, settings):
    """The exit code of a command on a page, with small numbers for what the page leaves open."""
    (file := Path("small.yaml")).write_text("\n".join(settings))
    if words[0] == "kpirl":
        return run([*words[1:], "--config", str(file)])
    sys.argv = [*words[1:], "--config", str(file)]
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(ROOT / words[1]), run_name="__main__")
    return ended.value.code


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A folder with what the page about videos takes for granted: films, tracks, models and a recording."""
    for package in ("av", "cv2", "pybullet", "torch"):
        pytest.importorskip(package)
    from films import film, pose, texture

    from kpirl_ocp.motion import minimum_jerk
    from kpirl_ocp.perception.data.encoding import write_video
    from kpirl_ocp.perception.data.motions import Placing
    from kpirl_ocp.perception.scene.hand import HandScene, placing_path

    here = tmp_path_factory.mktemp("workplace")
    progress = minimum_jerk(np.clip((np.arange(44) / 12 - 1.1) / 2.2, 0, 1))  # still, then from 1.1 s to 3.3 s
    poses = [pose(178 - 90 * x, 50 + 75 * x, 0.3 * x, size=80) for x in progress]
    frames = [image for _, image in film(poses, picture=texture(1, 80, 80))]
    write_video(here / "thing.mp4", frames, 12, codec="h264")
    shutil.copy(here / "thing.mp4", here / "another.mp4")
    corners = np.array([[20, 20, 1], [60, 20, 1], [60, 60, 1], [20, 60, 1.0]])
    tracks = np.array([corners @ where[:2].T for where in poses])
    dense = np.array([np.interp(np.arange(108) / 30, np.arange(44) / 12, x) for x in tracks.reshape(44, -1).T])
    np.savez(here / "cotracker.npz", tracks=dense.T.reshape(108, 4, 2), visibility=np.ones((108, 4)))
    with HandScene() as scene:
        seen = scene.film(placing_path(np.random.default_rng(0), rate=10))
    write_video(here / "person.mp4", seen, 10, codec="h264", quality=0)  # x264 differs from run to run
    for name, model in (("detector", "detector"), ("mine", "detector"), ("placing", "placing"), ("arm", "placing")):
        card = shipped_model(model)
        for suffix in (".json", ".safetensors"):
            shutil.copy(card.with_suffix(suffix), here / f"{name}{suffix}")
    one = Placing(steps=1).record(np.random.default_rng(3))
    arrays = {"observation.images.camera": one.images, "observation.state": one.joints}
    np.savez(here / "arm_at_its_start.npz", **arrays, action=one.actions, timestamp=one.times)
    return here


VIDEO = blocks(ROOT / "docs/howto/own_video.md")
SMALL = ["iterations: 25", "starts: 1"]


def test_the_commands_about_videos_are_those_that_are_tested_here():
    assert [words[:2] for words in VIDEO] == 6 * [["kpirl", "learn-video"]] + [
        ["python", f"scripts/{name}.py"] for name in ("collect_data", "train_keypoints", "train_dynamics")
    ]


def test_a_film_leads_to_an_arm_by_the_commands_of_the_page(workplace, monkeypatch):
    monkeypatch.chdir(workplace)
    shutil.copy("thing.mp4", "my_placing.mp4")
    for words in VIDEO[:3]:
        assert say(words, [*SMALL, "steps: 5"]) == 0
    assert Path("out/mine/imitation.mp4").exists()
    assert Path("out/learn-video/c/CMakeLists.txt").exists()
    assert say(VIDEO[3], ["starts: 1", "steps: 5"]) == 0


def test_a_film_leads_to_an_arm_without_a_model_by_the_commands_of_the_page(workplace, monkeypatch):
    monkeypatch.chdir(workplace)
    shutil.copy("person.mp4", "my_placing.mp4")
    few = "iterations: 3"  # may miss a tenth of the way (1); test_learned_dynamics_video learns to the end
    assert say(VIDEO[4], [few, "starts: 1"]) in (0, 1)
    assert say(VIDEO[5], [few, "steps: 10"]) in (0, 1)
    assert Path("out/learn-video/plan.npz").exists()


def test_models_are_trained_by_the_commands_of_the_page(workplace, monkeypatch, capsys):
    monkeypatch.chdir(workplace)
    monkeypatch.setattr(sys, "argv", sys.argv)
    shutil.copy("person.mp4", "my_video.mp4")
    tiny = ["preset: tiny", "steps: 3", "threads: 1"]
    assert say(VIDEO[6], ["episodes: 2", "frames: 6", "jobs: 1"]) == 0
    assert say(VIDEO[7], tiny) == 2
    assert "the detector is not good" in capsys.readouterr().err  # after three steps
    shutil.copy(shipped_model("detector"), "out/detector/detector.json")
    shutil.copy(shipped_model("detector").with_suffix(".safetensors"), "out/detector")
    for name in ("sines", "other"):
        assert run(["collect", "sines", "--episodes", "3", "--steps", "6", "--jobs", "1", "--out", f"out/{name}"]) == 0
    assert say(VIDEO[8], ["epochs: 2", "ahead: 3"]) == 0
    assert Path("out/dynamics/dynamics.json").exists()


def test_the_command_about_arms_plans_for_a_urdf(tmp_path, monkeypatch):
    pytest.importorskip("rerun")
    monkeypatch.chdir(tmp_path)
    shutil.copy(iiwa_urdf(), "arm.urdf")
    (words,) = blocks(ROOT / "docs/howto/own_arm.md")
    assert run(words[1:]) == 0
    assert Path("out/solve/plan.rrd").exists()


def test_the_commands_about_controllers_build_and_run_the_folder(tmp_path):
    if shutil.which("cmake") is None:
        pytest.skip("no cmake")
    page = ROOT / "docs/howto/deploy.md"
    code = re.search(r"```python\n(.*?)```", page.read_text(), re.DOTALL).group(1)
    (tmp_path / "main.c").write_text(re.search(r"```c\n(/\* main\.c.*?)```", page.read_text(), re.DOTALL).group(1))
    for words in ([sys.executable, "-c", code], *blocks(page)):
        ran = subprocess.run(words, check=False, cwd=tmp_path, capture_output=True, text=True)
        assert ran.returncode == 0, ran.stderr


def test_the_commands_of_the_readme_plan_for_an_arm_and_for_a_function_of_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    readme = (ROOT / "README.md").read_text()
    stated = re.search(r"```python\n(.*?)\nplan = ", readme, re.DOTALL).group(1)
    Path("own.py").write_text(stated + "\n" + re.search(r"`(def pendulum\(\): .*?)`", readme).group(1) + "\n")
    solving = [words for words in commands(ROOT / "README.md") if words[:2] == ["kpirl", "solve"]]
    assert len(solving) == 2
    for words in solving:
        assert run(words[1:]) == 0
    assert Path("out/solve/plan.png").exists()
