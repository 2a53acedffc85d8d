"""`make models` with tiny numbers: every command takes what those before it wrote, and the paper's script the rest."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("cv2")
pytest.importorskip("pybullet")
pytest.importorskip("torch")

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
from reproduction.data import Models

from kpirl_ocp.assets import shipped_model
from kpirl_ocp.errors import ModelError

ROOT = Path(__file__).parents[1]

# Stands for .venv/bin: the recipe's commands as they are, with numbers that end soon.
PROGRAM = """#!{python}
import os, sys
tiny = {tiny}
command = {command}
os.execv(command[0], command + [number for word in command for number in tiny.get(word, [])])
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The directory of models, made by the Makefile's own recipe."""
    if shutil.which("make") is None or not (ROOT / "Makefile").is_file():
        pytest.skip("needs make, and the Makefile of the sources")
    try:
        good = str(shipped_model("detector"))
    except ModelError:
        pytest.skip("no trained models are part of this installation")
    programs, models = tmp_path_factory.mktemp("bin"), tmp_path_factory.mktemp("out") / "models"
    tiny = {
        "scripts/collect_data.py": ["--episodes", "2", "--jobs", "1"],
        "sines": ["--steps", "10"],
        "hand-placing": ["--seconds", "1.2"],
        "hand-wandering": ["--seconds", "1.2"],
        # On from a good one: a detector that learned for two steps is rejected, which ends the recipe.
        "scripts/train_keypoints.py": ["--start", good, "--steps", "2"],
        "train-robust": ["--clips", "0.001", "--steps", "2", "--batch", "4"],
        "scripts/train_dynamics.py": ["--epochs", "2"],
    }
    for name, command in (
        ("python", "[sys.executable, *sys.argv[1:]]"),
        ("kpirl", "[sys.executable, '-m', 'kpirl_ocp.cli', *sys.argv[1:]]"),
    ):
        program = programs / name
        program.write_text(PROGRAM.format(python=sys.executable, tiny=tiny, command=command))
        program.chmod(0o755)
    words = ["make", "-o", ".venv/installed-perception", "models", f"BIN={programs}", f"MODELS={models}"]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    ended = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=1200, check=False)
    assert ended.returncode == 0, ended.stderr
    return models


def test_the_papers_script_reads_what_make_models_writes(made):
    models = Models.find(str(made))
    keypoints = models.load_detector().model.head.out_channels
    for task in ("reaching", "placing"):
        assert models.load_dynamics(task).n_z == 2 * keypoints


def test_the_models_are_those_of_the_recipes_last_steps(made):
    for card, origin in (("detector", "detector/detector"), ("reaching", "reaching-tanh/dynamics")):
        for suffix in (".json", ".safetensors"):
            assert (made / f"{card}{suffix}").read_bytes() == (made / f"{origin}{suffix}").read_bytes()
