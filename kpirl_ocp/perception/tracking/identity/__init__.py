"""Which of several things that look alike is the object."""

from kpirl_ocp.perception.tracking.identity.lookalikes import Lookalikes, candidates
from kpirl_ocp.perception.tracking.identity.twins import Thing, Twins

__all__ = ["Lookalikes", "Thing", "Twins", "candidates"]
