"""The exceptions of the toolkit: one small tree, every message names the fault and a remedy, such as a near name."""

import difflib
import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any

# The extra that brings an optional package.
EXTRAS = dict.fromkeys(("av", "cv2", "pybullet", "torch"), "perception")
EXTRAS |= {"jax": "jax", "onnx": "onnx", "rerun": "rerun", "viser": "viewer"}


def suggestion(word: str, known: Iterable[str]) -> str:
    """For messages: ": did you mean X?" with the nearest of the known names, in capitals or not, or nothing."""
    names = {name.casefold().lstrip("-"): name for name in known}
    near = difflib.get_close_matches(word.casefold().lstrip("-"), names, n=1)
    return f": did you mean {names[near[0]]!r}?" if near else ""


class KpirlError(Exception):
    """Base of every error this package raises on purpose."""


class OptionError(KpirlError, ValueError):
    """An option of a command is unknown, or its value is not accepted."""


class RobotError(KpirlError, ValueError):
    """A robot description cannot be used: unreadable file, unknown link or joint type."""


class ProblemError(KpirlError, ValueError):
    """An optimal-control problem or an argument is inconsistent, or does not fit the solver or method it is for."""


class SceneError(KpirlError, ValueError):
    """The simulated scene cannot carry out a request: a posture out of reach or limits, an unknown link or rate."""


class FileError(KpirlError, ValueError):
    """A file or folder is missing, malformed or belongs to something else; the message names it."""


class EpisodeError(FileError):
    """An episode on disk is missing, malformed or not finite; the message names file and key."""


class DemonstrationError(KpirlError, ValueError):
    """A demonstration cannot be learned from: nothing moves, it jumps, is not seen for sure, or is out of reach."""


class ModelError(FileError):
    """A network on disk is missing, malformed or of an unsupported kind; the message names file and key."""


class DependencyError(KpirlError, ImportError):
    """An optional package is not installed; the message says how to install it."""


class ResourceError(KpirlError, RuntimeError):
    """A command would take more memory than the machine has."""


class CompilerError(KpirlError, RuntimeError):
    """There is no C compiler, or it refused the generated code; the message holds its words."""


class TrainingError(KpirlError, RuntimeError):
    """A network cannot be trained or scored: settings or data do not allow it, or the loss became NaN."""


class SolveError(KpirlError, RuntimeError):
    """A solve failed and the caller asked for an exception (`Solution.raise_if_failed`)."""


class CertificateError(KpirlError, RuntimeError):
    """A gradient could not be certified under the policy "raise".

    Attributes:
        certificate: the failed certificate, with every quantity that was measured.
    """

    def __init__(self, message: str, certificate: object) -> None:
        super().__init__(message, certificate)  # both are kept in `args`, from which pickle builds the copy
        self.certificate = certificate

    def __str__(self) -> str:
        return str(self.args[0])


def missing(name: str, error: ModuleNotFoundError, extras: Mapping[str, str] = EXTRAS) -> Exception:
    """A DependencyError for what cannot be had; the error itself if it is no optional package that is not installed.

    name: of what needs the package. extras: package -> extra.
    """
    package = str(error.name).partition(".")[0]
    if package not in extras:
        return error
    remedy = f'pip install "kpirl-ocp[{extras[package]}]"'
    if extras[package] == "perception" and sys.version_info >= (3, 12):
        remedy += "; the simulated camera, which is part of it, needs Python 3.11 or 3.10"
    if package == "pybullet" and sys.version_info >= (3, 12):
        remedy = "it has no wheels for Python 3.12 and later, make an environment with Python 3.11 or 3.10"
    return DependencyError(f"{name} needs {package}, which is not installed: {remedy}.")


def naming_extras(imported: Callable[[str], Any], extras: Mapping[str, str] = EXTRAS) -> Callable[[str], Any]:
    """`__getattr__` of a package whose names need optional packages; raises DependencyError where one is missing.

    imported: gives a name of the package, and imports what it needs. extras: optional package -> extra.
    """

    def named(name: str) -> Any:
        try:
            return imported(name)
        except ModuleNotFoundError as error:
            raise missing(name, error, extras) from error

    return named
