"""Ctrl-C and SIGTERM end every command and script in one line that says what was saved, and that can be used."""

import os
import re
import runpy
import signal
import subprocess
import sys
import time
import uuid
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import yaml
from exported import loaded
from test_scripts import INTERRUPTED

from kpirl_ocp import GradientDescent, Riccati
from kpirl_ocp.cli.main import COMMANDS, run
from kpirl_ocp.errors import FileError
from kpirl_ocp.irl.cases.cost_files import LearnedCost
from kpirl_ocp.irl.cases.examples import CASES as EXAMPLES
from kpirl_ocp.irl.learning.evaluation import evaluate
from kpirl_ocp.irl.learning.learn import Learner
from kpirl_ocp.ocp.export import ExportedSolver, export_c

SCRIPTS = Path(__file__).parents[1] / "scripts"
C, NOTHING = "kpirl_ocp.cli.commands.", "nothing was saved"
CHECKPOINT = r"the last checkpoint is {out}/checkpoint.safetensors; the same command resumes"
LEARN = "learn --demonstrations {demos} --iterations 2"
VIDEO = "learn-video {film} --box 54,74,106,126 --scale 0.4 --steps 5"
KEYPOINTS = "train-keypoints --data {keypoints} --preset tiny --threads 1 --steps"
ROBUST = "train-robust --teacher {detector} --clips 0.005 --steps 2 --batch 4 --threads 1"
DYNAMICS = "train-dynamics --detector {detector} --data {sines} --test {sines} --epochs 1 --ahead 3"
CAMERA = ("cv2", "pybullet", "torch")
CASES = {  # words; where the signal comes; what is said to be saved
    "solve": ("solve --horizon 3", "kpirl_ocp.figures.save", NOTHING),
    "demonstrate": ("demonstrate --tests 0", f"{C}demonstrate.write_demonstrations", NOTHING),
    "learn, at its start": (LEARN, f"{C}learn.configure", NOTHING),
    "learn, when it has learned": (
        LEARN,
        f"{C}learn.evaluate",
        "the learned cost is in {out}/cost.json; the same command resumes",
    ),
    "evaluate": ("evaluate --demonstrations {demos} --cost {cost}", f"{C}evaluate.evaluate", NOTHING),
    "export": ("export --cost {cost}", "kpirl_ocp.ocp.export.folder._write", NOTHING),
    "learn-video, while it watches": (VIDEO, f"{C}learn_video.follow_object", NOTHING),
    "learn-video, with tracks": (VIDEO, f"{C}learn_video.arm_for", "the tracks are in {out}/tracks.npz, for --tracks"),
    "learn-video, with a cost": (
        VIDEO,
        f"{C}learn_video.execute",
        "the tracks are in {out}/tracks.npz, for --tracks, the learned cost in {out}/cost.json, for --cost",
    ),
    "demo": ("demo", f"{C}demo.watch", NOTHING),
    "train-keypoints, at its start": (f"{KEYPOINTS} 1", f"{C}train_keypoints.train_detector", NOTHING),
    "train-keypoints, trained": (f"{KEYPOINTS} 1", f"{C}train_keypoints.finish", CHECKPOINT),
    "train-robust, at its start": (ROBUST, f"{C}train_robust.train_robust", NOTHING),
    "train-dynamics, at its start": (DYNAMICS, f"{C}train_dynamics.detect_tracks", NOTHING),
    "train-dynamics, trained": (DYNAMICS, f"{C}train_dynamics.score_dynamics", CHECKPOINT),
    "reference_suite.py": (
        "reference_suite.py --only linear-quadratic brachistochrone",
        "experiments.reference_suite.row@2",
        r"1 of 2 problems are in {out}/reference_suite.md",
    ),
    "reproduce_paper.py": (
        "reproduce_paper.py --preset tiny",
        "reproduction.data.prepare",
        "finished parts are in {out}; the same command resumes",
    ),
    "stress_test.py": (
        "stress_test.py --profile quick --only statuses",
        "stress.statuses.confirmed.count",
        r"0 of 1 parts are in {out}/metrics.json",
    ),
}
SEEING = {"learn-video", "demo", "train-keypoints", "train-robust", "train-dynamics", "reproduce_paper.py"}
ELSEWHERE = {"compare", "collect", "simulation_study.py", *(words.split()[0] for words in INTERRUPTED)}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """What the commands start from, by name; each is made when it is first asked for."""
    base = tmp_path_factory.mktemp("made")
    words = {
        "demos": ("demonstrate --tests 1 --horizon 5", ""),
        "cost": ("learn --demonstrations {demos} --iterations 1", "cost.json"),
        "keypoints": ("collect keypoints --frames 6 --episodes 2 --jobs 1", ""),
        "sines": ("collect sines --steps 6 --episodes 3 --jobs 1", ""),
        "detector": (f"{KEYPOINTS} 1", "rejected.json"),
    }

    def path(name):
        if name == "film":
            return moving_film(base / "mine.mp4")
        command, file = words[name]
        if not (base / name).exists():
            assert run([*filled(command), "--quiet", "--out", str(base / name)]) in (0, 2)
        return base / name / file

    def filled(command):
        return [re.sub(r"{(\w+)}", lambda found: str(path(found[1])), word) for word in command.split()]

    return filled


def moving_film(path):
    films = pytest.importorskip("films")
    encoding = import_module("kpirl_ocp.perception.data.encoding")
    frames = [image for _, image in films.film([films.pose(80 + 10 * t, 100 - 3 * t) for t in range(11)])]
    return path if path.exists() else encoding.write_video(path, frames, 10, codec="h264")


def started(words):
    """Exit code of a command, or of a script in this process."""
    if words[0].endswith(".py"):
        sys.argv = [str(SCRIPTS / words[0]), *words[1:]]
        with pytest.raises(SystemExit) as left:
            runpy.run_path(sys.argv[0], run_name="__main__")
        return left.value.code
    return run(words)


@pytest.fixture
def signalling(monkeypatch):
    """Replaces a function by one that gets a signal when it is called, "name@2" the second time."""
    monkeypatch.setattr(sys, "argv", sys.argv)
    monkeypatch.setattr(sys, "path", [str(SCRIPTS), *sys.path])

    def replace(place, by):
        name, _, count = place.partition("@")
        module, attribute = name.rsplit(".", 1)
        function, calls = getattr(import_module(module), attribute), iter(range(int(count or 1) - 1))

        def called(*arguments, **more):
            if next(calls, None) is None:
                signal.raise_signal(by)
            return function(*arguments, **more)

        monkeypatch.setattr(import_module(module), attribute, called)

    return replace


@pytest.mark.parametrize("name", CASES)
def test_a_signal_ends_it_in_one_line_that_says_what_was_saved(name, made, signalling, tmp_path, capsys):
    words, place, saved = CASES[name]
    command = words.split()[0]
    for package in CAMERA if command in SEEING else ():
        pytest.importorskip(package)
    words = made(words)
    signalling(place, [signal.SIGINT, signal.SIGTERM][list(CASES).index(name) % 2])
    capsys.readouterr()
    assert started([*words, "--out", str(tmp_path)]) == 130
    lines = capsys.readouterr().err.replace("\r", "\n").splitlines()
    assert [line for line in lines if line and "%|" not in line and "/s]" not in line] == [
        f"interrupted: {saved.format(out=tmp_path)}."
    ]
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["command"] == command
    for path in re.findall(r"\S+/\w+\.\w+", saved.format(out=tmp_path)):
        assert Path(path).exists()


def test_every_command_and_script_is_interrupted_here_or_elsewhere():
    here = {words.split()[0] for words, _, _ in CASES.values()}
    scripts = {path.name for path in SCRIPTS.glob("*.py") if "experiment(" in path.read_text()}
    assert here | ELSEWHERE == {*COMMANDS, *scripts}


def test_learning_that_was_interrupted_after_its_end_has_learned(made, signalling, tmp_path, monkeypatch):
    words = [*made(LEARN), "--quiet", "--out", str(tmp_path)]
    signalling(f"{C}learn.evaluate", signal.SIGINT)
    assert run(words) == 130
    learned = LearnedCost.read(tmp_path / "cost.json").psi
    monkeypatch.setattr(Learner, "step", None)  # there is nothing left to learn
    monkeypatch.setattr(import_module(f"{C}learn"), "evaluate", evaluate)
    assert run(words) == 0
    np.testing.assert_array_equal(LearnedCost.read(tmp_path / "cost.json").psi, learned)
    assert not (tmp_path / "learning.npz").exists()


def test_a_folder_whose_export_was_interrupted_is_no_controller_until_it_is_exported_again(tmp_path, monkeypatch):
    case = EXAMPLES["lqr"]()
    export_c(case.problem, Riccati(), tmp_path)
    write = Path.write_text

    def dying(path, text):
        if path.name == "kpirl_mpc_data.c":
            raise KeyboardInterrupt
        return write(path, text)

    monkeypatch.setattr(Path, "write_text", dying)
    with pytest.raises(KeyboardInterrupt):
        export_c(case.problem, GradientDescent(5, 1e-3), tmp_path)
    with pytest.raises(FileError, match="export"):
        ExportedSolver(tmp_path)
    monkeypatch.setattr(Path, "write_text", write)
    assert loaded(export_c(case.problem, Riccati(), tmp_path)).size > 0


@pytest.mark.parametrize("start", [["-m", "kpirl_ocp.cli"], ["-c", "from kpirl_ocp.cli.main import main; main()"]])
def test_ctrl_c_within_code_that_is_executed_from_text_has_the_exit_code_of_ctrl_c(start, tmp_path):
    """As in dataclasses and named tuples; Python ended `-m` as if it had been killed."""
    mine = tmp_path / "mine.py"
    mine.write_text("exec('raise KeyboardInterrupt')\n")
    done = subprocess.run(
        [sys.executable, *start, "solve", f"{mine}:problem", "--out", str(tmp_path)], capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (130, "\ninterrupted: nothing was saved.\n")


SWEEP = """
import runpy
import sys
import time
from pathlib import Path

sys.path.insert(0, sys.argv[1])
from reproduction import paper, sweep


def wait(number, free):
    while number > 2 and not Path(free).exists():
        time.sleep(0.1)
    return {"twice": 2 * number}


def reproduce(args):
    jobs = [sweep.Job(f"{number}", wait, {"number": number, "free": f"{args.out}/free"}) for number in range(8)]
    with sweep.backend(args.backend, args.address, args.jobs) as runner:
        paper.Stages(args.out, runner)("waiting", jobs)


paper.reproduce = reproduce
sys.argv[:2] = [f"{sys.argv[1]}/reproduce_paper.py"]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.mark.parametrize(
    ("backend", "send"),
    [
        ("loky", lambda process: os.kill(process, signal.SIGTERM)),
        ("dask", lambda process: os.killpg(process, signal.SIGINT)),  # as a terminal does
        ("ray", lambda process: os.kill(process, signal.SIGTERM)),
    ],
    ids=["loky, SIGTERM", "dask, Ctrl-C", "ray, SIGTERM"],
)
def test_a_sweep_on_a_cluster_ends_in_one_line_leaves_no_process_and_goes_on(backend, send, tmp_path):
    for package in ("torch", *{"dask": ["distributed"], "ray": ["ray"]}.get(backend, ())):
        pytest.importorskip(package)
    (tmp_path / "sweep.py").write_text(SWEEP)
    words = [tmp_path / "sweep.py", SCRIPTS, "--backend", backend, "--jobs", "2", "--out", tmp_path / "out"]
    mark = uuid.uuid4().hex
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "start_new_session": True}
    process = subprocess.Popen([sys.executable, "-u", *words], env=os.environ | {"KPIRL_MARK": mark}, **options)
    while len([*tmp_path.glob("out/results/*.npz")]) < 3:
        assert process.poll() is None, process.communicate()[0].decode()
        time.sleep(0.1)
    send(process.pid)
    rest, _ = process.communicate(timeout=120)
    assert process.returncode == 130, rest.decode()
    log = r"\d{4}-\d\d-.*\n" if backend == "ray" else "$."  # Ray tells how it starts
    lines = re.sub(log, "", rest.decode().replace("\r", "\n")).splitlines()
    assert [line for line in lines if line and "%|" not in line] == [
        f"interrupted: finished parts are in {tmp_path}/out; the same command resumes."
    ]
    assert not still_running(mark, 30)
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "out/results").iterdir()}
    assert [path.name.split("-")[0] for path in sorted(kept)] == ["0", "1", "2"]

    (tmp_path / "out/free").touch()
    again = subprocess.run([sys.executable, *words], capture_output=True, text=True, timeout=300)
    assert again.returncode == 0, again.stderr
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert len([*(tmp_path / "out/results").iterdir()]) == 8


def still_running(mark, seconds):
    """Processes with this mark in their environment, after that many seconds at most."""
    end = time.monotonic() + seconds
    while (left := [path for path in Path("/proc").glob("[0-9]*") if marked(path, mark)]) and time.monotonic() < end:
        time.sleep(0.2)
    return [(path / "cmdline").read_text() for path in left]


def marked(process, mark):
    try:
        return mark.encode() in (process / "environ").read_bytes()
    except OSError:  # it has ended
        return False
