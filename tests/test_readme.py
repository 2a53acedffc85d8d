"""The code in the README runs and says what it says it says."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import kpirl_ocp

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


def test_the_readme_has_code_to_run():
    assert BLOCKS


@pytest.mark.parametrize("block", BLOCKS)
def test_a_block_prints_what_its_comments_promise(block, capsys):
    if "kpirl_ocp.perception" in block:
        for package in ("cv2", "pybullet", "torch"):
            pytest.importorskip(package)
    exec(compile(block, "README.md", "exec"), {})
    promised = re.findall(r"print\(.*\)  # (.*)", block)
    assert capsys.readouterr().out.split("\n")[:-1] == promised


def shown(tmp_path, repository):
    """The README as a package index shows it, where the project's URLs name a repository, or None."""
    pytest.importorskip("setuptools", minversion="77")  # as pyproject.toml asks for
    for name in ("README.md", "LICENSE", "setup.py", "pyproject.toml", "kpirl_ocp/version.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    project = re.sub(r"^Repository = .*\n", "", (ROOT / "pyproject.toml").read_text(), flags=re.MULTILINE)
    if repository is not None:
        project = project.replace("[project.urls]\n", f'[project.urls]\nRepository = "{repository}"\n')
    (tmp_path / "pyproject.toml").write_text(project)
    command = [sys.executable, "setup.py", "--quiet", "--long-description"]
    return subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path).stdout


def test_a_package_index_shows_pictures_and_pages_of_this_version_in_the_repository(tmp_path):
    text = shown(tmp_path, "https://example.org/somebody/kpirl_ocp/")
    at = "https://example.org/somebody/kpirl_ocp"
    version = kpirl_ocp.__version__
    pictures, links = (re.findall(mark + r"\[[^\]]*\]\(([^)]*)\)", text) for mark in ("!", "(?<!!)"))
    stated = re.findall(r"!\[[^\]]*\]\(([^)]*)\)", README)
    assert pictures == [f"{at}/raw/v{version}/{path}" for path in stated]
    assert len(links) > 20
    assert all(link.startswith(f"{at}/blob/v{version}/") or "example.org" not in link for link in links)
    for link in links:
        assert link.startswith("https://")
        assert "example.org" not in link or (ROOT / link.removeprefix(f"{at}/blob/v{version}/")).exists()


def test_a_package_index_shows_the_readme_without_what_it_cannot_follow_where_no_repository_is_named(tmp_path):
    text = shown(tmp_path, None)
    assert "## State your own problem" in text
    assert "(own video)" not in text
    assert all(target.startswith("http") for target in re.findall(r"\]\(([^)]*)\)", text))
    assert "![" not in text
    assert "carries a bottle" not in text  # a caption
