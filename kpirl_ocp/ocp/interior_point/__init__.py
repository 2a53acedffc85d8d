"""The interior-point method on the stage structure: its core in C, and what reaches it from Python."""

from kpirl_ocp.ocp.interior_point.core import Core
from kpirl_ocp.ocp.interior_point.cores import borrow_core
from kpirl_ocp.ocp.interior_point.horizon_functions import HorizonFunctions
from kpirl_ocp.ocp.interior_point.machine_code import Compile, MachineCode
from kpirl_ocp.ocp.interior_point.stage_functions import StageFunctions

__all__ = ["Compile", "Core", "HorizonFunctions", "MachineCode", "StageFunctions", "borrow_core"]
