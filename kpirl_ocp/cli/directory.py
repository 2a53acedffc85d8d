"""The directory for the results of a run: it must be writable, and is locked against other runs."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from kpirl_ocp.errors import OptionError

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextlib.contextmanager
def results_in(path: Path) -> Iterator[None]:
    """A context in which results are written to a directory: it is created if missing, and locked against other runs.

    Raises OptionError if it is not writable, if another run has locked it, or if the disk is full when results are
    written.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path) as file:
            file.write(b"0")
    except FileExistsError as error:
        raise OptionError(f"--out: {str(path)!r} is a file, and not a directory") from error
    except OSError as error:
        raise _unwritable(path, error) from error
    with _held(path):
        try:
            yield
        except OSError as error:
            if error.errno not in _FULL:
                raise
            raise _unwritable(path, error) from error


def _unwritable(path: Path, error: OSError) -> OptionError:
    return OptionError(f"--out: cannot write to {str(path)!r}: {error.strerror}")


@contextlib.contextmanager
def _held(path: Path) -> Iterator[None]:
    """Lock a directory, if the file system has locks; the lock ends with this process, even if it is killed."""
    place = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(place, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(place)
        raise OptionError(
            f"--out: another run is writing to {str(path)!r}: wait for its end, or choose another directory"
        ) from None
    except OSError:  # no locks there
        pass
    try:
        yield
    finally:
        os.close(place)
