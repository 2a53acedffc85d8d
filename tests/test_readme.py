"""The code in the README runs and says what it says it says."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

README = (Path(__file__).parents[1] / "README.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


def test_the_readme_has_code():
    assert BLOCKS


@pytest.mark.parametrize("block", BLOCKS)
def test_a_block_prints_what_its_comments_promise(block, capsys):
    if "kpirl_ocp.perception" in block:
        for package in ("cv2", "pybullet", "torch"):
            pytest.importorskip(package)
    exec(compile(block, "README.md", "exec"), {})
    promised = re.findall(r"print\(.*\)  # (.*)", block)
    assert capsys.readouterr().out.split("\n")[:-1] == promised


def test_a_package_index_shows_the_readme_without_what_it_cannot_follow():
    pytest.importorskip("setuptools")
    command = [sys.executable, "setup.py", "--quiet", "--long-description"]
    root = Path(__file__).parents[1]
    shown = subprocess.run(command, capture_output=True, text=True, check=True, cwd=root).stdout
    assert "## State your own problem" in shown
    assert "(own video)" not in shown
    assert all(target.startswith("http") for target in re.findall(r"\]\(([^)]*)\)", shown))
    assert "![" not in shown
    assert "carries a bottle" not in shown  # a caption
