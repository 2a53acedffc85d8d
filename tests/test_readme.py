"""The code in the README runs and says what it says it says."""

import re
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
