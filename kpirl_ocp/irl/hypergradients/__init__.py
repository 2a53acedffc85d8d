"""The derivative of the IRL loss, in exchangeable ways, each with a certificate."""

from kpirl_ocp.irl.hypergradients.certificate import Hypergradient, HypergradientResult
from kpirl_ocp.irl.hypergradients.finite_difference import FiniteDifference, FiniteDifferenceCertificate
from kpirl_ocp.irl.hypergradients.implicit import Implicit, differentiate
from kpirl_ocp.irl.hypergradients.loss import (
    ActionDistance,
    KeyFrames,
    Loss,
    WeightedSum,
    data_of,
    demonstrated_observations,
    squared_distance,
)
from kpirl_ocp.irl.hypergradients.unrolled import Truncated, Unrolled, UnrolledCertificate

__all__ = [
    "ActionDistance",
    "FiniteDifference",
    "FiniteDifferenceCertificate",
    "Hypergradient",
    "HypergradientResult",
    "Implicit",
    "KeyFrames",
    "Loss",
    "Truncated",
    "Unrolled",
    "UnrolledCertificate",
    "WeightedSum",
    "data_of",
    "demonstrated_observations",
    "differentiate",
    "squared_distance",
]
