"""Identifiability of a learned cost: intervals, known directions, and the next demonstration."""

from kpirl_ocp.irl.identifiability.design import expected_information
from kpirl_ocp.irl.identifiability.gains import squared_gains, stiffness
from kpirl_ocp.irl.identifiability.identify import Identification, identify
from kpirl_ocp.irl.identifiability.plan_jacobian import PlanJacobian, plan_jacobian

__all__ = [
    "Identification",
    "PlanJacobian",
    "expected_information",
    "identify",
    "plan_jacobian",
    "squared_gains",
    "stiffness",
]
