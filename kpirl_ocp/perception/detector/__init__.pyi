from .autoencoder import KeypointAutoencoder
from .detector import KeypointDetector
from .evaluation import DetectorScores, score
from .keypoints import to_pixels
from .losses import LossWeights
from .track_images import contact_sheet, image_strips, keypoint_paths, track_video, with_tracks
from .tracks import detect_tracks
from .training import PRESETS, TERMS, DetectorSettings, Trained, train_detector

__all__ = [
    "PRESETS",
    "TERMS",
    "DetectorScores",
    "DetectorSettings",
    "KeypointAutoencoder",
    "KeypointDetector",
    "LossWeights",
    "Trained",
    "contact_sheet",
    "detect_tracks",
    "image_strips",
    "keypoint_paths",
    "score",
    "to_pixels",
    "track_video",
    "train_detector",
    "with_tracks",
]
