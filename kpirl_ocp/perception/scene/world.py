"""The common part of the scenes: a PyBullet world with furniture, and pictures of it by the software renderer."""

from __future__ import annotations

import shutil
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.c_output import captured
from kpirl_ocp.perception.scene.bullet import connect, pybullet
from kpirl_ocp.perception.scene.camera import Camera
from kpirl_ocp.perception.scene.frame import Frame

# Static boxes: half extents [m], centre [m], colour. A table top at z = 0, and a shelf of a board and an upright.
_FURNITURE = (
    ((0.90, 0.70, 0.02), (0.45, 0.0, -0.02), (0.72, 0.65, 0.55)),
    ((0.11, 0.15, 0.01), (0.70, 0.0, 0.30), (0.55, 0.40, 0.25)),
    ((0.01, 0.15, 0.16), (0.80, 0.0, 0.15), (0.55, 0.40, 0.25)),
)


W = TypeVar("W", bound="World")


@dataclass
class World:
    """A PyBullet world without a window, with table, shelf and one camera; use it in a `with` block.

    Several may be open at once. The bottle and its gripper cannot go through the furniture.

    shelf: whether it is there.
    """

    camera: Camera = field(default_factory=Camera)
    shelf: bool = True

    def __enter__(self: W) -> W:
        self._directory = Path(tempfile.mkdtemp(prefix="kpirl_ocp-"))
        self._client = connect()
        for half, centre, colour in _FURNITURE if self.shelf else _FURNITURE[:1]:
            visual = self._client.createVisualShape(pybullet.GEOM_BOX, halfExtents=half, rgbaColor=(*colour, 1.0))
            solid = self._client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half)
            self._client.createMultiBody(0, solid, visual, basePosition=centre)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._client.disconnect()
        shutil.rmtree(self._directory)

    def _load(self, urdf: Path) -> int:
        """Load a body that is fixed to the world, and give its number."""
        flags = pybullet.URDF_USE_INERTIA_FROM_FILE
        try:
            with captured(1, 2) as said:  # two lines for every link without inertia, of which it takes the mass as 1 kg
                return int(self._client.loadURDF(str(urdf), useFixedBase=True, flags=flags))
        except pybullet.error:
            print(*said, sep="\n", file=sys.stderr)
            raise

    def _render(self, body: int, link: int, position: ArrayLike) -> Frame:
        """The camera's image, with the bottle, `link` of `body` (-1 for its base), at position (3,) [m]."""
        camera = self.camera
        _, _, rgba, _, labels = self._client.getCameraImage(
            camera.width,
            camera.height,
            self._client.computeViewMatrix(camera.eye, camera.target, camera.up),
            self._client.computeProjectionMatrixFOV(camera.field_of_view, camera.width / camera.height, 0.1, 5.0),
            shadow=0,
            renderer=pybullet.ER_TINY_RENDERER,
            flags=pybullet.ER_SEGMENTATION_MASK_OBJECT_AND_LINKINDEX,
        )
        parts = np.asarray(labels, np.int32).reshape(camera.height, camera.width)
        bottle = parts == body + ((link + 1) << 24)  # as PyBullet numbers links
        rgb = np.asarray(rgba, np.uint8).reshape(*parts.shape, 4)[..., :3].copy()
        return Frame(rgb, bottle, camera.project(position), parts)
