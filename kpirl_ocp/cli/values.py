"""Types of options: each turns one word of the command line into a value, or says in a phrase which it accepts."""

from __future__ import annotations

import math
import os
import re
from argparse import ArgumentTypeError
from collections.abc import Callable, Iterable
from pathlib import Path

from kpirl_ocp.errors import suggestion
from kpirl_ocp.sizes import check_file

MOST_PROCESSES = 1024  # or threads
MOST_DEMONSTRATIONS = 10_000  # made, learned from or executed at once; they are all held in memory
# Without underscores, spaces and digits of other scripts, all of which Python takes.
_WHOLE = re.compile(r"[+-]?[0-9]+")
_REAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def whole(least: int, most: int = 2**31 - 1) -> Callable[[str], int]:
    """Whole numbers of at least `least`, and of at most `most`, by default the largest int of C."""

    def parse(word: str) -> int:
        try:
            value = int(word) if _WHOLE.fullmatch(word) else least - 1
        except ValueError:  # Python reads 4300 digits
            value = least - 1 if word.startswith("-") else most + 1
        if value < least:
            raise ArgumentTypeError(f"expected a whole number of at least {least}, got {word!r}")
        if value > most:
            raise ArgumentTypeError(f"expected a whole number of at most {most}, got {word!r}")
        return value

    return parse


def real(*, least: float = -math.inf, above: float = -math.inf, most: float = math.inf) -> Callable[[str], float]:
    """Finite numbers, of at least `least`, larger than `above`, and of at most `most`."""
    bounds = [f"of at least {least:g}"] * (least > -math.inf) + [f"above {above:g}"] * (above > -math.inf)
    bounds += [f"and of at most {most:g}"] * (most < math.inf)
    expected = " ".join(["a finite number", *bounds])

    def parse(word: str) -> float:
        value = float(word) if _REAL.fullmatch(word) else math.nan
        if not (math.isfinite(value) and most >= value >= least and value > above):
            raise ArgumentTypeError(f"expected {expected}, got {word!r}")
        return value

    return parse


def one_of(names: Iterable[str]) -> Callable[[str], str]:
    """One of the names; a misspelt one is answered with the nearest."""
    known = tuple(names)

    def parse(word: str) -> str:
        if word not in known:
            raise ArgumentTypeError(f"expected one of {', '.join(known)}, got {word!r}{suggestion(word, known)}")
        return word

    return parse


def name(word: str) -> str:
    """A name of something, which is looked up later."""
    if not word:
        raise ArgumentTypeError("expected a name, got ''")
    return word


def directory(word: str) -> Path:
    """A directory for results, which need not exist."""
    if not word:
        raise ArgumentTypeError("expected a directory, got ''")
    return Path(word)


def existing_directory(word: str) -> Path:
    """A directory to read."""
    if not os.path.isdir(word):  # False as well for a name that cannot be
        raise ArgumentTypeError(f"there is no directory {word!r}")
    return Path(word)


def existing_file(word: str) -> Path:
    """A file to read."""
    try:
        check_file(Path(word))
    except ValueError as error:
        raise ArgumentTypeError(f"{word!r} cannot be read: {error}") from None
    except OSError:
        raise ArgumentTypeError(f"there is no file {word!r}") from None
    return Path(word)


def existing(word: str) -> Path:
    """A file or directory to read."""
    if not os.path.exists(word):
        raise ArgumentTypeError(f"there is no file or directory {word!r}")
    return Path(word)


def own_function(word: str) -> str:
    """FILE.py:FUNCTION, the file existing."""
    path, colon, function = word.rpartition(":")
    if not colon or not path.endswith(".py") or not function.isidentifier():
        raise ArgumentTypeError(f"expected FILE.py:FUNCTION, got {word!r}")
    existing_file(path)
    return word
