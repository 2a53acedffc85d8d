"""The package follows the plan of the house (`house.py`), and what checks that would find every departure from it."""

import importlib
import subprocess
import sys
from pathlib import Path

import pytest
from house import ORDER, OUTSIDE, ROOT, House, c_faults, imports, nounless_docstrings, package_sources

from kpirl_ocp.errors import DependencyError

# What is still to be mended. The list must be exact: take a line out when its fault is gone, and add none.
KNOWN: set[str] = set()


def test_the_package_follows_the_plan_of_the_house():
    sources = package_sources()
    assert {"errors.py", "types.py", "ocp/problem/ocp.py", "irl/hypergradients/implicit.py"} <= sources.keys()
    found = House(sources).faults() | set(c_faults())
    assert sorted(found - KNOWN) == []
    assert sorted(KNOWN - found) == [], "these are mended: take them out of KNOWN"


def test_every_room_in_the_order_exists():
    rooms = [ROOT / part / room for part, lines in ORDER.items() for line in lines for room in line]
    assert [room for room in rooms if not (room / "__init__.py").is_file()] == []


def offered(face, name):
    """Whether it has the name, or would with an extra that is not installed."""
    try:
        return hasattr(face, name)
    except ModuleNotFoundError as error:
        return not str(error.name).startswith("kpirl_ocp")
    except DependencyError:
        return True


@pytest.mark.parametrize("room", [f"{part}.{room}" for part, lines in ORDER.items() for line in lines for room in line])
def test_a_room_has_the_names_that_it_offers(room):
    face = importlib.import_module(f"kpirl_ocp.{room}")
    assert [name for name in getattr(face, "__all__", ()) if not offered(face, name)] == []


def test_the_face_of_the_package_needs_numpy_and_casadi_and_imports_them_only_when_used():
    code = """
import sys, kpirl_ocp
heavy = ["casadi", "matplotlib", "numpy", "pinocchio", "scipy", "torch"]
print([name for name in heavy if name in sys.modules])
for name in kpirl_ocp.__all__:
    getattr(kpirl_ocp, name)
print([name for name in heavy if name in sys.modules])
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.splitlines() == ["[]", "['casadi', 'numpy']"]


SCRIPTS = Path(__file__).parents[1] / "scripts"


def test_scripts_of_commands_lean_on_the_package_alone():
    """The others run the experiments of this repository."""
    sources = {path.name: path.read_text() for path in SCRIPTS.glob("*.py")}
    commands = {name: text for name, text in sources.items() if "experiment(" not in text}
    assert len(commands) > 5
    for name, text in commands.items():
        outside = [found.name for found in imports(text, name) if found.name.split(".")[0] in OUTSIDE]
        assert (name, outside) == (name, [])


def test_numbers_of_casadi_are_read_in_one_place():
    """Where a Ctrl-C that CasADi drops is raised again; a text for users names the method, too."""
    reading = {path.name for path in ROOT.rglob("*.py") if ".full()" in path.read_text()}
    assert reading == {"guards.py", "loss.py"}


def test_docstrings_of_scripts_begin_with_a_noun_or_a_verb():
    faults = [(path.name, name) for path in SCRIPTS.rglob("*.py") for name in nounless_docstrings(path.read_text())]
    assert faults == []


ROOM = '"""A room."""\n__all__ = []'
ROOMS = ("ocp/problem", "ocp/codegen", "ocp/models", "ocp/solvers", "irl/learning", "perception/detector")
PACKAGE = {
    **{f"{name}.py": "" for name in ("__init__", "errors", "types", "episodes", "ocp/codegen/kkt")},
    **{f"{room}/__init__.py": ROOM for room in ("ocp", "irl", "bridges", "perception", *ROOMS)},
}
ALLOWED = {
    "__init__.py": "from kpirl_ocp.irl.learning.learn import learn\nfrom .ocp.codegen import kkt",
    "types.py": "from kpirl_ocp.errors import ProblemError\nfrom . import errors\nimport numpy as np",
    "episodes.py": "from kpirl_ocp import types, errors\nimport kpirl_ocp.types",
    "ocp/codegen/kkt.py": "from kpirl_ocp.ocp.problem.ocp import OCP\nfrom ...types import Array\nfrom . import sweeps",
    "ocp/codegen/sweeps.py": "def f():\n    import onnx",
    "ocp/problem/ocp.py": "import importlib.util\nspec = importlib.util.find_spec('pybullet_data')",
    "ocp/solvers/ipopt.py": "from kpirl_ocp.ocp.codegen.kkt import x\nfrom kpirl_ocp.ocp import problem",
    "irl/learning/learn.py": "from kpirl_ocp.ocp.codegen import kkt\nfrom . import loss\nimport kpirl_ocp.episodes",
    "bridges/torch_layer.py": "import torch\nfrom kpirl_ocp.irl.learning.learn import learn\nfrom . import networks",
    "perception/detector/nets.py": "import torch, cv2\nfrom kpirl_ocp.episodes import E\nfrom . import camera",
}
KKT, LEARN, NETS = "ocp/codegen/kkt.py", "irl/learning/learn.py", "perception/detector/nets.py"
FORBIDDEN = {  # file, its source, what is reported
    "errors import types": ("errors.py", "from kpirl_ocp.types import Array", "errors -> types.Array"),
    "errors import the package": ("errors.py", "import kpirl_ocp", "errors -> kpirl_ocp"),
    "types import ocp": ("types.py", "import kpirl_ocp.ocp.codegen", "types -> ocp.codegen"),
    "types import another base module": ("types.py", "from . import episodes", "types -> episodes"),
    "base imports irl, relatively": ("episodes.py", "from .irl import loss", "episodes -> irl.loss"),
    "base imports perception": ("episodes.py", "from kpirl_ocp import perception", "episodes -> perception"),
    "base imports torch": ("episodes.py", "if TYPE_CHECKING:\n    import torch", "episodes -> torch"),
    "ocp imports irl": (KKT, "from kpirl_ocp.irl import loss", "ocp.codegen.kkt -> irl.loss"),
    "ocp imports irl, three levels up": (KKT, "from ...irl.loss import loss", "ocp.codegen.kkt -> irl.loss.loss"),
    "ocp package imports perception": ("ocp/__init__.py", f"{ROOM}\nfrom .. import perception", "ocp -> perception"),
    "ocp imports public names": (KKT, "from kpirl_ocp import OCP", "ocp.codegen.kkt -> OCP"),
    "ocp imports torch in a function": (KKT, "def f():\n    import torch.nn", "ocp.codegen.kkt -> torch.nn"),
    "ocp imports cv2 by name": (KKT, "importlib.import_module('cv2')", "ocp.codegen.kkt -> cv2"),
    "irl imports pybullet": (LEARN, "try:\n    import pybullet\nexcept E: ...", "irl.learning.learn -> pybullet"),
    "irl imports pybullet_data": (LEARN, "__import__('pybullet_data')", "irl.learning.learn -> pybullet_data"),
    "irl imports perception": (LEARN, "import kpirl_ocp.perception.x", "irl.learning.learn -> perception.x"),
    "irl imports bridges": (LEARN, "from kpirl_ocp.bridges import x", "irl.learning.learn -> bridges.x"),
    "bridges import perception": ("bridges/x.py", "import kpirl_ocp.perception.y", "bridges.x -> perception.y"),
    "perception imports ocp": (NETS, "import kpirl_ocp.ocp", "perception.detector.nets -> ocp"),
    "the package imports torch": ("__init__.py", "import torch", "kpirl_ocp -> torch"),
    "irl imports an experiment": (LEARN, "import experiments.study", "irl.learning.learn -> experiments.study"),
    "irl imports scripts": (LEARN, "from scripts import study", "irl.learning.learn -> scripts.study"),
    "a room imports a later one": (
        KKT,
        "if TYPE_CHECKING:\n    from kpirl_ocp.ocp.solvers.fatrop import x",
        "ocp.codegen.kkt -> ocp.solvers",
    ),
    "a room imports its neighbour": (KKT, "from kpirl_ocp.ocp.models.mlp import MLP", "ocp.codegen.kkt -> ocp.models"),
    "own module in a function": (
        "ocp/solvers/ipopt.py",
        "def f():\n    from kpirl_ocp.ocp.codegen import kkt",
        "ocp.solvers.ipopt imports ocp.codegen.kkt inside a function",
    ),
    "private names": (
        "ocp/solvers/ipopt.py",
        "from kpirl_ocp.ocp.codegen.kkt import _x",
        "ocp.solvers.ipopt imports the private ocp.codegen.kkt._x",
    ),
    "a circle": (
        "ocp/codegen/sweeps.py",
        "from kpirl_ocp.ocp.codegen import kkt",
        "circle of modules: ocp.codegen.kkt, ocp.codegen.sweeps",
    ),
    "a long file": (KKT, "\n" * 301, "ocp/codegen/kkt.py has more than 300 lines"),
    "a file outside the rooms": ("irl/study.py", "", "irl/study.py is in no room"),
    "a room without a sentence": (
        "ocp/solvers/__init__.py",
        '"""Solvers"""\n__all__ = []',
        "ocp/solvers/__init__.py does not say in a sentence what the room is",
    ),
    "a room that offers nothing": (
        "ocp/solvers/__init__.py",
        '"""Solvers."""',
        "ocp/solvers/__init__.py offers no names",
    ),
    "a docstring without a noun": (
        KKT,
        'def f():\n    """What f gives."""',
        "ocp/codegen/kkt.py: the docstring of f begins with What, How or See",
    ),
    "a room without a place": ("irl/attic/__init__.py", ROOM, "irl/attic has no place in the order of rooms"),
}


def test_the_checker_accepts_what_is_allowed():
    assert House(PACKAGE | ALLOWED).faults() == set()


@pytest.mark.parametrize("case", FORBIDDEN)
def test_the_checker_reports_a_forbidden_import_or_shape(case):
    path, source, fault = FORBIDDEN[case]
    faults = House(PACKAGE | ALLOWED | {path: source}).faults()
    assert fault in faults
    assert all(other.startswith("circle") for other in faults - {fault})  # which the wrong import may close


def test_the_checker_reports_a_circle_of_rooms():
    upward = {"ocp/problem/ocp.py": "from kpirl_ocp.ocp.codegen import kkt"}
    faults = House(PACKAGE | ALLOWED | upward).faults()
    assert any(fault.startswith("circle of rooms") for fault in faults)


def test_the_checker_reports_a_crowded_room():
    crowd = {f"ocp/solvers/solver_{i}.py": "" for i in range(12)}
    assert House(PACKAGE | ALLOWED | crowd).faults() == {"ocp/solvers has more than 12 files"}
