"""`kpirl COMMAND OPTIONS`: reads and checks the options, then imports and does the work.

Exit codes: 0, 1 for a result that is not what was asked for, 2 for wrong input, 130 after Ctrl-C.
"""

from __future__ import annotations

import argparse
import contextlib
import inspect
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path

from kpirl_ocp.cli.parser import Parser, build_parser, write_config
from kpirl_ocp.errors import DependencyError, KpirlError, OptionError
from kpirl_ocp.spelling import suggestion
from kpirl_ocp.version import __version__

COMMANDS = (
    "solve",
    "demonstrate",
    "learn",
    "learn-video",
    "evaluate",
    "compare",
    "export",
    "demo",
    "collect",
    "train-keypoints",
    "train-robust",
    "train-dynamics",
)
EXTRAS = dict.fromkeys(("av", "cv2", "pybullet", "torch"), "perception") | {"onnx": "onnx", "rerun": "rerun"}
USAGE = """usage: kpirl COMMAND [OPTIONS]

Learn a cost over keypoints from demonstrations, and plan with it.

commands:
{commands}

`kpirl COMMAND --help` lists the options of a command; `kpirl --version` the version."""


def main(words: Sequence[str] | None = None) -> None:
    """The console script; `words` default to those of the command line. Exits."""
    sys.exit(run(sys.argv[1:] if words is None else words))


def script(command: str) -> None:
    """A command with the options of this process's command line. Exits."""
    main([command, *sys.argv[1:]])


def run(words: Sequence[str]) -> int:
    """Run a command line and give the exit code; an error that the user can mend is one line on stderr."""
    try:
        return _dispatch(list(words))
    except (KpirlError, OSError) as error:
        print(f"error: {_sentence(error)}", file=sys.stderr)
        return 2


def _dispatch(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help"):
        print(usage())
        return 0
    if words[0] == "--version":
        print(f"kpirl {__version__}")
        return 0
    command = words[0]
    if command not in COMMANDS:
        raise OptionError(f"there is no command {command!r}{suggestion(command, COMMANDS)} (see `kpirl --help`)")
    parser = build_parser(command, options_of(command))
    try:
        args = parser.read(words[1:])
    except SystemExit:  # after --help
        return 0
    return _work(command, parser, args)


def options_of(command: str):  # type: ignore[no-untyped-def]
    """The module with the options of a command."""
    return _module("options", command)


def _module(room: str, command: str):  # type: ignore[no-untyped-def]
    return import_module(f"kpirl_ocp.cli.{room}.{command.replace('-', '_')}")


def usage() -> str:
    """All commands with the first line of their help."""
    lines = [f"  {name:<16}{(inspect.getdoc(options_of(name)) or '').splitlines()[0]}" for name in COMMANDS]
    return USAGE.format(commands="\n".join(lines))


def _work(command: str, parser: Parser, args: argparse.Namespace) -> int:
    prepare_directory(args.out)
    with _hushed(args.quiet):
        try:
            code, stopped = _module("commands", command).main(args) or 0, None
        except KeyboardInterrupt as stop:
            code, stopped = 130, str(stop) or "nothing was saved"
        except ModuleNotFoundError as error:
            raise _missing(command, error) from error
    write_config(args.out / "config.yaml", parser, args)
    if stopped:
        print(f"interrupted: {stopped}.", file=sys.stderr)
    return code


def _missing(command: str, error: ModuleNotFoundError) -> Exception:
    package = (error.name or "").split(".")[0]
    if package not in EXTRAS:
        return error
    return DependencyError(
        f'`kpirl {command}` needs {package}, which is not installed: pip install "kpirl-ocp[{EXTRAS[package]}]"'
    )


def prepare_directory(path: Path) -> None:
    """Make a directory for results. Raises OptionError if nothing can be written there."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise OptionError(f"--out: cannot write to {str(path)!r}: {error.strerror}") from error


@contextlib.contextmanager
def _hushed(quiet: bool) -> Iterator[None]:
    """Without tables and progress bars, if `quiet`."""
    if not quiet:
        yield
        return
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
        yield


def _sentence(error: BaseException) -> str:
    text = str(error)
    return text if text.endswith((".", "?", ")")) else f"{text}."
