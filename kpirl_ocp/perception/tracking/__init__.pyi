from .admission import Refusal, moving_part, refusal
from .objects import around, in_box, moving
from .pictures import overlays, track_film, track_sheet
from .tracker import Located, track
from .tracks import Tracks, of_object, read_tracks, spread, write_tracks
from .watch import Film, find_object, follow_hand, follow_object

__all__ = [
    "Film",
    "Located",
    "Refusal",
    "Tracks",
    "around",
    "find_object",
    "follow_hand",
    "follow_object",
    "in_box",
    "moving",
    "moving_part",
    "of_object",
    "overlays",
    "read_tracks",
    "refusal",
    "spread",
    "track",
    "track_film",
    "track_sheet",
    "write_tracks",
]
