"""Types of options: each turns one word of the command line into a value, or says in a phrase which it accepts."""

from __future__ import annotations

import math
from argparse import ArgumentTypeError
from collections.abc import Callable, Iterable
from pathlib import Path

from kpirl_ocp.spelling import suggestion


def whole(least: int, most: int | None = None) -> Callable[[str], int]:
    """Whole numbers of at least `least`, and of at most `most`."""
    expected = f"a whole number of at least {least}" if most is None else f"a whole number from {least} to {most}"

    def parse(word: str) -> int:
        try:
            value = int(word)
        except ValueError:
            value = least - 1
        if value < least or (most is not None and value > most):
            raise ArgumentTypeError(f"expected {expected}, got {word!r}")
        return value

    return parse


def real(*, least: float = -math.inf, above: float = -math.inf) -> Callable[[str], float]:
    """Finite numbers, of at least `least` and larger than `above`."""
    bounds = [f"of at least {least:g}"] * (least > -math.inf) + [f"above {above:g}"] * (above > -math.inf)
    expected = " ".join(["a finite number", *bounds])

    def parse(word: str) -> float:
        try:
            value = float(word)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and value >= least and value > above):
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


def existing_directory(word: str) -> Path:
    """A directory to read."""
    if not Path(word).is_dir():
        raise ArgumentTypeError(f"there is no directory {word!r}")
    return Path(word)


def existing_file(word: str) -> Path:
    """A file to read."""
    if not Path(word).is_file():
        raise ArgumentTypeError(f"there is no file {word!r}")
    return Path(word)


def existing(word: str) -> Path:
    """A file or directory to read."""
    if not Path(word).exists():
        raise ArgumentTypeError(f"there is no file or directory {word!r}")
    return Path(word)


def own_function(word: str) -> str:
    """FILE.py:FUNCTION, the file existing."""
    path, colon, function = word.rpartition(":")
    if not colon or not path.endswith(".py") or not function.isidentifier():
        raise ArgumentTypeError(f"expected FILE.py:FUNCTION, got {word!r}")
    existing_file(path)
    return word
