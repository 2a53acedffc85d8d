"""The outer loop: learning psi from demonstrations, its optimisers, apprenticeship learning and evaluation."""

from kpirl_ocp.irl.learning.apprenticeship import ApprenticeshipResult, apprenticeship
from kpirl_ocp.irl.learning.evaluation import Evaluation, evaluate, relative_distance
from kpirl_ocp.irl.learning.learn import Learner, LearningResult, LearningState, learn
from kpirl_ocp.irl.learning.optimisers import LBFGS, Adam, Descent, Optimiser, Point

__all__ = [
    "LBFGS",
    "Adam",
    "ApprenticeshipResult",
    "Descent",
    "Evaluation",
    "Learner",
    "LearningResult",
    "LearningState",
    "Optimiser",
    "Point",
    "apprenticeship",
    "evaluate",
    "learn",
    "relative_distance",
]
