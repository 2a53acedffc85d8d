from .asynchronous_plant import AsynchronousPlant
from .camera_plant import CameraPlant, Disturbance
from .starts import PlacingStarts, placing_starts

__all__ = [
    "AsynchronousPlant",
    "CameraPlant",
    "Disturbance",
    "PlacingStarts",
    "placing_starts",
]
