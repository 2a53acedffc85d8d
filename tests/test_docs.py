"""The pages: their code runs and prints what they say, their links lead somewhere, they build without a warning."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import kpirl_ocp
import kpirl_ocp.errors

ROOT = Path(__file__).parents[1]
PAGES = sorted(path for path in (ROOT / "docs").rglob("*.md"))
CODE = {
    path.relative_to(ROOT).as_posix(): re.findall(r"```python\n(.*?)```", path.read_text(), re.DOTALL) for path in PAGES
}
CODE = {name: blocks for name, blocks in CODE.items() if blocks}
NEEDS = {
    "docs/tutorial.md": ("cv2", "pybullet", "torch"),
    "docs/howto/own_video.md": ("cv2", "pybullet", "torch"),
    "docs/howto/own_network.md": ("torch", "onnxscript"),
    "docs/howto/pytorch.md": ("torch", "jax"),
    "docs/howto/data_sets.md": ("pyarrow", "cv2"),
}


def test_there_are_pages_of_every_kind():
    for page in ("tutorial.md", "howto/own_arm.md", "explanation/method.md", "results/paper.md", "reference/errors.md"):
        assert ROOT / "docs" / page in PAGES
    assert len(CODE) >= 10


@pytest.mark.parametrize("name", CODE)
def test_the_code_of_a_page_prints_what_its_comments_promise(name, tmp_path, monkeypatch, capsys):
    for package in NEEDS.get(name, ()):
        pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    program = "\n".join(CODE[name])
    if "jax" in NEEDS.get(name, ()):  # sets precision for the whole process
        command = [sys.executable, "-c", program]
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
        assert ran.returncode == 0, ran.stderr
        printed = ran.stdout
    else:
        exec(compile(program, name, "exec"), {"__name__": "page"})
        printed = capsys.readouterr().out
    promised = re.findall(r"print\(.*\)  # (.*)", program)
    assert printed.split("\n")[:-1] == promised


def test_no_certificate_of_the_stress_test_is_wrong_and_every_table_of_it_has_a_date_and_a_commit():
    page = (ROOT / "docs/results/stress.md").read_text()
    assert re.search(r"\d{4}-\d\d-\d\d; certificates at commit [0-9a-f]{7}", page)
    tables = re.findall(r"^### (?:Certificates|Other methods)[^\n]*\n\n(\|.*?)\n\n", page, re.MULTILINE | re.DOTALL)
    assert len(tables) == 2
    for header, _, *rows in (table.splitlines() for table in tables):
        column = header.split(" | ").index("certified and wrong")
        assert [row.split(" | ")[column] for row in rows] == ["0"] * len(rows)
    for section in ("Other methods", "Kills"):
        below = page.split(f"### {section}")[1].split("###")[0]
        assert re.search(r"\d{4}-\d\d-\d\d.{0,80}\b[0-9a-f]{7}\b", below, re.DOTALL), section


def test_a_training_step_through_a_problem_takes_ten_lines():
    step = CODE["docs/howto/pytorch.md"][0]
    others = ("import", "from", "print", "torch.manual_seed")
    lines = [line for line in step.splitlines() if line and not line.startswith(others)]
    assert "optimiser.step()" in lines
    assert len(lines) <= 10


WITHOUT_EXTRAS = """
import sys
class Missing:
    def find_spec(name, path=None, target=None):
        if name.split(".")[0] in ("av", "cv2", "h5py", "pyarrow", "torch"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Missing)
"""
RECORDED = """
seen = Riccati().solve(problem, [0, 0], [0.7, 0.01])
rows = np.column_stack([0.05 * np.arange(26), seen.states, np.append(seen.actions, 0)])
np.savetxt("mine.csv", rows, "%.5f", delimiter=",", header="t,angle,rate,torque", comments="")
"""
FROM_A_FILE = """
from kpirl_ocp.perception.data.formats import read_csv
take = read_csv("mine.csv", {"observation.state": ["angle", "rate"], "action": ["torque"]}, time="t")
demonstration = take.demonstration(state="observation.state")
"""


def test_an_own_recording_in_a_table_is_learned_from_as_the_tutorial_learns_without_any_extra(tmp_path):
    plan, learning = CODE["docs/tutorial.md"][0], CODE["docs/tutorial.md"][2]
    assert "learn(problem, [demonstration]" in learning
    taught = re.sub(r"(?m)^(observed|demonstration) = .*\n", "", learning)
    program = WITHOUT_EXTRAS + plan + RECORDED + FROM_A_FILE + taught
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.split("\n")[-2] == "[0.7  0.01]"


@pytest.mark.parametrize("path", [*PAGES, ROOT / "README.md"], ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_and_pictures_of_a_page_are_there(path):
    for target in re.findall(
        r"\]\(([^)#\s]+)(?:#[^)]*)?\)", re.sub(r"```.*?```", "", path.read_text(), flags=re.DOTALL)
    ):
        assert target.startswith("https://") or (path.parent / target).exists(), target


def test_every_name_of_the_package_is_in_the_reference():
    reference = "".join(page.read_text() for page in (ROOT / "docs" / "reference").glob("*.md"))
    described = re.findall(r"^::: kpirl_ocp\.[\w.]*?(\w+)$", reference, re.MULTILINE)
    errors = [name for name, value in vars(kpirl_ocp.errors).items() if isinstance(value, type)]
    assert set(kpirl_ocp.__all__) - {"__version__"} <= {*described, *errors}


def test_every_page_is_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text()
    for path in PAGES:
        assert path.relative_to(ROOT / "docs").as_posix() in navigation


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The pages as `make docs` builds them, without a warning."""
    for package in ("mkdocs", "material", "mkdocstrings"):
        pytest.importorskip(package)
    folder = tmp_path_factory.mktemp("pages") / "site"
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT, env=environment)
    assert built.returncode == 0, built.stderr
    assert "WARNING" not in built.stderr
    return folder


def test_the_pages_build_without_a_warning(site):
    reference = (site / "reference" / "problems.html").read_text()
    assert "from_expressions" in reference
    assert "schedule" in reference


def test_pages_load_nothing_from_elsewhere_so_that_they_and_their_search_work_as_files(site):
    for page in site.rglob("*.html"):
        elsewhere = r"<(?:script|img|iframe)[^>]*src=\"https?:|<link[^>]*stylesheet[^>]*href=\"https?:"
        assert not re.findall(elsewhere, page.read_text()), page
    assert (site / "search" / "search_index.js").exists()


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 130


def test_fields_of_a_docstring_become_a_list():
    pytest.importorskip("griffe")
    sys.path.insert(0, str(ROOT / "scripts"))
    from griffe_fields import with_list

    sections = "\n\nArgs:\n    x: one.\n\nRaises:\n    E: no."
    text = "Title.\n\npsi: (n,) numbers,\n    more of them.\nupper, lower: two." + sections
    fields = "\n* `psi`: (n,) numbers,\n    more of them.\n\n* `upper, lower`: two."
    assert with_list(text) == "Title.\n\n" + fields + sections
