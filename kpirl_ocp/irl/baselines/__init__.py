"""Other ways to learn a cost from demonstrations, for comparison: each is the method of one paper."""

from kpirl_ocp.irl.baselines.demonstrated_conditions import DemonstratedConditions, conditions
from kpirl_ocp.irl.baselines.inverse_kkt import inverse_kkt
from kpirl_ocp.irl.baselines.max_entropy import max_entropy
from kpirl_ocp.irl.baselines.single_level import SingleLevelResult, single_level

__all__ = [
    "DemonstratedConditions",
    "SingleLevelResult",
    "conditions",
    "inverse_kkt",
    "max_entropy",
    "single_level",
]
