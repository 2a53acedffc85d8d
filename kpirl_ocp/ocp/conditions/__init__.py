"""The KKT conditions of a problem, as one program and stage by stage, with their derivatives and residuals."""

from kpirl_ocp.ocp.conditions.program import Program, transcribe
from kpirl_ocp.ocp.conditions.stage_derivatives import dynamics_jacobian

__all__ = ["Program", "dynamics_jacobian", "transcribe"]
