"""PyBullet without its greetings, which bypass Python's streams and would mix with a script's output."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager

from kpirl_ocp.errors import DependencyError


@contextmanager
def _quiet() -> Iterator[None]:
    """Discard the output of C code to the process's standard streams."""
    library = ctypes.CDLL(None)
    library.fflush(None)
    kept = os.dup(1), os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        yield
        library.fflush(None)
    finally:
        os.dup2(kept[0], 1)
        os.dup2(kept[1], 2)
        for descriptor in (*kept, nowhere):
            os.close(descriptor)


try:
    with _quiet():
        import pybullet
        from pybullet_utils.bullet_client import BulletClient
except ImportError as error:
    raise DependencyError(
        'the simulated scene needs PyBullet: pip install "kpirl-ocp[perception]" on Python 3.11 or earlier '
        "(there are no wheels for later ones; pip install pybullet compiles it, for many minutes)."
    ) from error


def connect() -> BulletClient:
    """A new world without a window."""
    with _quiet():
        return BulletClient(pybullet.DIRECT)
