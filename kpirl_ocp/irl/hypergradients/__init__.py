"""The derivative of the IRL loss, in exchangeable ways, each with a certificate."""

from kpirl_ocp.irl.hypergradients.certificate import Hypergradient, HypergradientResult, demonstrated_observations
from kpirl_ocp.irl.hypergradients.finite_difference import FiniteDifference, FiniteDifferenceCertificate
from kpirl_ocp.irl.hypergradients.implicit import Implicit, differentiate
from kpirl_ocp.irl.hypergradients.loss import Loss, squared_distance
from kpirl_ocp.irl.hypergradients.unrolled import Truncated, Unrolled, UnrolledCertificate

__all__ = [
    "FiniteDifference",
    "FiniteDifferenceCertificate",
    "Hypergradient",
    "HypergradientResult",
    "Implicit",
    "Loss",
    "Truncated",
    "Unrolled",
    "UnrolledCertificate",
    "demonstrated_observations",
    "differentiate",
    "squared_distance",
]
