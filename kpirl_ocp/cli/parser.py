"""The parser of every subcommand: common options, options from a file, and error messages of one sentence."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import yaml

from kpirl_ocp.cli.sentences import of_option
from kpirl_ocp.cli.values import directory, existing_file
from kpirl_ocp.errors import OptionError, suggestion
from kpirl_ocp.sizes import read_text

_COMMON = ("config", "quiet", "help")


class Parser(argparse.ArgumentParser):
    """argparse with numbers like -1e-3 as values, no abbreviations, and `OptionError` instead of an exit."""

    def __init__(self, prog: str, description: str) -> None:
        super().__init__(
            prog=prog,
            description=description,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        self._negative_number_matcher = re.compile(r"-(\.?\d|inf|nan)")

    @property
    def command(self) -> str:
        """The name of the subcommand, or of the script."""
        return self.prog.split()[-1]

    def error(self, message: str) -> NoReturn:
        """Raise OptionError with argparse's message, in one sentence."""
        raise OptionError(re.sub(r"^argument ", "", message))

    def options(self) -> dict[str, argparse.Action]:
        """Options and positional arguments by name, without --config, --quiet and --help."""
        return {action.dest: action for action in self._actions if action.dest not in _COMMON}

    def read(self, words: Sequence[str]) -> argparse.Namespace:
        """The options of a command line; its --config file and then the defaults supply those not given.

        Raises:
            OptionError: an option is unknown, or a value is not accepted.
        """
        self._know(words)
        config = self._config_of(words)
        if config is not None:
            with of_option("--config"):
                self._adopt(config)
        return self.parse_args(words)

    def _know(self, words: Sequence[str]) -> None:
        """Raise OptionError, suggesting the nearest option, for an option that does not exist."""
        known = list(self._option_string_actions)
        for word in words:
            name = word.split("=")[0]
            if name.startswith("--") and len(name) > 2 and name not in known:
                raise OptionError(f"there is no option {name}{suggestion(name, known)}")

    def _config_of(self, words: Sequence[str]) -> Path | None:
        finder = Parser(self.prog, "")
        finder.add_argument("--config", type=existing_file)
        return finder.parse_known_args([word for word in words if word not in ("-h", "--help")])[0].config

    def _adopt(self, config: Path) -> None:
        """Make the values of a file defaults; they are parsed like words of a command line, with the same checks."""
        options, words, given = self.options(), [], {}
        for name, value in read_config(config).items():
            if name == "command" and value != self.command:
                raise OptionError(f"{config} has the options of {value}, not of {self.command}")
            dest = str(name).replace("-", "_")
            if name != "command" and dest not in options:
                raise OptionError(f"{config}: there is no option {name!r}{suggestion(dest, options)}")
            if name != "command" and value is not None:
                given[dest] = options[dest]
                words += _words(options[dest], value, f"{config}: {name!r}")
        required = [action for action in options.values() if action.required]
        for action in required:
            action.required = False
        try:
            parsed = self.parse_args(words)
        except OptionError as error:
            raise OptionError(f"{config}: {error}") from error
        for action in required:
            action.required = action.dest not in given
        self.set_defaults(**{dest: getattr(parsed, dest) for dest in given})


def _words(action: argparse.Action, value: Any, place: str) -> list[str]:
    """The command-line words that set an option to a value. place: where the value is, for error messages."""
    name = list(action.option_strings[-1:])
    if action.nargs == 0 and not isinstance(value, bool):
        raise OptionError(f"{place} must be true or false, got {value!r}")
    if action.nargs in (None, "?") and isinstance(value, list):
        raise OptionError(f"{place} must be one value, got {value!r}")
    if action.nargs == 0:
        return name if value else []
    return name + [str(item) for item in (value if isinstance(value, list) else [value])]


def build_parser(program: str, description: str, add_options: Callable[[Parser], None]) -> Parser:
    """The parser of a program, with its own options and the common ones."""
    parser = Parser(program, description)
    add_options(parser)
    if "out" not in parser.options():
        place = Path("out") / Path(parser.command).stem
        parser.add_argument("--out", type=directory, default=place, help="directory (default: %(default)s)")
    parser.add_argument(
        "--config", type=existing_file, metavar="FILE.yaml", help="options; the command line takes precedence"
    )
    parser.add_argument("--quiet", action="store_true", help="print errors only")
    return parser


def read_config(path: Path) -> dict[str, Any]:
    """The options in a YAML file. Raises OptionError, naming it, if it is not a mapping."""
    try:
        content = yaml.safe_load(read_text(path))
    except (yaml.YAMLError, OSError, ValueError, RecursionError) as error:
        raise OptionError(f"{path} is not a YAML file: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise OptionError(f"{path} must be a mapping from options to values")
    for name, value in content.items():
        if any(isinstance(item, list | dict) for item in (value if isinstance(value, list) else [value])):
            raise OptionError(f"{path}: {name!r} must be one value or a list of values, and not nested")
    return content


def write_config(path: Path, parser: Parser, args: argparse.Namespace) -> Path:
    """Write the options that `args` holds, so that --config with this file repeats the call."""
    options = {name: _plain(getattr(args, name)) for name in parser.options() if name != "out"}
    path.write_text(yaml.safe_dump({"command": parser.command} | options, sort_keys=False))
    return path


def _plain(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value
