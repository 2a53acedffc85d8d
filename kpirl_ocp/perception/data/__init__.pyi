from .clips import read_recordings, read_videos
from .collection import collect
from .encoding import write_video
from .motions import MOTIONS, ArmMotion, HandMotion, Motion
from .recordings import ArmRecording, GroundTruth, Recording, read_hand
from .video import Frames, iterate_frames, read_demonstration, sample_indices, sampled_frames

__all__ = [
    "MOTIONS",
    "ArmMotion",
    "ArmRecording",
    "Frames",
    "GroundTruth",
    "HandMotion",
    "Motion",
    "Recording",
    "collect",
    "iterate_frames",
    "read_demonstration",
    "read_hand",
    "read_recordings",
    "read_videos",
    "sample_indices",
    "sampled_frames",
    "write_video",
]
