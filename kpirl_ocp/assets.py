"""Files that come with this package or with others, found without importing them."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from kpirl_ocp.errors import ModelError, RobotError


def iiwa_urdf() -> Path:
    """The URDF of the KUKA LBR iiwa in `pybullet_data`. Raises RobotError if that package is not installed."""
    spec = importlib.util.find_spec("pybullet_data")
    if spec is None or spec.origin is None:
        raise RobotError("the iiwa's URDF is in the package pybullet_data: pip install pybullet.")
    return Path(spec.origin).parent / "kuka_iiwa" / "model.urdf"


def shipped_model(name: str) -> Path:
    """The card of a trained model that comes with the package: "detector", "reaching" or "placing".

    Raises ModelError if this installation has none.
    """
    card = Path(__file__).parent / "models" / f"{name}.json"
    if not card.exists():
        raise ModelError(f"{card} is not part of this installation: train the models with `make models`.")
    return card
