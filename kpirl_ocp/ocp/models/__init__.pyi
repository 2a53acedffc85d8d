from .dynamics_files import load_dynamics
from .graph_network import GraphNetwork
from .keypoint_costs import RBF, Basis, Default, KeypointCost, TimeDependent, Weighted
from .keypoint_dynamics import NetworkDynamics
from .keypoint_problems import keypoint_ocp, keypoint_state, network_ocp
from .mlp import MLP
from .onnx.load import load_onnx
from .pinhole import Pinhole
from .robot import Keypoint, Robot

__all__ = [
    "MLP",
    "RBF",
    "Basis",
    "Default",
    "GraphNetwork",
    "Keypoint",
    "KeypointCost",
    "NetworkDynamics",
    "Pinhole",
    "Robot",
    "TimeDependent",
    "Weighted",
    "keypoint_ocp",
    "keypoint_state",
    "load_dynamics",
    "load_onnx",
    "network_ocp",
]
