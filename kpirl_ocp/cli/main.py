"""`kpirl COMMAND OPTIONS`: reads and checks the options, then imports and does the work.

Exit codes: 0 for success, 1 for a result that misses its target, 2 for wrong input, 130 after Ctrl-C or SIGTERM,
141 if the reader of the output has gone (as after `| head`).
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import inspect
import os
import select
import signal
import sys
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from pathlib import Path

from kpirl_ocp.cli.directory import results_in
from kpirl_ocp.cli.memory import within_memory
from kpirl_ocp.cli.parser import Parser, build_parser, write_config
from kpirl_ocp.cli.signals import stoppable
from kpirl_ocp.errors import DependencyError, KpirlError, OptionError, missing, suggestion
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
USAGE = """usage: kpirl COMMAND [OPTIONS]

Learn a cost over keypoints from demonstrations, and plan with it.

commands:
{commands}

`kpirl COMMAND --help` lists the options of a command; `kpirl --version` the version."""


def main(words: Sequence[str] | None = None) -> None:
    """The console script; `words` default to those of the command line. Exits."""
    _search_garbage_less_often()
    sys.exit(run(sys.argv[1:] if words is None else words))


def script(command: str) -> None:
    """A command with the options of this process's command line. Exits."""
    main([command, *sys.argv[1:]])


def experiment(description: str, add_options: Callable[[Parser], None], module: str) -> None:
    """Run a script of this repository: parse its options, then call `main(args)` of a module. Exits.

    The module is imported only after the options have been checked.
    """
    _search_garbage_less_often()
    parser = build_parser(Path(sys.argv[0]).name, description, add_options)
    sys.exit(_with_sentences(lambda: _read_and_work(parser, sys.argv[1:], module)))


def _search_garbage_less_often() -> None:
    """Imports make a hundred thousand objects that stay: they are not searched again and again, nor before the end."""
    gc.set_threshold(10_000, 20, 20)
    atexit.register(gc.freeze)


def run(words: Sequence[str]) -> int:
    """Run a command line and return the exit code; errors that a user can correct are printed as one line on stderr."""
    return _with_sentences(lambda: _dispatch(list(words)))


def _with_sentences(work: Callable[[], int]) -> int:
    with stoppable():
        try:
            code = work()
            sys.stdout.flush()
            return code
        except (KpirlError, OSError) as error:
            if isinstance(error, BrokenPipeError) and _nobody_reads():
                return 128 + signal.SIGPIPE
            print(f"error: {_sentence(error)}", file=sys.stderr)
            return 2
        except KeyboardInterrupt as stop:
            exec("")  # Python forgets that Ctrl-C passed an `exec`, as in dataclass(): else it would end as if killed
            print(f"\ninterrupted: {stop}." if str(stop) else "\ninterrupted.", file=sys.stderr)
            return 130


def _nobody_reads() -> bool:
    """True if the reader of stdout has gone, as after `| head`; stdout is then redirected to /dev/null."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    gone = any(event & select.POLLERR for _, event in poll.poll(0))
    if gone:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return gone


def _dispatch(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help"):
        print(usage())
        return 0
    if words[0] == "--version":
        print(f"kpirl {__version__}")
        return 0
    command = words[0]
    if command not in COMMANDS:
        near = suggestion(command, (*COMMANDS, "--version", "--help"))
        raise OptionError(f"there is no command {command!r}{near} (see `kpirl --help`)")
    options = options_of(command)
    parser = build_parser(f"kpirl {command}", inspect.getdoc(options) or "", options.add_options)
    return _read_and_work(parser, words[1:], _module_name("commands", command))


def options_of(command: str):  # type: ignore[no-untyped-def]
    """The module with the options of a command."""
    return import_module(_module_name("options", command))


def _module_name(room: str, command: str) -> str:
    return f"kpirl_ocp.cli.{room}.{command.replace('-', '_')}"


def usage() -> str:
    """All commands with the first line of their help."""
    lines = [f"  {name:<16}{(inspect.getdoc(options_of(name)) or '').splitlines()[0]}" for name in COMMANDS]
    return USAGE.format(commands="\n".join(lines))


def _read_and_work(parser: Parser, words: list[str], module: str) -> int:
    try:
        args = parser.read(words)
    except SystemExit:  # after --help
        return 0
    with results_in(args.out):
        return _work(parser, args, module)


def _work(parser: Parser, args: Namespace, module: str) -> int:
    code, stopped = 0, ""
    try:
        with _hushed(args.quiet), within_memory():
            code = import_module(module).main(args) or 0
    except ImportError as error:
        raise _named(parser.prog, error) from error
    except KeyboardInterrupt as stop:
        stopped = str(stop) or "nothing was saved"
    write_config(args.out / "config.yaml", parser, args)  # when the exception no longer keeps workers alive
    if stopped:
        raise KeyboardInterrupt(stopped)
    return int(code)


def _named(program: str, error: ImportError) -> Exception:
    """An error that names the program, and not the function in it, if an extra is missing."""
    cause = error.__cause__ or error
    said = missing(f"`{program}`", cause) if isinstance(cause, ModuleNotFoundError) else error
    return said if isinstance(said, DependencyError) else error


@contextlib.contextmanager
def _hushed(quiet: bool) -> Iterator[None]:
    """A context without output to stdout and stderr, if `quiet`."""
    if not quiet:
        yield
        return
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
        yield


def _sentence(error: BaseException) -> str:
    text = str(error)
    return text if text.endswith((".", "?", ")")) else f"{text}."
