"""Methods of other papers that learn a cost from demonstrations, for comparison."""

from kpirl_ocp.irl.baselines.inverse_kkt import inverse_kkt
from kpirl_ocp.irl.baselines.max_entropy import max_entropy
from kpirl_ocp.irl.baselines.single_level import SingleLevelResult, single_level

__all__ = ["SingleLevelResult", "inverse_kkt", "max_entropy", "single_level"]
