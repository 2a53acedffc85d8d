"""Which of several things that look alike is the object, and what is seen in its place."""

from kpirl_ocp.perception.tracking.identity.intruders import Intruders
from kpirl_ocp.perception.tracking.identity.lookalikes import Lookalikes, candidates
from kpirl_ocp.perception.tracking.identity.twins import Thing, Twins

__all__ = ["Intruders", "Lookalikes", "Thing", "Twins", "candidates"]
