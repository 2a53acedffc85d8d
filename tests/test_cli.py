"""The command `kpirl`: wrong input is one sentence, options come from files, own problems are solved."""

import ast
import contextlib
import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from argparse import ArgumentTypeError
from dataclasses import fields
from pathlib import Path

import pytest
import yaml
from exported import STRICT, built

import kpirl_ocp
from kpirl_ocp import viewing
from kpirl_ocp.cli.commands.export import SOLVERS as EXPORT_SOLVERS
from kpirl_ocp.cli.commands.learn import OPTIMISERS
from kpirl_ocp.cli.directory import results_in
from kpirl_ocp.cli.main import COMMANDS, options_of, run
from kpirl_ocp.cli.parser import build_parser
from kpirl_ocp.cli.values import real, whole
from kpirl_ocp.errors import missing
from kpirl_ocp.irl.cases.cost_files import BASES
from kpirl_ocp.irl.cases.examples import CASES
from kpirl_ocp.irl.cases.tasks import TASKS
from kpirl_ocp.irl.visual.learning import COSTS

PENDULUM = '''
import casadi as ca; import numpy as np
from kpirl_ocp import OCP, Ipopt

def pendulum():
    """Length and weight of the effort are parameters."""
    s, u, psi = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("psi", 2)
    acceleration = u / psi[0]**2 - 9.81 / psi[0] * ca.sin(s[0])
    problem = OCP.from_expressions(
        state=s, action=u, parameters=psi, horizon=25, action_bounds=(-3, 3),
        dynamics=s + 0.05 * ca.vertcat(s[1] + 0.05 * acceleration, acceleration),
        stage_cost=(s[0] - 1)**2 + psi[1] * u**2, terminal_cost=10 * (s[0] - 1)**2 + s[1]**2)
    return problem, {"s0": [0, 0], "psi": [0.8, 0.02]}

def without_start():
    return pendulum()[0], {"psi": [0.8, 0.02]}

def misspelt():
    return pendulum()[0], {"s0": [0, 0], "psi": [0.8, 0.02], "contxt": 1}

def too_short():
    return pendulum()[0], {"s0": [0, 0], "psi": [0.8]}

def alone():
    return pendulum()[0]

def impossible():
    """No action reaches a state that lies beyond what all actions together can do."""
    s, u = ca.SX.sym("s"), ca.SX.sym("u")
    problem = OCP.from_expressions(state=s, action=u, dynamics=s + u, stage_cost=u**2, terminal_cost=s**2,
        horizon=3, action_bounds=(-1, 1), state_bounds=(9, 10))
    return problem, {"s0": 0}

def seen():
    """With a demonstration: what the plan for other parameters would look like."""
    problem, numbers = pendulum()
    return problem, numbers | {"observations": Ipopt().solve(problem, [0, 0], [0.7, 0.01]).states}

def broken():
    return 1 / 0

def exits():
    raise SystemExit

def wants(something):
    return something

def says_much():
    raise ValueError("one\\ntwo")

def true_step():
    return pendulum()[0], {"s0": [0, 0], "psi": [0.8, 0.02], "step_size": True}

def undefined():
    s, u = ca.SX.sym("s"), ca.SX.sym("u")
    problem = OCP.from_expressions(
        state=s, action=u, dynamics=ca.log(s - 1) + u, stage_cost=u**2, terminal_cost=s**2, horizon=3)
    return problem, {"s0": 0}

def no_horizon():
    return OCP.from_expressions(state=ca.SX.sym("s"), action=ca.SX.sym("u"), dynamics=0, stage_cost=0, horizon=0)

def explained():
    s, u, psi = ca.SX.sym("s"), ca.SX.sym("u"), ca.SX.sym("psi")
    problem = OCP.from_expressions(
        state=s, action=u, parameters=psi, dynamics=s + u, stage_cost=psi * u**2, terminal_cost=s**2, horizon=3)
    return problem, {"s0": 0, "psi": 1, "observations": np.zeros((4, 1))}

def unseen():
    return pendulum()[0], pendulum()[1] | {"observations": np.full((26, 2), np.nan)}
'''

OBJECTS = """
import casadi as ca
from kpirl_ocp import OCP

s, u, psi = ca.SX.sym("s", 4), ca.SX.sym("u"), ca.SX.sym("psi", 2)
problem = OCP.from_expressions(
    state=s, action=u, parameters=psi, dynamics=s + u, stage_cost=psi[0] * u**2 + psi[1] * s[0]**2, horizon=3)
pair = problem, {"s0": [0] * 4, "psi": [1, 1]}
"""

KPIRL = [sys.executable, str(Path(kpirl_ocp.__file__).with_name("cli"))]  # -m: of the working directory


def kpirl(*words, cwd=None):
    command = [*KPIRL, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, cwd=cwd)


def refusal(words, capsys):
    """The one sentence on stderr with which a command line is refused."""
    assert run(words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    line, *rest = err.splitlines()
    assert rest == []
    assert line.startswith("error: ")
    return line.removeprefix("error: ")


@pytest.fixture
def own(tmp_path):
    path = tmp_path / "own.py"
    path.write_text(PENDULUM)
    return path


def test_the_version_is_the_packages():
    assert kpirl("--version").stdout == f"kpirl {kpirl_ocp.__version__}\n"


def test_help_lists_every_command_with_a_sentence():
    lines = kpirl("--help").stdout.splitlines()
    for command in COMMANDS:
        assert any(line.split()[:1] == [command] and line.endswith(".") for line in lines), command


HELP = [[], ["--help"], ["--version"], *([command, "--help"] for command in COMMANDS)]
REFUSED = [["slove"], *([command, "--no-such-option"] for command in COMMANDS)]


@pytest.mark.parametrize("words", HELP + REFUSED, ids=" ".join)
def test_help_and_refusals_import_no_more_than_a_reader_of_yaml(words):
    code = f"""
import sys
before = set(sys.modules)
from kpirl_ocp.cli.main import run
assert run({words}) == {2 * (words in REFUSED)}
print({{name.split(".")[0] for name in set(sys.modules) - before}} - sys.stdlib_module_names)
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    imported = ast.literal_eval(result.stdout.splitlines()[-1])
    assert {"kpirl_ocp"} <= imported <= {"kpirl_ocp", "lazy_loader", "yaml", "_yaml", *cython_of(imported)}


def cython_of(names):
    """Modules that Cython adds for itself, as for the C part of yaml."""
    return {name for name in names if "cython" in name}


WHOLE = "expected a whole number of at least"
MOST = "expected a whole number of at most"
METRES = "expected a finite number of at least -1000 and of at most 1000"
NINES = "9" * 5000  # more digits than Python reads
WRONG = {  # words, beginning of the sentence
    "--verson": "there is no command '--verson': did you mean '--version'? (see `kpirl --help`)",
    "Solve": "there is no command 'Solve': did you mean 'solve'? (see `kpirl --help`)",
    "solv": "there is no command 'solv': did you mean 'solve'? (see `kpirl --help`)",
    "solve --steps -5": f"--steps: {WHOLE} 1, got '-5'.",
    "solve --steps 1.5": f"--steps: {WHOLE} 1, got '1.5'.",
    "solve --move nan 0 0": f"--move: {METRES}, got 'nan'.",
    "solve --move 0 -inf 0": f"--move: {METRES}, got '-inf'.",
    "solve --move 0 0 1e200": f"--move: {METRES}, got '1e200'.",
    "solve --move 1 2": "--move: expected 3 arguments.",
    "solve --horizon -3": f"--horizon: {WHOLE} 1, got '-3'.",
    "solve --horizon 0": f"--horizon: {WHOLE} 1, got '0'.",
    "solve --effort -1": "--effort: expected a finite number of at least 0, got '-1'.",
    "solve --max-displacement 0": "--max-displacement: expected a finite number above 0, got '0'.",
    "solve --step-size 1e-400": "--step-size: expected a finite number above 0, got '1e-400'.",
    "solve --horizon 99999999999999999999": f"--horizon: {MOST} 1000000, got '99999999999999999999'.",
    f"solve --horizon {NINES}": f"--horizon: {MOST} 1000000, got '{NINES}'.",
    "solve --steps 1e30": f"--steps: {WHOLE} 1, got '1e30'.",
    "solve --steps 1000001": f"--steps: {MOST} 1000000, got '1000001'.",
    "solve --move 1e400 0 0": f"--move: {METRES}, got '1e400'.",
    "solve --horizon 1_0": f"--horizon: {WHOLE} 1, got '1_0'.",
    "solve --effort 0_1": "--effort: expected a finite number of at least 0, got '0_1'.",
    "solve --hrizon 3": "there is no option --hrizon: did you mean '--horizon'?",
    "solve --hor 3": "there is no option --hor",
    "solve --solver ricati": "--solver: expected one of riccati, ipopt, fatrop, sqp, gradient, got 'ricati': "
    "did you mean 'riccati'?",
    "solve --config nowhere.yaml": "--config: there is no file 'nowhere.yaml'.",
    "solve own.py": "FILE.py:FUNCTION: expected FILE.py:FUNCTION, got 'own.py'.",
    "solve nowhere.py:f": "FILE.py:FUNCTION: there is no file 'nowhere.py'.",
    "solve own.py:f": "own.py has no function 'f'; it has pendulum, ",
    "solve own.py:pendulun": "own.py has no function 'pendulun': did you mean 'pendulum'?",
    "solve objects.py:f": "objects.py has no function 'f'; it has none.",
    "solve objects.py:problem": "objects.py: 'problem' is an OCP, not a function. Write one that returns it with your "
    'numbers, such as `def start(): return problem, {"s0": [0] * 4, "psi": [0, 0]}`, and give objects.py:start.',
    "solve objects.py:pair": "objects.py: 'pair' is not a function, but of type tuple. Give a function; it must return "
    "an OCP and a dictionary with its numbers.",
    "solve own.py:without_start": "own.py:without_start: the numbers have no 's0', which must be of shape (2,).",
    "solve own.py:misspelt": "own.py:misspelt: there is no number 'contxt': did you mean 'context'?",
    "solve own.py:too_short": "own.py:too_short: psi must be finite and of shape (2,), got [0.8].",
    "solve own.py:alone": "own.py:alone: it must return an OCP and a dictionary with its numbers, not OCP, "
    'such as `return problem, {"s0": [0, 0], "psi": [0, 0]}`.',
    "solve own.py:broken": "own.py:broken raised ZeroDivisionError: division by zero (line 40 of own.py)",
    "solve own.py:exits": "own.py:exits raised SystemExit (line 43 of own.py)",
    "solve own.py:wants": "own.py:wants raised TypeError: wants() missing 1 required positional argument: 'something'.",
    "solve own.py:no_horizon": "own.py:no_horizon raised ProblemError: horizon must be a whole number of at least 1 "
    "step and at most 1000000, got 0. (line 61 of own.py)",
    "solve own.py:says_much": "own.py:says_much raised ValueError: one two (line 49 of own.py)",
    "solve own.py:true_step": "own.py:true_step: step_size must be a positive number, got True.",
    "solve unfinished.py:f": "unfinished.py raised SyntaxError: '(' was never closed (unfinished.py, line 1).",
    "solve own.py:pendulum --robot panda": "--robot is for the arm's problem, and own.py:pendulum is your own.",
    "solve --robot missing.urdf": "--robot: there is no URDF file missing.urdf.",
    "solve --robot own.py": "--robot: own.py cannot be read as a URDF",
    "solve --tool elbow": "--robot iiwa --tool elbow: the robot 'lbr_iiwa' has no link 'elbow'; its links are:",
    "solve --robot=": "--robot: expected a name, got ''.",
    "solve --tool=": "--tool: expected a name, got ''.",
    "learn-video a.mp4 --robot=": "--robot: expected a name, got ''.",
    "learn-video a.mp4 --flange=": "--flange: expected a name, got ''.",
    "solve --out=": "--out: expected a directory, got ''.",
    "solve --out own.py/x": "--out: cannot write to 'own.py/x': Not a directory.",
    "solve --out own.py": "--out: 'own.py' is a file, and not a directory.",
    "solve --out /proc/x": "--out: cannot write to '/proc/x': No such file or directory.",
    "demonstrate --task plcing": "--task: expected one of placing, reaching, got 'plcing': did you mean 'placing'?",
    "demonstrate --tests -3": f"--tests: {WHOLE} 0, got '-3'.",
    "demonstrate --horizon 0": f"--horizon: {WHOLE} 1, got '0'.",
    "demonstrate --seed -1": f"--seed: {WHOLE} 0, got '-1'.",
    "learn --demonstrations nowhere": "--demonstrations: there is no directory 'nowhere'.",
    "learn --demonstrations empty": "--demonstrations: empty/meta.json does not exist: make demonstrations",
    "learn --demonstrations . --task placing": "--demonstrations and --task exclude each other",
    "learn --train 0": f"--train: {WHOLE} 1, got '0'.",
    "learn --train 100000000": f"--train: {MOST} 10000, got '100000000'.",
    "demonstrate --tests 100000000": f"--tests: {MOST} 10000, got '100000000'.",
    "learn --iterations -1": f"--iterations: {WHOLE} 0, got '-1'.",
    "demonstrate --iterations 5": "there is no option --iterations",
    "learn --inner-steps 0": f"--inner-steps: {WHOLE} 1, got '0'.",
    "learn --step-size 0": "--step-size: expected a finite number above 0, got '0'.",
    "learn --learning-rate nan": "--learning-rate: expected a finite number above 0, got 'nan'.",
    "learn --seed 2147483648": f"--seed: {MOST} 2147483647, got '2147483648'.",
    "learn --inner-steps 99999999999": f"--inner-steps: {MOST} 1000000, got '99999999999'.",
    "learn --method implicid": "--method: expected one of unrolled, implicit, got 'implicid': did you mean 'implicit'?",
    "learn --cost wieghted": "--cost: expected one of weighted, time, rbf, got 'wieghted': did you mean 'weighted'?",
    "learn --optimiser sgd": "--optimiser: expected one of adam, descent, lbfgs, got 'sgd'.",
    "evaluate": "the following arguments are required: --demonstrations.",
    "evaluate --demonstrations . --cost nowhere": "--cost: there is no file 'nowhere'.",
    "evaluate --demonstrations . --cost empty.json": "--cost: empty.json is not a learned cost: it has no 'effort'.",
    "evaluate --demonstrations . --cost list.json": "--cost: list.json is not a learned cost: "
    "it must be an object, got [].",
    "evaluate --demonstrations . --cost visual.json": "--cost: visual.json is not a learned cost: it is a cost over "
    "detected keypoints: plan with it, or export it, by `kpirl learn-video FILM --detector CARD --dynamics CARD "
    "--cost visual.json [--export]`.",
    "evaluate --demonstrations . --cost bytes": "--cost: bytes is not a learned cost: "
    "it is not text in UTF-8: invalid start byte at byte 2.",
    "solve --config bytes": "--config: bytes is not a YAML file: it is not text in UTF-8: invalid",
    "evaluate --demonstrations . --cost own.py": "--cost: own.py is not a learned cost",
    "compare --problem lrq": "--problem: expected one of iiwa, integrator, lqr, pendulum, got 'lrq': "
    "did you mean 'lqr'?",
    "compare --steps 1 0": f"--steps: {WHOLE} 1, got '0'.",
    "compare --iterations 0": f"--iterations: {WHOLE} 1, got '0'.",
    "compare own.py:seen --problem lqr": "--problem is an example, and FILE.py:FUNCTION your own: give one of them.",
    "compare own.py:pendulum": "own.py:pendulum: a hypergradient needs parameters psi, and the observations",
    "compare own.py:unseen": "own.py:unseen: observations must be finite and of shape (26, 2), got array([[nan,",
    "compare own.py:explained": "the gradient is zero, as psi explains the observations: give another psi, or others.",
    "compare own.py:f": "own.py has no function 'f'; it has pendulum, ",
    "export own.py:undefined": "the example with s0 = [0.0] meets NaN or infinity: check dynamics, costs, constraints",
    "export --horizon 0": f"--horizon: {WHOLE} 1, got '0'.",
    "export --cost nowhere": "--cost: there is no file 'nowhere'.",
    "export --prefix Arm": "--prefix: expected a prefix of lower-case letters, digits and underscores, got 'Arm'.",
    "export --solver converge": "--solver: expected one of real-time, converged, gradient-descent, sqp, "
    "got 'converge': did you mean 'converged'?",
    "export own.py:pendulum --cost own.py": "--cost is for a learned cost, and FILE.py:FUNCTION your own problem",
    "export own.py:pendulum --horizon 3": "--horizon is for the placing model; another problem has a horizon",
    "demo --cost TimDep": "--cost: expected one of TimeDep, Weighted, RBF, got 'TimDep': did you mean 'TimeDep'?",
    "demo --cost rbf": "--cost: expected one of TimeDep, Weighted, RBF, got 'rbf': did you mean 'RBF'?",
    "demo --iterations 0": f"--iterations: {WHOLE} 1, got '0'.",
    "collect": "the following arguments are required: MOTION.",
    "collect keypoint": "MOTION: expected one of keypoints, sines, placing, reaching, hand-placing, hand-wandering, "
    "got 'keypoint': did you mean 'keypoints'?",
    "collect sines --episodes 0": f"--episodes: {WHOLE} 1, got '0'.",
    "collect sines --jobs 0": f"--jobs: {WHOLE} 1, got '0'.",
    "collect sines --jobs 100000": f"--jobs: {MOST} 1024, got '100000'.",
    "collect sines --amplitude -1": "--amplitude: expected a finite number of at least 0 and of at most 6.2832, got",
    "collect sines --surroundings 9": f"--surroundings: {MOST} 3, got '9'.",
    "collect hand-placing --seconds 1e300": "--seconds: expected a finite number of at least 0.1 and of at most 3600, ",
    "train-keypoints --data nowhere": "--data: there is no directory 'nowhere'.",
    "train-keypoints --data . --preset ful": "--preset: expected one of tiny, default, full, minderer, got 'ful': "
    "did you mean 'full'?",
    "train-keypoints --data . --videos nowhere": "--videos: there is no file or directory 'nowhere'.",
    "train-keypoints --data . --threads 0": f"--threads: {WHOLE} 1, got '0'.",
    "train-dynamics": "the following arguments are required: --detector, --data, --test.",
    "train-dynamics --detector nowhere": "--detector: there is no file 'nowhere'.",
    "train-dynamics --activation rlu": "--activation: expected one of relu, tanh, softplus, silu, got 'rlu': "
    "did you mean 'relu'?",
}


@pytest.mark.parametrize("words", WRONG)
def test_wrong_input_is_one_sentence(words, own, monkeypatch, capsys):
    monkeypatch.chdir(own.parent)
    (own.parent / "empty").mkdir()
    (own.parent / "empty.json").write_text("{}")
    (own.parent / "list.json").write_text("[]")
    (own.parent / "visual.json").write_text('{"kind": "kpirl_ocp.visual_cost"}')
    (own.parent / "unfinished.py").write_text("f(\n")
    (own.parent / "objects.py").write_text(OBJECTS)
    (own.parent / "bytes").write_bytes(b"{}\xff" + bytes(5000))
    assert refusal(words.split(), capsys).startswith(WRONG[words])


@pytest.mark.parametrize("command", COMMANDS)
def test_no_option_takes_a_number_that_c_or_memory_has_no_room_for(command):
    options = build_parser(command, "", options_of(command).add_options).options().values()
    for kind in {option.type for option in options if option.type}:
        assert not any(isinstance(taken(kind, word), int) for word in ("99999999999999999999", NINES)), kind
        assert not isinstance(taken(kind, "1e400"), float), kind


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("word", ["1_0", " 5", "5 ", "5\n", "\u0665", "\uff15", "0x5", "1e1_0", "5.\u0665", "1 .", ""])
def test_no_option_takes_a_number_that_only_python_would_read(command, word):
    options = build_parser(command, "", options_of(command).add_options).options().values()
    for kind in {option.type for option in options if option.type}:
        assert not isinstance(taken(kind, word), int | float), kind


@pytest.mark.parametrize(("word", "value"), [("5", 5), ("+5", 5), ("-.5e1", -5), ("5.", 5), ("05", 5), ("5E+0", 5)])
def test_usual_spellings_of_a_number_are_taken(word, value):
    assert real()(word) == value
    if set(word) <= set("+05"):
        assert whole(0)(word) == value


def test_a_command_that_draws_nothing_imports_nothing_that_draws():
    code = "import sys, kpirl_ocp.cli.commands.export; print('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "False\n"


def taken(kind, word):
    with contextlib.suppress(ArgumentTypeError):
        return kind(word)
    return word


def test_what_takes_more_memory_than_there_is_ends_in_one_sentence(tmp_path):
    def limited():
        resource.setrlimit(resource.RLIMIT_DATA, (2**30, 2**30))

    words = [*KPIRL, "export", "--horizon", "1000000", "--out", str(tmp_path / "c")]
    result = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False, preexec_fn=limited)
    assert result.returncode == 2
    assert result.stderr == (
        "error: this takes more memory than the 1.0 GiB that there are: ask for fewer steps, episodes or processes.\n"
    )


def test_a_working_directory_that_cannot_be_written_is_one_sentence(monkeypatch, capsys):
    monkeypatch.chdir("/proc")
    assert refusal(["solve"], capsys) == "--out: cannot write to 'out/solve': No such file or directory."


def test_two_runs_do_not_write_into_one_directory_at_once(tmp_path, capsys):
    with results_in(tmp_path):
        sentence = refusal(["solve", "--horizon", "2", "--out", str(tmp_path)], capsys)
        assert sentence.startswith(f"--out: another run is writing to '{tmp_path}': wait for its end, or choose")
    assert list(tmp_path.iterdir()) == []
    assert run(["solve", "--horizon", "2", "--quiet", "--out", str(tmp_path)]) == 0


@pytest.mark.parametrize("room", [0, 16_384])  # [bytes]: for nothing, and for a part of the figure
def test_a_full_disk_is_one_sentence_and_leaves_no_part_of_a_file(room, own, tmp_path):
    def limited():
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))

    words = [*KPIRL, "solve", f"{own}:pendulum", "--solver", "ipopt", "--out", str(tmp_path / "out")]
    result = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False, preexec_fn=limited)
    assert result.returncode == 2
    assert result.stderr.splitlines()[-1] == f"error: --out: cannot write to '{tmp_path}/out': File too large."
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize("words", ["--help", "solve own.py:pendulum --solver ipopt"])
def test_a_reader_who_has_seen_enough_ends_the_program_without_a_word(words, own, tmp_path):
    reading, writing = os.pipe()
    os.close(reading)
    command = [*KPIRL, *words.split()]
    result = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, timeout=300, cwd=tmp_path)
    os.close(writing)
    assert (result.returncode, result.stderr) == (128 + signal.SIGPIPE, "")


@pytest.mark.parametrize("robot", ["iwa", "pnada"])
def test_a_misspelt_robot_is_answered_with_the_nearest(robot, tmp_path, monkeypatch, capsys):
    pytest.importorskip("kpirl_ocp.ocp.models.robot_files").example_urdf("panda")  # without the extra: another sentence
    monkeypatch.chdir(tmp_path)
    nearest = {"iwa": "iiwa", "pnada": "panda"}[robot]
    expected = f"--robot: example-robot-data has no robot {robot!r}: did you mean {nearest!r}?"
    assert refusal(["solve", "--robot", robot], capsys) == expected


@pytest.mark.parametrize(
    ("words", "beginning"),
    [
        (
            "collect sines --swing 0.1",
            "--swing is not for sines, which has --rate, --surroundings, --steps, --amplitude, --others.",
        ),
        (
            "collect hand-placing --rate 1 --seconds 0.2",
            "--seconds, --rate: 0.2 s at 1 Hz are a clip of one frame.",
        ),
        ("train-keypoints --data empty", "--data: empty/meta.json does not exist"),
        ("train-keypoints --data none", "--data: training needs clips of at least 6 frames; there are none."),
    ],
)
def test_wrong_input_of_the_camera_is_one_sentence(words, beginning, tmp_path, monkeypatch, capsys):
    for package in ("cv2", "pybullet", "torch"):
        pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "none").mkdir()
    (tmp_path / "none" / "meta.json").write_text('{"version": 1, "episodes": 0}')
    assert refusal(words.split(), capsys).startswith(beginning)


def test_a_missing_package_is_a_sentence_with_the_extra_that_brings_it(tmp_path):
    without = "import sys; sys.modules['torch'] = None; from kpirl_ocp.cli.main import main; main()"
    command = [sys.executable, "-c", without, "train-dynamics", "--detector", __file__, "--data", ".", "--test", "."]
    result = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, cwd=tmp_path)
    sentence = '`kpirl train-dynamics` needs torch, which is not installed: pip install "kpirl-ocp[perception]"'
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith(f"error: {sentence}")


@pytest.mark.parametrize(("version", "camera"), [((3, 11), False), ((3, 12), True), ((3, 13), True)], ids=str)
def test_where_pybullet_has_no_wheels_the_extra_is_said_to_lack_the_camera(version, camera, monkeypatch):
    monkeypatch.setattr(sys, "version_info", version)
    said = str(missing("`kpirl demo`", ModuleNotFoundError(name="torch")))
    assert said.endswith('"; the simulated camera, which is part of it, needs Python 3.11 or 3.10.') == camera
    assert said.endswith('[perception]".') != camera
    other = str(missing("OCPLayer", ModuleNotFoundError(name="torch"), {"torch": "torch"}))
    assert other == 'OCPLayer needs torch, which is not installed: pip install "kpirl-ocp[torch]".'


def test_the_names_that_options_accept_are_those_of_the_package():
    accepted = {
        "learn TASKS": set(TASKS),
        "learn COSTS": BASES.keys() - {"default"},
        "learn OPTIMISERS": OPTIMISERS.keys(),
        "compare PROBLEMS": CASES.keys(),
        "export SOLVERS": EXPORT_SOLVERS.keys(),
        "demo COSTS": COSTS.keys(),
    }
    for place, names in accepted.items():
        command, name = place.split()
        assert set(getattr(options_of(command), name)) == names, place


def test_the_names_that_options_of_the_camera_accept_are_those_of_the_package():
    for package in ("cv2", "pybullet", "torch"):
        pytest.importorskip(package)
    from kpirl_ocp.perception.data.motions import MOTIONS
    from kpirl_ocp.perception.detector.training import PRESETS
    from kpirl_ocp.perception.dynamics.model import ACTIVATIONS

    assert set(options_of("collect").MOTIONS) == MOTIONS.keys()
    assert set(options_of("train-keypoints").PRESETS) == PRESETS.keys()
    assert set(options_of("train-dynamics").ACTIVATIONS) == ACTIVATIONS.keys()
    settings = {field.name: field for motion in MOTIONS.values() for field in fields(motion)}
    assert options_of("collect").SETTINGS.keys() == settings.keys()


def test_an_own_problem_is_solved_and_its_numbers_are_written(own, tmp_path):
    result = kpirl("solve", f"{own}:pendulum", "--out", tmp_path / "out")
    assert result.returncode == 0, result.stderr
    results = json.loads((tmp_path / "out/metrics.json").read_text())["results"]
    assert results["status"] == "CONVERGED"
    assert results["KKT residual, relative"] < 1e-10
    assert (len(results["states"]), len(results["actions"])) == (26, 25)
    assert (tmp_path / "out/plan.png").read_bytes().startswith(b"\x89PNG")


def test_the_plan_of_an_arm_is_written_for_rerun(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "rerun", None)
    sentence = '`kpirl solve` needs rerun, which is not installed: pip install "kpirl-ocp[rerun]".'
    monkeypatch.delitem(sys.modules, "kpirl_ocp.viewing.rerun_file", raising=False)
    monkeypatch.delitem(vars(viewing), "write_rerun", raising=False)  # where an earlier call has left it
    assert refusal(["solve", "--horizon", "2", "--rerun"], capsys) == sentence
    monkeypatch.undo()
    pytest.importorskip("rerun")
    result = kpirl("solve", "--horizon", "2", "--rerun", "--out", tmp_path)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "plan.rrd").read_bytes()[:3] == b"RRF"


NEIGHBOUR = """
from __future__ import annotations
from dataclasses import dataclass

@dataclass(frozen=True)
class Start:
    angle: float = 0.0
"""


STARTED = """
def started():
    from beside_it import Start
    return pendulum()[0], {"s0": [Start().angle, 0], "psi": [0.8, 0.02]}
"""


@pytest.mark.parametrize("name", ["mein Pendel, größer.py", "numpy.py"])
def test_an_own_file_may_have_any_name_hold_dataclasses_and_import_its_neighbours(name, tmp_path, monkeypatch):
    (tmp_path / "beside_it.py").write_text(NEIGHBOUR)
    (tmp_path / name).write_text(NEIGHBOUR + PENDULUM + STARTED)
    monkeypatch.chdir(tmp_path)
    assert run(["solve", f"{name}:started", "--quiet", "--out", "größer"]) == 0
    assert json.loads((tmp_path / "größer/metrics.json").read_text())["results"]["status"] == "CONVERGED"


def test_every_solver_finds_the_same_plan_of_an_own_problem(own, tmp_path):
    objectives = []
    for solver in ("riccati", "ipopt", "fatrop", "sqp"):
        assert run(["solve", f"{own}:pendulum", "--solver", solver, "--quiet", "--out", str(tmp_path / solver)]) == 0
        objectives.append(json.loads((tmp_path / solver / "metrics.json").read_text())["results"]["objective"])
    assert max(objectives) - min(objectives) < 1e-7 * objectives[0]


def test_a_solve_that_does_not_converge_exits_with_one(own, tmp_path):
    result = kpirl("solve", f"{own}:impossible", "--solver", "ipopt", "--out", tmp_path / "out")
    assert result.returncode == 1
    assert "INFEASIBLE" in result.stdout


def test_the_saved_options_repeat_the_call_and_the_command_line_goes_first(tmp_path):
    first = ["solve", "--move", "-1e-1", "0", "-0.1", "--horizon", "4", "--effort", "0.5"]
    assert run([*first, "--out", str(tmp_path / "a")]) == 0
    saved = str(tmp_path / "a/config.yaml")
    config = yaml.safe_load(Path(saved).read_text())
    assert config["move"] == [-0.1, 0.0, -0.1]
    assert run(["solve", "--config", saved, "--out", str(tmp_path / "b")]) == 0
    assert run(["solve", "--config", saved, "--horizon", "5", "--out", str(tmp_path / "c")]) == 0
    a, b, c = (json.loads((tmp_path / name / "metrics.json").read_text())["results"]["actions"] for name in "abc")
    assert a == b
    assert (len(a), len(c)) == (4, 5)


CONFIGS = {  # text, sentence
    "hrizon: 3": "--config: config.yaml: there is no option 'hrizon': did you mean 'horizon'?",
    "horizon: -3": "--config: config.yaml: --horizon: expected a whole number of at least 1, got '-3'.",
    "move: [1, 2]": "--config: config.yaml: --move: expected 3 arguments.",
    "command: learn": "--config: config.yaml has the options of learn, not of solve.",
    "solver: [riccati, ipopt]": "--config: config.yaml: 'solver' must be one value, got ['riccati', 'ipopt'].",
    "rerun: maybe": "--config: config.yaml: 'rerun' must be true or false, got 'maybe'.",
    "- horizon": "--config: config.yaml must be a mapping from options to values.",
    "a: [": "--config: config.yaml is not a YAML file",
}


@pytest.mark.parametrize("text", CONFIGS)
def test_a_wrong_file_of_options_is_one_sentence(text, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config.yaml").write_text(text)
    assert refusal(["solve", "--config", "config.yaml"], capsys).startswith(CONFIGS[text])


def test_required_options_may_come_from_a_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config.yaml").write_text("demonstrations: .\ncost: nowhere\n")
    assert refusal(["evaluate", "--config", "config.yaml"], capsys) == (
        "--config: config.yaml: --cost: there is no file 'nowhere'."
    )
    (tmp_path / "config.yaml").write_text("motion: sine\n")
    assert refusal(["collect", "--config", "config.yaml"], capsys).startswith(
        "--config: config.yaml: MOTION: expected one of"
    )
    (tmp_path / "config.yaml").write_text("motion: sines\njobs: 0\n")
    assert refusal(["collect", "--config", "config.yaml"], capsys).startswith("--config: config.yaml: --jobs: expected")


@pytest.mark.parametrize("words", ["solve --horizon 3", "learn --iterations 2 --train 1", "demonstrate --tests 0"])
def test_quiet_prints_nothing(words, tmp_path):
    result = kpirl(*words.split(), "--quiet", "--out", tmp_path)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")


def interrupted(words, tmp_path, sign, by=signal.SIGINT, to=os.killpg):
    """Exit code, and lines on stderr but for progress, of a command that gets a signal when `sign` is seen there.

    to: os.killpg, as a terminal sends it to the workers as well, or os.kill. Nothing may be left behind.
    """
    command = [*KPIRL, *words, "--out", str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True)
    seen = b""
    while sign not in seen and process.poll() is None:
        seen += os.read(process.stderr.fileno(), 4096)
    to(process.pid, by)
    _, rest = process.communicate(timeout=120)
    lines = (seen + rest).decode().replace("\r", "\n").splitlines()
    assert left_behind(process.pid) == []
    return process.returncode, [line for line in lines if line and "it/s" not in line and "%|" not in line]


def left_behind(session):
    """The command lines of a session's processes, once they have had time to end."""
    deadline = time.monotonic() + 30
    while (found := list(running(session))) and time.monotonic() < deadline:
        time.sleep(0.1)
    return found


def running(session):
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended meanwhile
            state, _, _, its = (process / "stat").read_text().rpartition(")")[2].split()[:4]
            if int(its) == session and state != "Z":
                yield (process / "cmdline").read_text().replace("\0", " ")


SIGNALS = pytest.mark.parametrize(
    ("by", "to"),
    [(signal.SIGINT, os.killpg), (signal.SIGTERM, os.killpg), (signal.SIGTERM, os.kill)],
    ids=["Ctrl-C", "SIGTERM to all", "SIGTERM"],
)


@SIGNALS
def test_interrupted_learning_keeps_the_best_cost(by, to, tmp_path):
    words = ["learn", "--iterations", "1000000", "--task", "reaching"]
    code, (line,) = interrupted(words, tmp_path, b"best=", by, to)
    assert code == 130
    pattern = rf"interrupted: the best cost of (\d+) iterations is in {tmp_path}/cost.json; the same command resumes."
    taken = int(re.fullmatch(pattern, line).group(1))
    results = json.loads((tmp_path / "metrics.json").read_text())["results"]
    assert json.loads((tmp_path / "cost.json").read_text())["psi"] == results["psi"]
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["task"] == "reaching"
    assert run(["learn", "--iterations", str(taken + 2), "--task", "reaching", "--out", str(tmp_path)]) == 0
    losses = json.loads((tmp_path / "metrics.json").read_text())["results"]["training_losses"]
    assert losses[: taken + 1] == results["training_losses"]
    assert len(losses) == taken + 3


@SIGNALS
def test_an_interrupted_comparison_keeps_what_was_measured(by, to, tmp_path):
    words = ["compare", "--problem", "lqr", "--steps", "1", "2", "3", "4", "5"]
    code, lines = interrupted(words, tmp_path, b"| 1/17", by, to)
    assert len(lines) == 1, lines
    (line,) = lines
    assert code == 130
    kept = re.fullmatch(rf"interrupted: (\d+) of 17 measurements are in {tmp_path}/metrics.json.", line).group(1)
    results = json.loads((tmp_path / "metrics.json").read_text())["results"]
    assert len(results["measurements"]) == int(kept) >= 1


@SIGNALS
def test_an_interrupted_collection_keeps_its_episodes_and_goes_on(by, to, tmp_path):
    for package in ("cv2", "pybullet", "torch"):
        pytest.importorskip(package)
    words = ["collect", "keypoints", "--frames", "2", "--episodes", "40"]
    code, lines = interrupted(words, tmp_path, b"| 1/40", by, to)
    assert code == 130
    assert lines == [f"interrupted: finished episodes are in {tmp_path}; the same command resumes."]
    assert 1 <= len(list(tmp_path.glob("episode_*.npz"))) < 40


def test_a_collection_that_is_interrupted_while_its_workers_start_says_one_line(tmp_path):
    """0/40 is printed before they are there."""
    for package in ("cv2", "pybullet", "torch"):
        pytest.importorskip(package)
    words = ["collect", "keypoints", "--frames", "2", "--episodes", "40", "--jobs", "4"]
    code, lines = interrupted(words, tmp_path, b"| 0/40")
    assert code == 130
    assert lines == [f"interrupted: finished episodes are in {tmp_path}; the same command resumes."]


def test_the_hypergradients_of_an_own_problem_are_compared(own, tmp_path):
    words = ["compare", f"{own}:seen", "--steps", "300", "1", "300", "--iterations", "2", "--out", tmp_path]
    result = kpirl(*words)
    assert result.returncode == 0, result.stderr
    results = json.loads((tmp_path / "metrics.json").read_text())["results"]
    unrolled = [m["steps"] for m in results["measurements"] if m["method"] == "unrolled"]
    assert unrolled == [1, 300]
    assert results["finite_difference_agreement"] < 1e-4
    errors = {(m["method"], m["steps"]): m["error"] for m in results["measurements"]}
    assert errors["implicit (Riccati)", 0] < 1e-8
    assert errors["unrolled", 300] < 1e-8 < errors["unrolled", 1]  # the estimated step size converges
    assert (tmp_path / "hypergradients.png").read_bytes().startswith(b"\x89PNG")


def test_the_controller_of_an_own_problem_passes_its_own_test(own, tmp_path):
    result = kpirl("export", f"{own}:pendulum", "--solver", "gradient-descent", "--out", tmp_path / "c")
    assert result.returncode == 0, result.stderr
    assert "all agree" in built(tmp_path / "c", tmp_path / "c/test/test.c", *STRICT)
