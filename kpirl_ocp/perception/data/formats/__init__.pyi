from .lerobot import read_lerobot
from .lerobot_writer import write_lerobot
from .plain import read_csv, read_npz
from .robomimic import read_robomimic
from .take import Take, VideoPart, episode_of_take, take_of_episode

__all__ = [
    "Take",
    "VideoPart",
    "episode_of_take",
    "read_csv",
    "read_lerobot",
    "read_npz",
    "read_robomimic",
    "take_of_episode",
    "write_lerobot",
]
