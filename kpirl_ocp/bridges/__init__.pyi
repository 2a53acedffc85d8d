from .first_action import with_first_action
from .jax_function import ocp_function
from .torch_layer import OCPLayer, Plan, guesses_of
from .torch_network import from_torch

__all__ = [
    "OCPLayer",
    "Plan",
    "from_torch",
    "guesses_of",
    "ocp_function",
    "with_first_action",
]
