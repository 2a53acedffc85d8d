"""The outer loop: learning psi from demonstrations, its optimisers, apprenticeship learning and evaluation."""

from kpirl_ocp.irl.learning.apprenticeship import ApprenticeshipResult, apprenticeship
from kpirl_ocp.irl.learning.evaluation import Evaluation, evaluate, relative_distance
from kpirl_ocp.irl.learning.horizons import Problems
from kpirl_ocp.irl.learning.learn import Learner, LearningState, learn
from kpirl_ocp.irl.learning.optimisers import LBFGS, Adam, Box, Descent, Optimiser, Point
from kpirl_ocp.irl.learning.result import LearningResult

__all__ = [
    "LBFGS",
    "Adam",
    "ApprenticeshipResult",
    "Box",
    "Descent",
    "Evaluation",
    "Learner",
    "LearningResult",
    "LearningState",
    "Optimiser",
    "Point",
    "Problems",
    "apprenticeship",
    "evaluate",
    "learn",
    "relative_distance",
]
