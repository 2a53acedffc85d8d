"""Machine code of a problem's functions: when it is made, and where it comes from.

CasADi's virtual machine and tapes evaluate functions without a compiler, machine code does it several times faster,
equal to the last bit, since none of them contracts or reorders operations. So a solve need not know what it runs on,
and a compiler may work in the background: it starts once a problem has been evaluated often enough to show that it will
be used. Large networks get faster kernels that round differently, so they are compiled before the first solve, or
never.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Literal, NamedTuple

import casadi as ca

from kpirl_ocp.errors import CompilerError
from kpirl_ocp.ocp.codegen import compiler
from kpirl_ocp.ocp.codegen.kernels import with_fast_kernels, with_ordered_kernels
from kpirl_ocp.ocp.codegen.library_cache import place, sound
from kpirl_ocp.ocp.codegen.numpy_calls import Build, worth_compiling
from kpirl_ocp.ocp.interior_point.horizon_functions import horizon_functions
from kpirl_ocp.ocp.interior_point.library import address_in
from kpirl_ocp.ocp.interior_point.stage_functions import stage_functions
from kpirl_ocp.ocp.problem.ocp import OCP

Compile = bool | Literal["auto"]


class Recipe(NamedTuple):
    """A way from generated C to machine code: flags of the compiler, and a rewriting of the source."""

    flags: Sequence[str]
    rewrite: Callable[[str], str]


# -O1 gives nearly all of -O2 for straight-line code, in a tenth of the time.
STRAIGHT = Recipe(("-O1", "-ffp-contract=off", "-fno-math-errno", "-Wno-int-conversion", "-fPIC", "-shared"), str)
ORDERED = Recipe((*compiler.FLAGS, "-ffp-contract=off"), with_ordered_kernels)
FAST = Recipe(compiler.FLAGS, with_fast_kernels)
_OFTEN = 20_000  # evaluations of a stage after which a compiler is worth starting
_LONG = 3_000  # operations whose compilation takes about a second


class MachineCode:
    """The functions of one problem as a shared library, once there is one. Shared by all threads."""

    def __init__(self, functions: Sequence[ca.Function], recipe: Recipe) -> None:
        self._functions, self._recipe = list(functions), recipe
        self._path: Path | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._addresses: dict[str, int] | None = None
        self._given_up = False
        self._lock = threading.Lock()  # of `begin`

    def addresses(self) -> dict[str, int] | None:
        """The functions' addresses by name if the library is there; never waits."""
        if self._addresses is None and self._path is not None and self._path.exists():
            self._addresses = self._load(self._path)
        return self._addresses

    def _load(self, path: Path) -> dict[str, int] | None:
        try:
            if sound(path):
                library = ctypes.CDLL(str(path))
                return {f.name(): address_in(library, f.name()) for f in self._functions}
        except FileNotFoundError:  # removed by another process
            return None
        except (OSError, AttributeError):
            pass
        path.unlink(missing_ok=True)
        self._give_up(f"the compiler made a library {path} that cannot be loaded")
        return None

    def begin(self) -> None:
        """Start a compiler in the background, unless the library is there or on its way."""
        with self._lock:
            if self._path is None and not self._given_up:
                self._begin()

    def _begin(self) -> None:
        command = compiler.find_compiler()
        if command is None:
            self._given_up = True
            return
        flags, source = self._recipe.flags, self._source()
        try:
            path = place("stages", "\0".join([source, command, compiler.identity(command), *flags]))
        except (OSError, CompilerError) as error:
            self._give_up(f"{command} cannot be used ({error})")
            return
        if not _there(path):
            self._process = _start(command, flags, source, path)
        self._path = path  # last: other threads look for the library from now on

    def wait(self) -> None:
        """Until the library is there, or cannot be made; a long wait is announced."""
        self.begin()
        process = self._process
        if process is None:
            return
        operations = sum(f.n_instructions() for f in self._functions)
        if process.poll() is None and operations > _LONG:
            print(f"compiling {operations} operations of {self._functions[0].name()} (once) ...", file=sys.stderr)
        if process.wait():
            self._give_up(f"the compiler could not make {self._path}")

    def _give_up(self, reason: str) -> None:
        self._given_up, self._path, self._process = True, None, None
        compiler.warn_slow(reason)

    def _source(self) -> str:
        generator = ca.CodeGenerator("stages.c")
        for function in self._functions:
            generator.add(function)
        return self._recipe.rewrite(generator.dump())


def _there(library: Path) -> bool:
    """Whether a library is in the cache; what is not sound is removed."""
    with contextlib.suppress(FileNotFoundError):
        if sound(library):
            return True
        library.unlink()
    return False


# Seals the library as `library_cache.seal` does, and goes on when this process has ended.
_SCRIPT = """
folder=$1; target=$2; patience=$3; shift 3; trap 'rm -rf "$folder"' EXIT
timeout -k 1 "$patience" "$@" && digest=$(sha256sum < "$0") && printf %s "${digest%% *}" >> "$0" &&
chmod 700 "$0" && mv "$0" "$target"
"""


def _start(command: str, flags: Sequence[str], source: str, library: Path) -> subprocess.Popen[bytes]:
    """Compile beside the target and rename: whoever looks sees the whole library or none."""
    folder = tempfile.mkdtemp(dir=library.parent)
    code, built = Path(folder) / "code.c", Path(folder) / "built.so"
    code.write_text(source)
    arguments = [str(built), folder, str(library), f"{compiler.PATIENCE:g}"]
    words = [command, *flags, str(code), "-o", str(built), "-lm"]
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen(["sh", "-c", _SCRIPT, *arguments, *words], **silent)  # type: ignore[call-overload]


@lru_cache(maxsize=64)
def machine_code(problem: OCP) -> MachineCode:
    """That of a problem's stage functions, or of its functions of the whole horizon."""
    if problem.derivatives is None:
        return MachineCode(stage_functions(problem).all, STRAIGHT)
    functions = horizon_functions(problem)
    return MachineCode([*functions.horizon, functions.dynamics], FAST if worth_compiling(problem) else ORDERED)


@lru_cache(maxsize=256)
def _machine_code_of(problem: OCP, build: Build) -> MachineCode:
    """That of a function of the problem on its own."""
    return MachineCode([build(problem)], STRAIGHT if problem.derivatives is None else ORDERED)


def _forget() -> None:
    """Begin anew in a forked process, where a lock may have been held."""
    machine_code.cache_clear()
    _machine_code_of.cache_clear()


os.register_at_fork(after_in_child=_forget)


def prepare_function(problem: OCP, build: Build, wish: Compile, evaluations: int) -> int | None:
    """The address of machine code for `build(problem)`; None for the virtual machine, or where that calls a library.

    evaluations: of stages so far.
    """
    if wish is False or worth_compiling(problem):
        return None
    code = _machine_code_of(problem, build)
    if wish is True:
        code.wait()
    elif evaluations > _OFTEN:
        code.begin()
    addresses = code.addresses()
    return None if addresses is None else next(iter(addresses.values()))


def prepare(problem: OCP, wish: Compile, evaluations: int) -> dict[str, int] | None:
    """Addresses of machine code to solve with now; None to do without.

    evaluations: of stages so far. See the module for the decision that "auto" stands for.
    """
    if wish is False:
        return None
    code = machine_code(problem)
    if wish is True or (problem.derivatives is not None and worth_compiling(problem)):
        code.wait()
    elif evaluations > _OFTEN:
        code.begin()
    return code.addresses()
