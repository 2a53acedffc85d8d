"""The plan of the house: the direction of imports, the order of the rooms, no circles, rooms of a size to read.

types, errors <- ocp <- irl <- bridges, viewing;    types, errors <- perception;    the rooms of each part as in ORDER
"""

import ast
import re
from collections import Counter, defaultdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.sparse

import kpirl_ocp

ROOT = Path(kpirl_ocp.__file__).parent
LAYERS = {
    "base": {"base"},
    "ocp": {"base", "ocp"},
    "irl": {"base", "ocp", "irl"},
    "bridges": {"base", "ocp", "irl", "bridges"},
    "viewing": {"base", "ocp", "irl", "perception", "viewing"},
    "perception": {"base", "perception"},
    "cli": {"base", "ocp", "irl", "bridges", "perception", "viewing", "cli"},
}
LEAVES = {"errors": set(), "pictures": set(), "types": {"errors", "pictures"}}
HEAVY = {"torch", "pybullet", "pybullet_data", "cv2"}
# A room imports from the rooms on earlier lines only; rooms on one line do not know each other.
ORDER = {
    "ocp": [
        ("problem",),
        ("models", "codegen"),
        ("conditions",),
        ("interior_point",),
        ("sensitivity",),
        ("solvers",),
        ("export",),
    ],
    "irl": [
        ("hypergradients", "cases"),
        ("learning",),
        ("identifiability",),
        ("baselines",),
        ("visual",),
    ],
    "perception": [
        ("scene",),
        ("data",),
        ("hands",),
        ("tracking",),
        ("detector",),
        ("dynamics",),
        ("plant",),
    ],
}
OUTSIDE = {"scripts", "tests", "bench", "experiments", "reproduction", "stress"}
MOST_FILES, MOST_LINES = 12, 300


class Import(NamedTuple):
    """One imported name; hidden: inside a function."""

    name: str
    hidden: bool


def imports(source, module, is_package=False):
    """Whatever a module imports anywhere in its source; `from a import b` counts as a.b."""
    package = module.split(".") if is_package else module.split(".")[:-1]

    def walk(node, hidden):
        hidden = hidden or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            origin = ".".join([*above, *filter(None, [node.module])])
            names = [f"{origin}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in ("import_module", "__import__"):
            names = [a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)]
        yield from (Import(name, hidden) for name in names)
        for child in ast.iter_child_nodes(node):
            yield from walk(child, hidden)

    yield from walk(ast.parse(source), False)


class House:
    """The sources of the package; `sources` maps file paths below kpirl_ocp/ to their text."""

    def __init__(self, sources):
        self.sources = sources
        paths = {path: ".".join(["kpirl_ocp", *Path(path).with_suffix("").parts]) for path in sources}
        self.modules = {path: name.removesuffix(".__init__") for path, name in paths.items()}
        self.names = set(self.modules.values())
        self.imports = {
            module: list(imports(sources[path], module, paths[path].endswith(".__init__")))
            for path, module in self.modules.items()
        }

    def layer(self, name):
        """A key of LAYERS; None for the package's own __init__ and for names that only it offers."""
        parts = name.split(".")
        if len(parts) > 1 and parts[1] in LAYERS:
            return parts[1]
        return "base" if len(parts) > 1 and ".".join(parts[:2]) in self.names else None

    def module_of(self, name):
        """The module of this package that a dotted name is in or is; None for other packages."""
        parts = name.split(".")
        prefixes = (".".join(parts[:n]) for n in range(len(parts), 0, -1))
        return next((prefix for prefix in prefixes if prefix in self.names), None)

    def room(self, name):
        """(part, room) of a module, or None if it is in none."""
        parts = name.split(".")
        inside = len(parts) > 2 and parts[1] in ORDER and f"{parts[1]}/{parts[2]}/__init__.py" in self.sources
        return (parts[1], parts[2]) if inside else None

    def wrong_directions(self):
        """Imports against the direction of the parts."""
        for module, found in self.imports.items():
            layer, leaf = self.layer(module), LEAVES.get(module.removeprefix("kpirl_ocp."))
            for target, _ in found:
                top, parts = target.split(".")[0], target.split(".")
                if top in OUTSIDE:
                    wrong = True
                elif top == "kpirl_ocp" and leaf is not None:
                    wrong = len(parts) < 2 or parts[1] not in leaf
                elif top == "kpirl_ocp":
                    wrong = layer is not None and self.layer(target) not in LAYERS[layer]
                else:
                    wrong = top in HEAVY and layer not in ("perception", "bridges", "viewing", "cli")
                if wrong:
                    yield f"{short(module)} -> {short(target)}"

    def wrong_order(self):
        """Imports of a room that comes later, or stands on the same line."""
        for module, found in self.imports.items():
            for target, _ in found:
                here, there = self.room(module), self.room(target)
                if here and there and here[0] == there[0] and here[1] != there[1] and not _earlier(*there, here[1]):
                    yield f"{short(module)} -> {short(self.module_of(target) or target)}"

    def hidden(self):
        """Imports of own modules inside functions."""
        for module, found in self.imports.items():
            for target, hidden in found:
                if hidden and target.split(".")[0] == "kpirl_ocp":
                    yield f"{short(module)} imports {short(self.module_of(target) or target)} inside a function"

    def private(self):
        """Private names of another module."""
        for module, found in self.imports.items():
            for target, _ in found:
                name = target.split(".")[-1]
                if target.startswith("kpirl_ocp.") and name.startswith("_") and not name.startswith("__"):
                    yield f"{short(module)} imports the private {short(target)}"

    def circles(self):
        """Circles of modules, and of rooms."""
        modules, rooms = defaultdict(set), defaultdict(set)
        for module, found in self.imports.items():
            for target, _ in found:
                there = self.module_of(target)
                if there is None or there == module:
                    continue
                modules[module].add(there)
                if self.room(module) and self.room(there) and self.room(module) != self.room(there):
                    rooms[".".join(self.room(module))].add(".".join(self.room(there)))
        for name, graph in (("modules", modules), ("rooms", rooms)):
            yield from (f"circle of {name}: {', '.join(map(short, circle))}" for circle in _circles(graph))

    def furnishing(self):
        """Rooms and files that are too large, stand outside the rooms, or do not say what they are."""
        files = defaultdict(set)
        for path, text in self.sources.items():
            lines = len(text.splitlines())
            if lines > MOST_LINES:
                yield f"{path} has more than {MOST_LINES} lines"
            parts = Path(path).parts
            files[Path(path).parent.as_posix()].add(parts[-1])
            for name in nounless_docstrings(text):
                yield f"{path}: the docstring of {name} begins with What, How or See"
            if parts[0] in ORDER and len(parts) == 2 and parts[1] != "__init__.py":
                yield f"{path} is in no room"
        for folder, names in files.items():
            if len(names - {"__init__.py"}) > MOST_FILES:
                yield f"{folder} has more than {MOST_FILES} files"
            parts = Path(folder).parts
            if parts and parts[0] in ORDER and len(parts) > 1 and _line(parts[0], parts[1]) is None:
                yield f"{folder} has no place in the order of rooms"
            face = self.sources.get(f"{folder}/__init__.py", "")
            if parts and not _says_what_it_is(face):
                yield f"{folder}/__init__.py does not say in a sentence what the room is"
            if parts and parts[0] in ORDER and len(parts) == 2 and not _offers_names(face):
                yield f"{folder}/__init__.py offers no names"

    def faults(self):
        """All of them, each once."""
        checks = (self.wrong_directions, self.wrong_order, self.hidden, self.private, self.circles, self.furnishing)
        return {fault for check in checks for fault in check()}


def short(name):
    return name.removeprefix("kpirl_ocp.")


def _line(part, room):
    return next((number for number, rooms in enumerate(ORDER[part]) if room in rooms), None)


def _earlier(part, room, than):
    first, second = _line(part, room), _line(part, than)
    return first is not None and second is not None and first < second


def _circles(graph):
    """The strongly connected components of more than one node, each sorted."""
    nodes = sorted({*graph, *(there for targets in graph.values() for there in targets)})
    number = {node: index for index, node in enumerate(nodes)}
    edges = [(number[here], number[there]) for here, targets in graph.items() for there in targets]
    rows, columns = np.array(edges, int).reshape(-1, 2).T
    matrix = scipy.sparse.coo_array((np.ones(len(rows)), (rows, columns)), (len(nodes), len(nodes)))
    _, labels = scipy.sparse.csgraph.connected_components(matrix, connection="strong")
    components = ([node for node in nodes if labels[number[node]] == label] for label in np.unique(labels))
    return [component for component in components if len(component) > 1]


def _says_what_it_is(source):
    docstring = ast.get_docstring(ast.parse(source))
    return bool(docstring) and docstring.splitlines()[0].endswith(".")


def nounless_docstrings(source):
    """Names of what has a docstring that begins with a question word, or a mere reference, where a noun belongs."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, documented) and re.match(r"(What|How|See)\b", ast.get_docstring(node) or ""):
            yield getattr(node, "name", "the module")


def _offers_names(source):
    """Whether a face assigns `__all__`."""
    names = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Name))
    return any(name.id == "__all__" and isinstance(name.ctx, ast.Store) for name in names)


def package_sources():
    """The Python files of the package."""
    return {path.relative_to(ROOT).as_posix(): path.read_text() for path in ROOT.rglob("*.py")}


def c_units():
    """The exported C files: unit (a .c and its .h) -> units whose headers it includes."""
    graph = defaultdict(set)
    for path in [*ROOT.rglob("*.c"), *ROOT.rglob("*.h")]:
        included = re.findall(r'^\s*#include "(\w+)\.h"', path.read_text(), re.MULTILINE)
        graph[path.stem] |= set(included) - {path.stem}
    return graph


def c_faults():
    """C files that are too long, too many in a folder, or include each other in a circle."""
    files = [*ROOT.rglob("*.c"), *ROOT.rglob("*.h")]
    for folder, count in Counter(path.parent.relative_to(ROOT).as_posix() for path in files).items():
        if count > MOST_FILES:
            yield f"{folder} has more than {MOST_FILES} C files"
    for path in files:
        if len(path.read_text().splitlines()) > MOST_LINES:
            yield f"{path.relative_to(ROOT).as_posix()} has more than {MOST_LINES} lines"
    yield from (f"circle of C files: {', '.join(circle)}" for circle in _circles(c_units()))
