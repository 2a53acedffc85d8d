"""Files that come with this package."""

from __future__ import annotations

from pathlib import Path

from kpirl_ocp.errors import ModelError


def iiwa_urdf() -> Path:
    """The URDF of the KUKA LBR iiwa 14: kinematics, limits and inertias, no meshes."""
    return Path(__file__).parent / "robots" / "iiwa.urdf"


def shipped_model(name: str) -> Path:
    """The card of a trained model that comes with the package: "detector", "reaching" or "placing".

    Raises ModelError if this installation has none.
    """
    card = Path(__file__).parent / "models" / f"{name}.json"
    if not card.exists():
        raise ModelError(f"{card} is not part of this installation: train the models with `make models`.")
    return card
