"""The derivative of a solution by psi, its initial state and its context, and the evidence for it."""

from kpirl_ocp.ocp.sensitivity.certificate import Certificate, SensitivityCertificate
from kpirl_ocp.ocp.sensitivity.solution_sensitivity import Gradients, Sensitivity, Tangent, sensitivity

__all__ = ["Certificate", "Gradients", "Sensitivity", "SensitivityCertificate", "Tangent", "sensitivity"]
