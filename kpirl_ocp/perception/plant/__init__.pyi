from .camera_plant import CameraPlant, Disturbance
from .starts import PlacingStarts, placing_starts

__all__ = [
    "CameraPlant",
    "Disturbance",
    "PlacingStarts",
    "placing_starts",
]
