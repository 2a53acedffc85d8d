"""The system's C compiler.

`compiled` turns a CasADi function into machine code; without a compiler it returns the function itself (CasADi's
virtual machine), with one warning for the process. `compile_folder` compiles the C of an exported solver. Libraries are
kept in `library_cache`.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
import warnings
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path

import casadi as ca

from kpirl_ocp.errors import CompilerError, FileError
from kpirl_ocp.ocp.codegen.kernels import with_fast_kernels
from kpirl_ocp.ocp.codegen.library_cache import cached, seal, sound

# No -ffast-math: NaN must stay NaN, so that it can be detected, and sums keep their order. The -fno flags only promise
# that nobody reads errno or traps floating-point exceptions; with them loops become vector instructions. CasADi writes
# 0 + i*0 for the address of an empty array, which newer compilers refuse without -Wno-int-conversion. Loops are turned
# into vector instructions as with -O3, which takes longer to compile and gains nothing more.
_OPTIMISED = ("-O2", "-ftree-vectorize", "-fvect-cost-model=dynamic", "-march=native")
FLAGS = (
    *_OPTIMISED,
    "-fno-semantic-interposition",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-Wno-int-conversion",
    "-fPIC",
    "-shared",
)
# Those of the exported CMakeLists.txt, for any processor of its kind; and for this one alone.
EXPORT_FLAGS = ("-std=c99", "-O3", "-fno-math-errno", "-fno-trapping-math")
EXPORT_FLAGS_NATIVE = (*EXPORT_FLAGS, "-march=native", "-ffp-contract=fast")
PATIENCE = 600.0  # [s] after which a compiler is taken to hang


def compiled(function: ca.Function) -> ca.Function:
    """A function as machine code; the function itself when there is no C compiler."""
    return compile_all([function])[0]


def compile_all(functions: Sequence[ca.Function]) -> list[ca.Function]:
    """Several functions as machine code, their common parts compiled once; without a C compiler, as they are.

    Results must overlap neither each other nor the arguments (`kpirl_ocp.ocp.codegen.rewriting.copy_elision`).
    """
    command = compiler()
    if command is None:
        return list(functions)
    name = functions[0].name()
    generator = ca.CodeGenerator(f"{name}.c")
    for function in functions:
        generator.add(function)
    source = with_fast_kernels(generator.dump())
    for _ in range(2):  # another process may remove the library before it is loaded
        try:
            library = _library(command, name, source)
        except (OSError, CompilerError) as error:
            warn_slow(f"{command} could not compile {name} ({_first_line(error)})")
            return list(functions)
        try:
            return [ca.external(function.name(), str(library)) for function in functions]
        except RuntimeError:
            if library.exists():
                library.unlink()
                warn_slow(f"{command} made a library of {name} that cannot be loaded")
                return list(functions)
    warn_slow(f"other processes keep removing {library}")
    return list(functions)


def _first_line(error: OSError | CompilerError) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


def _library(compiler: str, name: str, source: str) -> Path:
    """The shared library of a C source: from the cache, marked as used, or built."""
    key = "\0".join([source, compiler, identity(compiler), *FLAGS])
    return cached(name, key, lambda library: _build(compiler, source, library))


def compile_folder(folder: Path, flags: Sequence[str], compiler: str | None, names: Iterable[str]) -> Path:
    """Compile the C of a folder to a shared library, unless the cache has it.

    Args:
        folder: holds the sources and headers.
        flags: of the compiler, in addition to those for a shared library.
        compiler: its command; None for the system's.
        names: of the folder's files; the sources and headers at its top level are compiled.

    Raises:
        CompilerError: there is no compiler, or it fails; then with its message.
        FileError: a file cannot be read.
    """
    compiler = compiler or find_compiler()
    if compiler is None:
        raise CompilerError("no C compiler (cc, gcc, clang) was found: install one, or solve in Python.")
    paths = [folder / name for name in sorted(names) if Path(name).name == name]
    sources = [path for path in paths if path.suffix == ".c"]
    try:
        texts = [path.read_text() for path in paths if path.suffix in (".c", ".h")]
    except OSError as error:
        raise FileError(f"{error.filename} belongs to {folder} and cannot be read: export it again.") from error
    options = [*flags, "-fPIC", "-shared"]
    key = "\0".join([*texts, compiler, identity(compiler), *options])
    try:
        return cached(folder.name or "controller", key, lambda target: link(compiler, options, sources, target))
    except CompilerError as error:
        raise CompilerError(f"{compiler} could not compile {folder}{os.sep}*.c: {error}") from error


def find_compiler() -> str | None:
    """The path of the system's C compiler; None if there is none."""
    return next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)


@lru_cache(maxsize=1)
def compiler() -> str | None:
    """`find_compiler`, with a warning if there is none; called once in a process."""
    path = find_compiler()
    if path is None:
        warn_slow("no C compiler (cc, gcc, clang) was found")
    return path


def warn_slow(reason: str) -> None:
    """Warn that functions run without machine code, for a reason."""
    consequence = "this runs on CasADi's virtual machine, with the same results, several times slower."
    warnings.warn(f"{reason}: {consequence}", RuntimeWarning, stacklevel=3)


@lru_cache(maxsize=4)
def identity(compiler: str) -> str:
    """A compiler's version and the processor that -march=native means: a cache on a shared disk must not mix them."""
    return _run([compiler, "-march=native", "-E", "-dM", "-x", "c", os.devnull])


def _run(command: Sequence[str]) -> str:
    """Output of a compiler.

    Raises:
        CompilerError: it fails, then with its message; or it hangs, then it is killed with its child processes.
    """
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = subprocess.Popen(command, **pipes, text=True, start_new_session=True)  # type: ignore[call-overload]
    try:
        printed, errors = process.communicate(timeout=PATIENCE)
    except BaseException as error:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        if isinstance(error, subprocess.TimeoutExpired):
            raise CompilerError(f"{command[0]} did not end within {PATIENCE:g} s.") from error
        raise
    if process.returncode:
        raise CompilerError(errors or f"{command[0]} ended with exit code {process.returncode}.")
    return str(printed)


def _build(compiler: str, source: str, library: Path) -> None:
    """Compile one source."""
    with tempfile.TemporaryDirectory() as scratch:
        code = Path(scratch) / "code.c"
        code.write_text(source)
        link(compiler, FLAGS, [code], library)


def link(compiler: str, flags: Sequence[str], sources: Sequence[Path], library: Path) -> None:
    """Compile next to the target, then rename: another process sees the whole library or none.

    Raises:
        CompilerError: the compiler fails, hangs, or writes no sound library.
    """
    library.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent) as scratch:
        built = Path(scratch) / "built.so"
        _run([compiler, *flags, *map(str, sources), "-o", str(built), "-lm"])
        if built.exists():
            seal(built)
        if not built.exists() or not sound(built):
            raise CompilerError(f"{compiler} wrote no shared library.")
        built.replace(library)
