"""The shared library of an exported folder, built by the system's compiler and kept in the cache of `native`."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.codegen.compiler import cached, identity, link

# What the exported CMakeLists.txt uses; without -march=native the library runs on any processor of its kind.
PORTABLE = ("-std=c99", "-O3", "-fno-math-errno", "-fno-trapping-math")
NATIVE = (*PORTABLE, "-march=native", "-ffp-contract=fast")


def library(folder: Path, flags: Sequence[str] = NATIVE, compiler: str | None = None) -> Path:
    """Compile the sources of a folder, unless the cache has them.

    Raises ProblemError without a compiler, and with the compiler's words when it fails.
    """
    compiler = compiler or next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    if compiler is None:
        raise ProblemError("no C compiler (cc, gcc, clang) was found: install one, or solve in Python.")
    sources = sorted(folder.glob("*.c"))
    texts = [path.read_text() for path in sorted([*sources, *folder.glob("*.h")])]
    options = [*flags, "-fPIC", "-shared"]
    try:
        return cached(
            folder.name or "controller",
            "\0".join([*texts, compiler, identity(compiler), *options]),
            lambda target: link(compiler, options, sources, target),
        )
    except subprocess.CalledProcessError as error:
        raise ProblemError(f"{compiler} could not compile {folder}{os.sep}*.c: {error.stderr}") from error
