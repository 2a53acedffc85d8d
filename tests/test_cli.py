"""The command `kpirl`: wrong input is one sentence, options come from files, own problems are solved."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import kpirl_ocp
from kpirl_ocp.cli.main import COMMANDS

PENDULUM = '''
import casadi as ca
from kpirl_ocp import OCP

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

def broken():
    return 1 / 0
'''


def kpirl(*words, cwd=None):
    command = [sys.executable, "-m", "kpirl_ocp.cli", *map(str, words)]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, cwd=cwd, env=environment)


def sentence(result):
    """The one line on stderr of a call that was refused."""
    assert result.returncode == 2, result.stdout + result.stderr
    assert result.stdout == ""
    line, *rest = result.stderr.splitlines()
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


@pytest.mark.parametrize("words", [["--help"], *([command, "--help"] for command in COMMANDS)], ids=" ".join)
def test_help_imports_nothing_heavy(words):
    code = f"""
import sys
from kpirl_ocp.cli.main import run
assert run({words}) == 0
print(sorted({{"numpy", "casadi", "pinocchio", "matplotlib", "scipy", "torch", "tqdm"}} & set(sys.modules)))
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "[]"


WRONG = {  # words, sentence
    "solv": "there is no command 'solv': did you mean 'solve'? (see `kpirl --help`)",
    "solve --steps -5": "--steps: expected a whole number of at least 1, got '-5'.",
    "solve --steps 1.5": "--steps: expected a whole number of at least 1, got '1.5'.",
    "solve --move nan 0 0": "--move: expected a finite number, got 'nan'.",
    "solve --move 0 -inf 0": "--move: expected a finite number, got '-inf'.",
    "solve --move 1 2": "--move: expected 3 arguments.",
    "solve --horizon -3": "--horizon: expected a whole number of at least 1, got '-3'.",
    "solve --horizon 0": "--horizon: expected a whole number of at least 1, got '0'.",
    "solve --effort -1": "--effort: expected a finite number of at least 0, got '-1'.",
    "solve --max-displacement 0": "--max-displacement: expected a finite number above 0, got '0'.",
    "solve --hrizon 3": "there is no option --hrizon: did you mean '--horizon'?",
    "solve --solver ricati": "--solver: expected one of riccati, ipopt, fatrop, sqp, gradient, got 'ricati': "
    "did you mean 'riccati'?",
    "solve --config nowhere.yaml": "--config: there is no file 'nowhere.yaml'.",
    "solve own.py": "FILE.py:FUNCTION: expected FILE.py:FUNCTION, got 'own.py'.",
    "solve nowhere.py:f": "FILE.py:FUNCTION: there is no file 'nowhere.py'.",
    "solve own.py:f": "own.py has no function 'f'.",
    "solve own.py:without_start": "own.py:without_start: the numbers have no 's0', which must be of shape (2,).",
    "solve own.py:misspelt": "own.py:misspelt: no number is called 'contxt': did you mean 'context'?",
    "solve own.py:too_short": "own.py:too_short: psi must be finite and of shape (2,), got [0.8].",
    "solve own.py:alone": "own.py:alone: it must return an OCP and a dictionary with its numbers, not OCP.",
    "solve own.py:broken": "own.py:broken raised ZeroDivisionError: division by zero (line 35 of own.py)",
    "solve own.py:pendulum --robot panda": "--robot is for the arm's problem, and own.py:pendulum is your own.",
    "solve --robot iwa": "example-robot-data has no robot 'iwa'",
    "solve --out own.py/x": "--out: cannot write to 'own.py/x': Not a directory.",
    "solve --out /proc/x": "--out: cannot write to '/proc/x': No such file or directory.",
}


@pytest.mark.parametrize("words", WRONG)
def test_wrong_input_is_one_sentence(words, own):
    assert sentence(kpirl(*words.split(), cwd=own.parent)).startswith(WRONG[words])


def test_an_own_problem_is_solved_and_its_numbers_are_written(own, tmp_path):
    result = kpirl("solve", f"{own}:pendulum", "--out", tmp_path / "out")
    assert result.returncode == 0, result.stderr
    results = json.loads((tmp_path / "out/metrics.json").read_text())["results"]
    assert results["status"] == "CONVERGED"
    assert results["KKT residual, relative"] < 1e-10
    assert (len(results["states"]), len(results["actions"])) == (26, 25)
    assert (tmp_path / "out/plan.png").read_bytes().startswith(b"\x89PNG")


def test_every_solver_finds_the_same_plan_of_an_own_problem(own, tmp_path):
    objectives = []
    for solver in ("riccati", "ipopt", "fatrop", "sqp"):
        result = kpirl("solve", f"{own}:pendulum", "--solver", solver, "--out", tmp_path / solver)
        assert result.returncode == 0, result.stderr
        objectives.append(json.loads((tmp_path / solver / "metrics.json").read_text())["results"]["objective"])
    assert max(objectives) - min(objectives) < 1e-7 * objectives[0]


def test_a_solve_that_does_not_converge_exits_with_one(own, tmp_path):
    result = kpirl("solve", f"{own}:impossible", "--solver", "ipopt", "--out", tmp_path / "out")
    assert result.returncode == 1
    assert "INFEASIBLE" in result.stdout


def test_the_saved_options_repeat_the_call_and_the_command_line_goes_first(tmp_path):
    first = ["solve", "--move", "-1e-1", "0", "-0.1", "--horizon", "4", "--effort", "0.5"]
    assert kpirl(*first, "--out", tmp_path / "a").returncode == 0
    config = yaml.safe_load((tmp_path / "a/config.yaml").read_text())
    assert config["move"] == [-0.1, 0.0, -0.1]
    assert kpirl("solve", "--config", tmp_path / "a/config.yaml", "--out", tmp_path / "b").returncode == 0
    again = ["solve", "--config", tmp_path / "a/config.yaml", "--horizon", "5", "--out", tmp_path / "c"]
    assert kpirl(*again).returncode == 0
    a, b, c = (json.loads((tmp_path / name / "metrics.json").read_text())["results"]["actions"] for name in "abc")
    assert a == b
    assert (len(a), len(c)) == (4, 5)


CONFIGS = {  # text, sentence
    "hrizon: 3": "config.yaml: there is no option 'hrizon': did you mean 'horizon'?",
    "horizon: -3": "config.yaml: --horizon: expected a whole number of at least 1, got '-3'.",
    "move: [1, 2]": "config.yaml: --move: expected 3 arguments.",
    "command: learn": "config.yaml has the options of `kpirl learn`, not of `kpirl solve`.",
    "- horizon": "config.yaml must be a mapping from options to values.",
    "a: [": "config.yaml is not a YAML file",
}


@pytest.mark.parametrize("text", CONFIGS)
def test_a_wrong_file_of_options_is_one_sentence(text, tmp_path):
    (tmp_path / "config.yaml").write_text(text)
    assert sentence(kpirl("solve", "--config", "config.yaml", cwd=tmp_path)).startswith(CONFIGS[text])


def test_quiet_prints_nothing(tmp_path):
    result = kpirl("solve", "--quiet", "--horizon", "3", "--out", tmp_path)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
