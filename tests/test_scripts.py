"""Every script runs, tiny, from a clean directory; wrong input is one readable line and a non-zero exit."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from exported import STRICT, built

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted((ROOT / "scripts").glob("*.py"))

# One tiny run of each script; {demos} and {cost} come from the first two.
TINY = {
    "make_demonstrations.py": ["--tests", "2", "--horizon", "6"],
    "learn_cost.py": ["--demonstrations", "{demos}", "--steps", "3"],
    "evaluate.py": ["--demonstrations", "{demos}", "--cost", "{cost}"],
    "solve_ocp.py": ["--robot", "panda", "--horizon", "4"],
    "compare_hypergradients.py": ["--problem", "lqr", "--steps", "1", "20", "--iterations", "3"],
    "simulation_study.py": ["--seeds", "0", "--tasks", "placing", "--iterations", "3", "--tests", "1", "--jobs", "1"],
    "benchmark.py": ["--preset", "tiny"],
    "visual_demo.py": ["--iterations", "3"],
    "handwriting.py": ["--shapes", "Line", "--held-out", "1", "--steps", "3"],
    "identifiability.py": [
        *("--simulated", "5", "--design-repetitions", "1", "--demonstrations", "2", "--places", "5"),
    ],
}


SOURCES = {script.name: script.read_text() for script in SCRIPTS}
OF_COMMANDS = sorted(name for name, text in SOURCES.items() if "cli.main import script" in text)
PARTS_OF_THE_PAGES = {"griffe_fields.py", "mkdocs_hooks.py"}
TESTED_ELSEWHERE = PARTS_OF_THE_PAGES | {
    *("export_mpc.py", "collect_data.py", "train_keypoints.py", "train_dynamics.py", "reproduce_paper.py"),
    *("imitate_expert.py", "reference_suite.py", "stress_test.py"),
}
PERCEPTION = {"imitate_expert.py", "reproduce_paper.py", "visual_demo.py"}  # need its packages to start


def without(script):
    """Skip where a script's packages are missing."""
    for package in ("cv2", "pybullet", "torch") if script in PERCEPTION else ():
        pytest.importorskip(package)


def call(script, *arguments):
    command = [sys.executable, str(ROOT / "scripts" / script), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """Demonstrations and a cost learned from them."""
    base = tmp_path_factory.mktemp("inputs")
    demos, learned = base / "demos", base / "learned"
    for script, out in (("make_demonstrations.py", demos), ("learn_cost.py", learned)):
        arguments = [argument.format(demos=demos, cost="") for argument in TINY[script]]
        result = call(script, *arguments, "--out", str(out))
        assert result.returncode == 0, result.stderr
    return {"demos": demos, "cost": learned / "cost.json"}


def test_there_are_scripts_and_all_of_them_are_tested():
    assert {script.name for script in SCRIPTS} == TINY.keys() | TESTED_ELSEWHERE


@pytest.mark.parametrize("script", TINY)
def test_a_tiny_run_writes_its_numbers_and_a_figure(script, inputs, tmp_path):
    without(script)
    result = call(script, *(argument.format(**inputs) for argument in TINY[script]), "--out", str(tmp_path))
    assert result.returncode == 0, result.stderr
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert set(metrics) == {"settings", "versions", "results"}
    assert metrics["results"]
    figures = list(tmp_path.glob("*.png"))
    assert figures
    for figure in figures:
        assert figure.name in result.stdout
        assert figure.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("method", ["unrolled", "implicit"])
@pytest.mark.parametrize("cost", ["weighted", "time", "rbf"])
def test_every_cost_can_be_learned_by_every_method(method, cost, inputs, tmp_path):
    arguments = ["--demonstrations", str(inputs["demos"]), "--method", method, "--cost", cost, "--steps", "4"]
    result = call("learn_cost.py", *arguments, "--out", str(tmp_path))
    assert result.returncode == 0, result.stderr
    losses = json.loads((tmp_path / "metrics.json").read_text())["results"]["training_losses"]
    assert min(losses) < losses[0]
    assert not (tmp_path / "learning.npz").exists()  # the checkpoint of a learning that has not ended


def test_a_cost_can_be_learned_from_two_demonstrations_and_needs_one_more_for_testing(inputs, tmp_path):
    base = ["--demonstrations", str(inputs["demos"]), "--steps", "2", "--out", str(tmp_path)]
    assert call("learn_cost.py", *base, "--train", "2").returncode == 0
    result = call("learn_cost.py", *base, "--train", "3")
    assert result.returncode == 2
    assert "at least one for testing" in result.stderr


HELP_OF = {"collect_data.py": ["keypoints"]}  # a subcommand has the options


@pytest.mark.parametrize(
    "options", [["--horizon", "2"], ["--solver", "gradient-descent", "--horizon", "2"], ["--cost", "{cost}"]]
)
def test_an_exported_controller_passes_its_own_test(options, inputs, tmp_path):
    result = call("export_mpc.py", *(option.format(**inputs) for option in options), "--out", str(tmp_path))
    assert result.returncode == 0, result.stderr
    assert f"cmake -S {tmp_path}" in result.stdout
    assert "all agree" in built(tmp_path, tmp_path / "test/test.c", *STRICT)


@pytest.mark.parametrize("script", sorted(SOURCES.keys() - PARTS_OF_THE_PAGES))
def test_help_says_what_the_script_is_for(script):
    without(script)
    result = call(script, *HELP_OF.get(script, []), "--help")
    assert result.returncode == 0
    assert script == "imitate_expert.py" or "--out" in result.stdout  # which only prints
    assert len(result.stdout.split("options:")[0]) > 100


@pytest.mark.parametrize("script", OF_COMMANDS)
def test_wrong_input_is_one_readable_line(script, tmp_path):
    result = call(script, *HELP_OF.get(script, []), "--ouput", str(tmp_path))
    assert result.returncode == 2
    assert result.stderr == "error: there is no option --ouput: did you mean '--out'?\n"
