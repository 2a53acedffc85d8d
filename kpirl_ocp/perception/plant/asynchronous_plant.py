"""A detector in parallel with the controller, each at its own rate, as on the authors' robot (paper, appendix A.3).

The camera takes an image every 1/30 s, whatever the controller does, and its keypoints are there some time later. A
look reads the latest ones, which are older than the joints that are measured with them:

    age = latency + time since the last image that is ready,    latency <= age < latency + 1/30 s
"""

from __future__ import annotations

from dataclasses import dataclass, field

from numpy.typing import ArrayLike

from kpirl_ocp.errors import SceneError
from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.perception.plant.camera_plant import CameraPlant
from kpirl_ocp.perception.scene.bodies import BOTTLE
from kpirl_ocp.perception.scene.scene import PHYSICS_RATE
from kpirl_ocp.types import Array, Sight


@dataclass(frozen=True, eq=False)
class _Detection:
    """An image taken at a tick of the physics, and its keypoints (K, 3)."""

    tick: int
    image: Frames
    keypoints: Array


@dataclass(eq=False)
class AsynchronousPlant(CameraPlant):
    """A scene with a camera and a detector that have a clock of their own.

    `images` keeps the image behind the keypoints of every look, `ages` how old they were [s]; `places` is the bottle at
    the moment of the look. Images whose keypoints no look reads are not rendered.

    camera_rate: of images [Hz]; a divisor of 240. latency: from the image to its keypoints [s].
    phase: of the camera's clock against the controller's, in periods of the camera, 0 <= phase < 1.
    """

    camera_rate: int = 30
    latency: float = 1 / 30
    phase: float = 0.5
    ages: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.camera_rate < 1 or PHYSICS_RATE % self.camera_rate:
            raise SceneError(f"camera_rate must divide the {PHYSICS_RATE} Hz of the physics, got {self.camera_rate!r}.")
        if not (self.latency >= 0 and 0 <= self.phase < 1):
            raise SceneError(f"need latency >= 0 and 0 <= phase < 1, got {self.latency!r} and {self.phase!r}.")
        self._between = PHYSICS_RATE // self.camera_rate  # ticks from image to image
        self._delay = round(self.latency * PHYSICS_RATE)
        self._first = int(self.phase * self._between)
        self._tick, self._taken = 0, list[_Detection]()

    def look(self) -> Sight:
        """Measure the joints, and read the latest keypoints. Before the first motion: those of the arm at rest."""
        if not self._taken:
            self._take()
        ready = [found for found in self._taken if self._is_ready(found)] or self._taken[:1]
        self._taken = self._taken[self._taken.index(ready[-1]) :]
        self.images.append(ready[-1].image)
        self.places.append(self.scene.camera.project(self.scene.link_pose(BOTTLE)[1]))
        self.ages.append((self._tick - ready[-1].tick) / PHYSICS_RATE)
        state = self.scene.measure()
        return Sight(ready[-1].keypoints, state.positions, state.velocities)

    def act(self, u: ArrayLike) -> None:
        """Command joint displacements u (7,) [rad]; images are taken while the period passes."""
        self.scene.command(u)
        for _ in range(self.scene.ticks):
            self.scene.tick()
            self._tick += 1
            if self._tick % self._between == self._first and self._will_be_read():
                self._take()

    def _take(self) -> None:
        image = self.disturbance.apply(self.scene.render(), self.detector, len(self.images), self.rng)
        self._taken.append(_Detection(self._tick, image, self.detector.detect(image[None])[0]))

    def _is_ready(self, found: _Detection) -> bool:
        return found.tick + self._delay <= self._tick

    def _will_be_read(self) -> bool:
        """Whether the image of this tick is the last one that is ready at some look."""
        ready = self._tick + self._delay
        look = -(-ready // self.scene.ticks) * self.scene.ticks  # the first one after that
        return ready + self._between > look
