"""The direction of imports (design, section 3): types, errors <- ocp <- irl;  types, errors <- perception."""

import ast
from pathlib import Path

import pytest

import kpirl_ocp

ROOT = Path(kpirl_ocp.__file__).parent
LAYERS = {"base": {"base"}, "ocp": {"base", "ocp"}, "irl": {"base", "ocp", "irl"}, "perception": {"base", "perception"}}
LEAVES = {"errors": set(), "types": {"errors"}}
HEAVY = {"torch", "pybullet", "pybullet_data", "cv2"}


def imported(source, module, is_package=False):
    """Dotted names a module imports anywhere in its source; `from a import b` counts as a.b."""
    package = module.split(".") if is_package else module.split(".")[:-1]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            origin = ".".join([*above, *filter(None, [node.module])])
            yield from (f"{origin}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in ("import_module", "__import__"):
            yield from (a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str))


def layer_of(module, modules):
    """base, ocp, irl or perception; None for the package's own __init__ and for names that only it offers."""
    parts = module.split(".")
    if len(parts) > 1 and parts[1] in LAYERS:
        return parts[1]
    return "base" if len(parts) > 1 and ".".join(parts[:2]) in modules else None


def violations(sources):
    """Forbidden imports as "importer -> imported"; `sources` maps file paths below kpirl_ocp/ to their text."""
    paths = {path: ".".join(["kpirl_ocp", *Path(path).with_suffix("").parts]) for path in sources}
    modules = {path: name.removesuffix(".__init__") for path, name in paths.items()}
    found = []
    for path, module in modules.items():
        layer, leaf = layer_of(module, modules.values()), LEAVES.get(module.removeprefix("kpirl_ocp."))
        for target in imported(sources[path], module, paths[path].endswith(".__init__")):
            top, parts = target.split(".")[0], target.split(".")
            if top in ("scripts", "tests"):
                wrong = True
            elif top == "kpirl_ocp" and leaf is not None:
                wrong = len(parts) < 2 or parts[1] not in leaf
            elif top == "kpirl_ocp":
                wrong = layer is not None and layer_of(target, modules.values()) not in LAYERS[layer]
            else:
                wrong = top in HEAVY and layer != "perception"
            if wrong:
                found.append(f"{module} -> {target}")
    return found


def test_the_package_keeps_the_direction_of_imports():
    sources = {path.relative_to(ROOT).as_posix(): path.read_text() for path in ROOT.rglob("*.py")}
    assert {"errors.py", "types.py", "ocp/problem/ocp.py", "irl/hypergradients/implicit.py"} <= sources.keys()
    assert violations(sources) == []


PACKAGE = {
    name: "" for name in ("__init__.py", "errors.py", "types.py", "episodes.py", "ocp/__init__.py", "ocp/kkt.py")
}
ALLOWED = {
    "__init__.py": "from kpirl_ocp.irl.implicit import Implicit\nfrom .ocp import kkt",
    "types.py": "from kpirl_ocp.errors import ProblemError\nfrom . import errors\nimport numpy as np",
    "episodes.py": "from kpirl_ocp import types, errors\nimport kpirl_ocp.types",
    "ocp/kkt.py": "from kpirl_ocp.ocp.problem import OCP\nfrom ..types import Array\nfrom . import native",
    "ocp/robot.py": "import importlib.util\nspec = importlib.util.find_spec('pybullet_data')",
    "irl/learn.py": "from kpirl_ocp.ocp import kkt\nfrom .loss import loss\nfrom kpirl_ocp import episodes",
    "perception/detector.py": "import torch, cv2\nfrom kpirl_ocp.episodes import Episode\nfrom .camera import Camera",
}
FORBIDDEN = {  # file, its source, what is reported
    "errors import types": ("errors.py", "from kpirl_ocp.types import Array", "kpirl_ocp.types.Array"),
    "errors import the package": ("errors.py", "import kpirl_ocp", "kpirl_ocp"),
    "types import ocp": ("types.py", "import kpirl_ocp.ocp.kkt", "kpirl_ocp.ocp.kkt"),
    "types import another base module": ("types.py", "from . import episodes", "kpirl_ocp.episodes"),
    "base imports irl, relatively": ("episodes.py", "from .irl import loss", "kpirl_ocp.irl.loss"),
    "base imports perception": ("episodes.py", "from kpirl_ocp import perception", "kpirl_ocp.perception"),
    "ocp imports irl": ("ocp/kkt.py", "from kpirl_ocp.irl import loss", "kpirl_ocp.irl.loss"),
    "ocp imports irl, two levels up": ("ocp/kkt.py", "from ..irl.loss import loss", "kpirl_ocp.irl.loss.loss"),
    "ocp package imports perception": ("ocp/__init__.py", "from .. import perception", "kpirl_ocp.perception"),
    "ocp imports public names": ("ocp/kkt.py", "from kpirl_ocp import OCP", "kpirl_ocp.OCP"),
    "ocp imports torch in a function": ("ocp/kkt.py", "def f():\n    import torch.nn", "torch.nn"),
    "ocp imports cv2 by name": ("ocp/kkt.py", "importlib.import_module('cv2')", "cv2"),
    "irl imports pybullet": (
        "irl/learn.py",
        "try:\n    from pybullet import connect\nexcept E: ...",
        "pybullet.connect",
    ),
    "irl imports pybullet_data": ("irl/learn.py", "__import__('pybullet_data')", "pybullet_data"),
    "irl imports perception": ("irl/learn.py", "from kpirl_ocp.perception.x import y", "kpirl_ocp.perception.x.y"),
    "perception imports ocp": ("perception/camera.py", "import kpirl_ocp.ocp", "kpirl_ocp.ocp"),
    "base imports torch": ("episodes.py", "if TYPE_CHECKING:\n    import torch", "torch"),
    "init imports torch": ("__init__.py", "import torch", "torch"),
    "irl imports scripts": ("irl/learn.py", "from scripts import study", "scripts.study"),
    "perception imports tests": ("perception/camera.py", "import tests.problems", "tests.problems"),
}


def test_the_checker_accepts_what_is_allowed():
    assert violations(PACKAGE | ALLOWED) == []


@pytest.mark.parametrize("case", FORBIDDEN)
def test_the_checker_reports(case):
    path, source, target = FORBIDDEN[case]
    importer = ".".join(["kpirl_ocp", *Path(path).with_suffix("").parts]).removesuffix(".__init__")
    assert violations(PACKAGE | ALLOWED | {path: source}) == [f"{importer} -> {target}"]
