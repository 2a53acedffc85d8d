"""The interior-point method on the stage structure: its core in C, and what reaches it from Python."""

from kpirl_ocp.ocp.interior_point.core import Core, borrow_core
from kpirl_ocp.ocp.interior_point.horizon_functions import HorizonFunctions, horizon_functions
from kpirl_ocp.ocp.interior_point.machine_code import Compile, machine_code
from kpirl_ocp.ocp.interior_point.stage_functions import StageFunctions, stage_functions

__all__ = [
    "Compile",
    "Core",
    "HorizonFunctions",
    "StageFunctions",
    "borrow_core",
    "horizon_functions",
    "machine_code",
    "stage_functions",
]
