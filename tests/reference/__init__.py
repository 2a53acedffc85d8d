"""Classic problems, most with published optima, each stated through the public API."""

from .checks import coarse, gradient_error, learned, solve
from .problems import CLASSICS, Instance, Reference
from .robots import MORE

__all__ = ["REFERENCES", "Instance", "Reference", "coarse", "gradient_error", "learned", "solve"]

REFERENCES = [*CLASSICS, *MORE]
