"""A picture of a scene with the truth about it; no simulator is needed to hold one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.pictures import Brief
from kpirl_ocp.types import Array, Mask


@dataclass(frozen=True, repr=False)
class Frame(Brief):
    """An image and the bottle in it.

    rgb: (H, W, 3) uint8. bottle: (H, W) bool, the pixels that show it. place: (2,) its projected middle [pixels].
    parts: (H, W) numbers of the rigid bodies that the pixels show, -1 for the wall behind them; None if unknown.
    """

    rgb: NDArray[np.uint8]
    bottle: Mask
    place: Array
    parts: NDArray[np.int32] | None = None
