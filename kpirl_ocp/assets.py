"""Files that come with other packages, found without importing them."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from kpirl_ocp.errors import RobotError


def iiwa_urdf() -> Path:
    """The URDF of the KUKA LBR iiwa in `pybullet_data`. Raises RobotError if that package is not installed."""
    spec = importlib.util.find_spec("pybullet_data")
    if spec is None or spec.origin is None:
        raise RobotError("the iiwa's URDF is in the package pybullet_data: pip install pybullet.")
    return Path(spec.origin).parent / "kuka_iiwa" / "model.urdf"
