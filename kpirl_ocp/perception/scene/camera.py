"""A pinhole camera: its pose, and the projection of points of the world into its image.

    p ~ K (R x + t),    K = [[f, 0, W/2], [0, f, H/2], [0, 0, 1]],    f = (H/2) / tan(fov/2)

The camera looks along its z axis, x points right and y down in the image. Pixel coordinates are continuous: (0, 0) is
the upper left corner of the image, the centre of the first pixel is at (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.types import Array


@dataclass(frozen=True)
class Camera:
    """A fixed camera.

    eye, target: (3,) [m] position of the camera, and the point in the middle of its image; `up` is up in the image.
    field_of_view: vertical opening angle [deg]. width, height: [pixels].
    """

    eye: tuple[float, float, float] = (0.62, -1.45, 0.60)
    target: tuple[float, float, float] = (0.62, 0.0, 0.52)
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    field_of_view: float = 36.0
    width: int = 240
    height: int = 240

    @property
    def intrinsics(self) -> Array:
        """K (3, 3) [pixels]."""
        focal = self.height / 2 / np.tan(np.radians(self.field_of_view) / 2)
        return np.array([[focal, 0.0, self.width / 2], [0.0, focal, self.height / 2], [0.0, 0.0, 1.0]])

    @property
    def extrinsics(self) -> tuple[Array, Array]:
        """R (3, 3) and t (3,) [m], from world to camera coordinates."""
        forward = np.subtract(self.target, self.eye)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, self.up)
        right = right / np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        return rotation, -rotation @ np.array(self.eye)

    def project(self, points: ArrayLike) -> Array:
        """Pixel coordinates (..., 2) of points (..., 3) [m] in the world; NaN for a point behind the camera."""
        rotation, translation = self.extrinsics
        image = (np.asarray(points, float) @ rotation.T + translation) @ self.intrinsics.T
        depth = image[..., 2:]
        return np.where(depth > 0, image[..., :2] / np.where(depth > 0, depth, 1.0), np.nan)

    def in_plane(self, pixel: ArrayLike) -> Array:
        """The point (3,) [m] of the arm's plane y = 0 that appears at `pixel` (2,)."""
        rotation, _ = self.extrinsics
        ray = rotation.T @ np.linalg.solve(self.intrinsics, np.append(np.asarray(pixel, float), 1.0))
        eye = np.array(self.eye)
        return eye - eye[1] / ray[1] * ray
