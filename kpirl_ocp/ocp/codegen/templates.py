"""The hand-written C of an exported folder, and how it is renamed."""

from __future__ import annotations

from importlib.resources import files

from kpirl_ocp.errors import ProblemError

PREFIX = "kpirl_mpc"
LICENCE = "/* SPDX-License-Identifier: MIT */"


def read(name: str) -> str:
    """The text of a file in `ocp/export/c`."""
    return (files("kpirl_ocp.ocp") / "export" / "c" / name).read_text()


def renamed(text: str, prefix: str) -> str:
    """Text whose names begin with another prefix, so that two controllers can be linked into one program."""
    return text.replace(PREFIX, prefix).replace(PREFIX.upper(), prefix.upper())


def check_prefix(prefix: str) -> str:
    """Raise ProblemError unless C names may begin with this."""
    if not (prefix.isidentifier() and prefix.isascii() and prefix == prefix.lower() and not prefix.startswith("_")):
        raise ProblemError(
            f"prefix must be a lower-case C name such as 'left_arm', for files and functions; got {prefix!r}."
        )
    return prefix
