"""The simulated robot behind its camera and detector, as a controller meets it.

Its images can be disturbed: by noise, and by a patch in front of a keypoint.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.detector.keypoints import to_pixels
from kpirl_ocp.perception.scene.frame import Frame
from kpirl_ocp.perception.scene.scene import JointState, Scene
from kpirl_ocp.types import Array, Sight

_GREY = 128


@dataclass(frozen=True)
class Disturbance:
    """A disturbance of the images.

    noise: standard deviation of normal noise on every pixel and colour [grey levels of 255].
    hidden: number of the keypoint that is hidden behind a grey square; None for none.
    patch: side of the square [pixels]. since, until: it is there for looks since <= t < until, counted from 0.
    """

    noise: float = 0.0
    hidden: int | None = None
    patch: int = 40
    since: int = 0
    until: int = 0

    def apply(self, frame: Frame, detector: KeypointDetector, look: int, rng: np.random.Generator) -> Frames:
        """The disturbed image (H, W, 3) of look number `look`."""
        image = frame.rgb.copy()
        if self.hidden is not None and self.since <= look < self.until:
            x, y = to_pixels(detector.detect(image[None])[0, self.hidden], len(image)).round().astype(int)
            half = self.patch // 2
            image[max(0, y - half) : max(0, y + half), max(0, x - half) : max(0, x + half)] = _GREY
        if self.noise > 0:
            image = np.clip(image + rng.normal(0.0, self.noise, image.shape), 0, 255).round().astype(np.uint8)
        return image


@dataclass(eq=False)
class CameraPlant:
    """A scene with a detector; `images` and `places` keep the image and the bottle of every look.

    places: (2,) each, the projected middle of the bottle [pixels], which only a simulation knows.
    """

    scene: Scene
    detector: KeypointDetector
    disturbance: Disturbance = field(default_factory=Disturbance)
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    images: list[Frames] = field(default_factory=list)
    places: list[Array] = field(default_factory=list)

    def look(self) -> Sight:
        """Render, disturb, detect and measure."""
        frame = self.scene.render()
        image = self.disturbance.apply(frame, self.detector, len(self.images), self.rng)
        self.images.append(image)
        self.places.append(frame.place)
        state: JointState = self.scene.measure()
        return Sight(self.detector.detect(image[None])[0], state.positions, state.velocities)

    def act(self, u: ArrayLike) -> None:
        """Command joint displacements u (7,) [rad] and wait one period of the scene."""
        self.scene.step(u)
