from .arm_film import film_arm
from .arm_motion import ArmMotion
from .arm_viewer import ArmViewer, show_arm
from .plots import plot
from .rerun_file import write_rerun

__all__ = [
    "ArmMotion",
    "ArmViewer",
    "film_arm",
    "plot",
    "show_arm",
    "write_rerun",
]
