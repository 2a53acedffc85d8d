from .augmentation import augmented, backwards
from .model import ACTIVATIONS, DynamicsModel
from .training import DynamicsScores, DynamicsSettings, score_dynamics, train_dynamics

__all__ = [
    "ACTIVATIONS",
    "DynamicsModel",
    "DynamicsScores",
    "DynamicsSettings",
    "augmented",
    "backwards",
    "score_dynamics",
    "train_dynamics",
]
