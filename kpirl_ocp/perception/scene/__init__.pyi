from .camera import Camera
from .hand import HandScene, placing_path, wandering_path
from .posture import UPRIGHT, inverse_kinematics
from .scene import JointState, Motors, Scene
from .world import Frame, World

__all__ = [
    "UPRIGHT",
    "Camera",
    "Frame",
    "HandScene",
    "JointState",
    "Motors",
    "Scene",
    "World",
    "inverse_kinematics",
    "placing_path",
    "wandering_path",
]
