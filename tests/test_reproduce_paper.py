"""The one command: from the shipped models to a self-contained report; and what the report says is measured."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("cv2")

from kpirl_ocp.assets import shipped_model
from kpirl_ocp.errors import ModelError
from kpirl_ocp.reporting import digits

ROOT = Path(__file__).parents[1]


def call(out, *arguments):
    """The command, without a C compiler: tiny problems take longer to compile than to solve."""
    script = str(ROOT / "scripts" / "reproduce_paper.py")
    command = [sys.executable, script, "--jobs", "1", "--out", str(out), *arguments]
    environment = os.environ | {"PATH": ""}
    return subprocess.run(command, capture_output=True, text=True, timeout=600, check=False, env=environment)


@pytest.fixture(scope="module")
def reproduced(tmp_path_factory):
    """A tiny run."""
    try:
        shipped_model("detector")
    except ModelError:
        pytest.skip("no trained models are part of this installation")
    out = tmp_path_factory.mktemp("paper")
    result = call(out, "--preset", "tiny")
    assert result.returncode == 0, result.stderr
    return out, result


def test_a_tiny_run_writes_one_self_contained_report(reproduced):
    out, result = reproduced
    page = (out / "report.html").read_text()
    assert str(out / "report.html") in result.stdout
    assert len(re.findall(r'src="data:image/svg\+xml;base64,', page)) == page.count("<img ") >= 10
    assert not re.findall(r'(?:src|href)="http', page)
    for section in ("Simulation study", "Experiment 1", "Experiment 2", "robustness", "Settings and versions"):
        assert section in page


def test_the_report_shows_the_numbers_of_metrics_json(reproduced):
    out, _ = reproduced
    metrics = json.loads((out / "metrics.json").read_text())
    jobs = metrics["results"]["jobs"]
    default = jobs["placing-executed/Default-0-1-open"]["squared"]
    assert f'<td class="number">{digits(float(default), 3)}</td>' in (out / "report.html").read_text()
    assert {claim["holds"] for claim in metrics["results"]["claims"]} <= {True, False}
    assert metrics["versions"]["casadi"]


def test_default_plans_with_equal_weights_and_no_job_is_left_out(reproduced):
    out, _ = reproduced
    jobs = json.loads((out / "metrics.json").read_text())["results"]["jobs"]
    assert np.ptp(jobs["placing/Weighted-default-0"]["weights"]) == 0
    kinds = {name.split("/")[0] for name in jobs}
    assert {
        "simulation",
        "choice",
        "reaching",
        "placing",
        "reaching-executed",
        "placing-executed",
        "robustness",
    } <= kinds


def test_a_second_run_takes_everything_from_the_first(reproduced):
    out, _ = reproduced
    before = {path: path.stat().st_mtime_ns for path in (out / "results").rglob("*.npz")}
    result = call(out, "--preset", "tiny")
    assert result.returncode == 0, result.stderr
    assert {path: path.stat().st_mtime_ns for path in (out / "results").rglob("*.npz")} == before


def test_missing_models_are_one_readable_line(tmp_path):
    result = call(tmp_path, "--preset", "tiny", "--models", str(tmp_path / "nowhere"))
    assert result.returncode == 2
    assert result.stderr == f"error: --models: there is no directory '{tmp_path / 'nowhere'}'.\n"
    (tmp_path / "empty").mkdir()
    result = call(tmp_path, "--preset", "tiny", "--models", str(tmp_path / "empty"))
    assert result.returncode == 2
    assert re.search(r"^error: .*empty.*detector\.json", result.stderr, re.MULTILINE)
    assert "Traceback" not in result.stderr
