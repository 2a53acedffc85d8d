"""Output of C code, which bypasses Python's streams and would mix with a program's own."""

from __future__ import annotations

import contextlib
import ctypes
import os
import threading
from collections.abc import Iterator

_ONE_AT_A_TIME = threading.Lock()  # the descriptors are the process's


@contextlib.contextmanager
def captured(*descriptors: int) -> Iterator[list[str]]:
    """A block whose output to these descriptors (1, 2) becomes the lines of a list when it ends."""
    library, lines = ctypes.CDLL(None), list[str]()
    with _ONE_AT_A_TIME, open(os.memfd_create("output"), "w+b") as file:
        library.fflush(None)
        kept = {descriptor: _copy(descriptor) for descriptor in descriptors}
        try:
            for descriptor in descriptors:
                os.dup2(file.fileno(), descriptor)
            yield lines
        finally:
            library.fflush(None)
            for descriptor, copy in kept.items():
                _restore(descriptor, copy)
            file.seek(0)
            lines += file.read().decode(errors="replace").splitlines()


def _copy(descriptor: int) -> int | None:
    """None for a descriptor that is closed, as in a daemon."""
    try:
        return os.dup(descriptor)
    except OSError:
        return None


def _restore(descriptor: int, copy: int | None) -> None:
    if copy is None:
        os.close(descriptor)
    else:
        os.dup2(copy, descriptor)
        os.close(copy)
