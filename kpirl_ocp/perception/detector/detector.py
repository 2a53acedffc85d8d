"""A trained keypoint detector: images in, keypoints out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.model_cards import DETECTOR, read_model, report_mismatch, write_model
from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.perception.detector.autoencoder import KeypointAutoencoder
from kpirl_ocp.perception.detector.confidence import Confidence, calibrate, without_object
from kpirl_ocp.perception.detector.keypoints import local_soft_argmax
from kpirl_ocp.perception.detector.training import resize
from kpirl_ocp.types import Array

_BATCH = 64


@contextmanager
def one_thread() -> Iterator[None]:
    """Context in which torch uses one thread, because the last digits of its sums depend on their number."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@dataclass(frozen=True)
class KeypointDetector:
    """z = g_key(image): K keypoints (x, y, mu), in image units (see `keypoints`).

    model: the autoencoder, of which the encoder is used. size: side of the images it was trained on [pixels].
    confidence: what makes mu absolute; without it mu is relative to the largest of the K in the image.
    """

    model: KeypointAutoencoder
    size: int
    confidence: Confidence | None = None

    @classmethod
    def load(cls, path: str | Path) -> KeypointDetector:
        """The detector of a card `path` (.json) and the weights next to it. Raises ModelError for damaged files."""
        card, tensors = read_model(Path(path), DETECTOR)
        with report_mismatch(path):
            build = card.entries["architecture"]
            model = KeypointAutoencoder(build["size"], build["keypoints"], build["encoder"], build["filters"])
            model.load_state_dict({name: torch.from_numpy(value) for name, value in tensors.left.items()})
            found = card.entries.get("confidence")
            confidence = None if found is None else Confidence(np.array(found["centre"]), np.array(found["width"]))
        return cls(model.eval(), build["size"], confidence)

    def save(self, path: str | Path, card: Mapping[str, Any]) -> Path:
        """Write weights and card; architecture and confidence are added to `card`."""
        tensors = {name: value.contiguous().numpy() for name, value in self.model.state_dict().items()}
        sure = {} if self.confidence is None else {"confidence": self.confidence.as_card()}
        own = {"architecture": self.model.architecture} | sure
        return write_model(Path(path), DETECTOR, tensors, own | dict(card))

    def calibrated(self, clips: Sequence[Frames]) -> KeypointDetector:
        """The detector with an absolute mu, from clips (n, H, W, 3) in which the object is in view and moves about.

        Raises TrainingError if a keypoint scores no higher with the object than without.
        """
        seen = [self._peaks(clip) for clip in clips]
        return replace(self, confidence=calibrate(np.concatenate(seen), self._peaks(without_object(clips))))

    def detect(self, images: Frames) -> Array:
        """Detect the keypoints of images, each image by itself.

        Args:
            images: (n, S, S, 3) uint8 RGB, square, of any size S.

        Returns:
            (n, K, 3): x and y [half an image] and the confidence mu in [0, 1].

        Raises:
            ProblemError: images of another shape or type.
        """
        images = np.asarray(images)
        if images.ndim != 4 or images.shape[1] != images.shape[2] or images.shape[3] != 3 or images.dtype != np.uint8:
            raise ProblemError(
                f"images must be square and (n, H, W, 3) uint8 RGB, got {images.shape} {images.dtype}; "
                "perception.data.read_demonstration crops and resizes a video."
            )
        batches = [images[start : start + _BATCH] for start in range(0, len(images), _BATCH)]
        nothing = np.empty((0, self.model.head.out_channels, 3))
        return np.concatenate([nothing, *(self._detect(batch) for batch in batches)])

    @one_thread()
    @torch.inference_mode()
    def _detect(self, images: Frames) -> Array:
        scores = self._scores(images)
        keypoints = local_soft_argmax(scores)
        if self.confidence is not None:
            keypoints[..., 2] = self.confidence.of(scores)
        return keypoints.double().numpy()

    @one_thread()
    @torch.inference_mode()
    def _peaks(self, images: Frames) -> Array:
        """Largest score (n, K) over the cells."""
        return self._scores(images).flatten(-2).amax(-1).double().numpy()

    def _scores(self, images: Frames) -> Tensor:
        frames = torch.from_numpy(resize(images, self.size)).permute(0, 3, 1, 2).float() / 255
        return self.model.encode(frames).scores
