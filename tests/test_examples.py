"""The examples run, and print the numbers that are known."""

import ast
import json
import re
import runpy
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "examples"
EXAMPLES = sorted(path.name for path in FOLDER.glob("*.py"))
PRINTED = {  # closed forms, or the numbers that the data were made with
    "minimum_time.py": r"time 2\.000000 s, switching after 10 of 20 steps",
    "goal.py": r"ends at \[1\. 1\.\], off the curve by \de-1\d;",
    "keep_out.py": r"smallest distance 0\.500000 of 0\.5; CONVERGED",
    "identification.py": r"stiffness and damping \[4\.  0\.2\], initial speed -0\.1000",
    "phases.py": r"durations \[2\. 1\.\], top speed 2\.000000",
    "periodic.py": r"and back, to within \de-1\d;",
    "differential_equation.py": r"(?s)midpoint +CONVERGED.*collocation +CONVERGED.*idas +CONVERGED",
    "direct_collocation.py": r"CONVERGED.*objective 2\.53009",  # as that of the integrator "collocation"
    "torch_layer.py": r"error of the actions [0-9.]+e-03, of the targets 0\.0",
    "own_network.py": r"CONVERGED; torch predicts the same next state, to \de-0[89]",
    "learning.py": r"ratio of the weights 8\.000, true 8\.000; loss 0\.9282 -> [\d.]+e-(1[2-9]|2\d)",
    "moving_reference.py": r"after 8 s, \de-1\d m from the target",
    "soft.py": r"price 10\.0: highest position 0\.5000",
}


def test_there_are_examples():
    assert len(EXAMPLES) >= 10
    assert set(PRINTED) <= set(EXAMPLES)


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_runs_is_short_and_prints_what_is_known(name, capsys):
    assert len((FOLDER / name).read_text().splitlines()) < 30
    if "torch" in (FOLDER / name).read_text():
        pytest.importorskip("onnxscript")
    runpy.run_path(str(FOLDER / name), run_name="__main__")
    printed = capsys.readouterr().out
    assert re.search(PRINTED.get(name, r"\S"), printed), printed


NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def test_there_are_two_notebooks_with_pictures():
    assert len(NOTEBOOKS) >= 2
    for path in NOTEBOOKS:
        assert path.read_text().count("<svg") >= 2


def without_numbers(text):
    """The text with a mark for every number: their last digits depend on the machine."""
    return re.sub(r"\d[-+.e\d]*", "#", text)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_prints_what_it_shows(path, capsys):
    cells = [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
    names: dict[str, object] = {}
    for cell in cells:
        *body, last = ast.parse("".join(cell["source"])).body
        exec(compile(ast.Module(body, []), path.name, "exec"), names)
        shown_last = [output for output in cell["outputs"] if output["output_type"] == "execute_result"]
        if shown_last:
            value = eval(compile(ast.Expression(last.value), path.name, "eval"), names)
            assert without_numbers(repr(value)) == without_numbers("".join(shown_last[0]["data"]["text/plain"]))
        else:
            exec(compile(ast.Module([last], []), path.name, "exec"), names)
        shown = "".join("".join(output["text"]) for output in cell["outputs"] if output["output_type"] == "stream")
        assert capsys.readouterr().out == shown
        assert not [output for output in cell["outputs"] if output["output_type"] == "error"]
