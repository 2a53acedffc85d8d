"""PyBullet without its greetings, which bypass Python's streams and would mix with a script's output."""

from __future__ import annotations

from kpirl_ocp.c_output import captured
from kpirl_ocp.errors import DependencyError

try:
    with captured(1, 2):
        import pybullet
        from pybullet_utils.bullet_client import BulletClient
except ImportError as error:
    raise DependencyError(
        'the simulated scene needs PyBullet: pip install "kpirl-ocp[perception]" on Python 3.11 or earlier '
        "(there are no wheels for later ones; pip install pybullet compiles it, for many minutes)."
    ) from error


def connect() -> BulletClient:
    """A new world without a window."""
    with captured(1, 2):
        return BulletClient(pybullet.DIRECT)
