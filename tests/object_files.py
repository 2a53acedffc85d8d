"""Object files of exported C. Folders have many sources in common: what compilers see as the same is compiled once."""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

_OBJECTS = Path(os.environ["KPIRL_TEST_OBJECTS"])  # of all processes of the tests, see conftest.py
_LOOKED_AT: defaultdict[str, list[dict[str, str | None]]] = defaultdict(list)  # by text of a source
_NUMBER = "a number"


def objects_of(command: tuple[str, ...], folder: Path, names: Iterable[str] | None = None) -> list[str]:
    """The object files of a folder: of sources of these names, by default of all."""
    flags = [flag for flag in command if not flag.startswith(("-D", "-Wl"))]
    defined = {flag.removeprefix("-D"): "" for flag in command if flag.startswith("-D")}
    headers, objects = _headers(folder), []
    for source in sorted(folder.glob("*.c") if names is None else map(folder.joinpath, names)):
        made = _OBJECTS / f"{_digest([*flags, _seen(source, headers, defined)])}.o"
        _make(made, *command, "-c", str(source))
        objects.append(str(made))
    return objects


def library_of(command: tuple[str, ...], folder: Path, names: Iterable[str]) -> Path:
    """The shared library of sources in a folder."""
    objects = objects_of((*command, "-fPIC"), folder, names)
    library = _OBJECTS / f"{_digest(objects)}.so"
    _make(library, command[0], "-shared", *objects, "-lm")
    return library


def _seen(source: Path, headers: Mapping[str, str], defined: Mapping[str, str]) -> str:
    """What a compiler sees: the source, the headers that it includes, and the definitions that it looks at.

    Which these are the preprocessor tells, once for problems that differ in numbers, for which no #if asks, and in the
    declarations of their functions, which look at nothing.
    """
    text, there = source.read_text(), {**headers, **defined}
    if source.stem.endswith(("_functions", "_data")):  # of one problem only
        return repr([text, there])
    kinds = {name: _kind(name, content) for name, content in there.items()}
    for names in _LOOKED_AT[text]:
        if all(kinds.get(name) == kind for name, kind in names.items()):
            break
    else:
        said = silent("gcc", "-std=c99", *(f"-D{name}" for name in defined), "-E", "-dU", str(source))
        found = re.findall(r"^#(?:define|undef) (\w+)|^# 1 \"(?:.*/)?(.*)\"", said, re.MULTILINE)
        names = {name: kinds.get(name) for name in map("".join, found)}
        numbers = "|".join(name for name, kind in names.items() if kind == _NUMBER)
        seen = "\n".join([text, *(there[name] for name in names if name.endswith(".h") and name in there)])
        assert not re.search(rf"^ *# *(?:el)?if.*\b(?:{numbers or 'nothing'})\b", seen, re.MULTILINE)
        _LOOKED_AT[text].append(names)
    return repr([text, *((name, there.get(name)) for name in names)])


def _kind(name: str, content: str) -> str:
    """What has to be the same for a source to look at the same."""
    if name.endswith("_functions.h"):
        return "\n".join(re.findall(r"^ *#.*|\b[A-Z]{2,}[A-Z0-9_]*\b", content, re.MULTILINE))
    return _NUMBER if content.isdecimal() else content


def _headers(folder: Path) -> dict[str, str]:
    """The texts of headers and the values of definitions for the problem, by name."""
    headers = {path.name: path.read_text() for path in folder.glob("*.h")}
    (config,) = (name for name in headers if name.endswith("_config.h"))
    return dict(re.findall(r"^#define (\w+) (.*)", headers.pop(config), re.MULTILINE)) | headers


def _digest(words: Sequence[str]) -> str:
    return hashlib.sha256("\0".join(words).encode()).hexdigest()


def _make(target: Path, *command: str) -> None:
    """Run a compiler unless its output is there, which other processes see whole or not at all."""
    if not target.exists():
        part = target.with_suffix(f".{os.getpid()}")
        silent(*command, "-o", str(part))
        part.replace(target)


def silent(*command: str) -> str:
    """What a compiler writes to its output; it must succeed without a warning."""
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr[:3000]
    return done.stdout
