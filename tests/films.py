"""Films of textured things that move before a cluttered wall, with the truth about where they are."""

from __future__ import annotations

import cv2
import numpy as np

WIDTH, HEIGHT = 320, 180


def texture(seed, height, width, grain=6):
    """Coloured blobs."""
    small = np.random.default_rng(seed).integers(0, 255, (height // grain + 2, width // grain + 2, 3), np.uint8)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)


WALL = texture(0, HEIGHT, WIDTH, grain=12) // 3 + 60


def pose(x, y, angle=0.0, scale=1.0, size=50):
    """(3, 3) from a picture of size x size pixels to the image, its middle at (x, y)."""
    turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.block([[turn, (np.array([x, y]) - turn @ [size / 2, size / 2])[:, None]], [np.zeros((1, 2)), 1.0]])


def paste(image, picture, where):
    """The image with a picture at a pose."""
    shape = (image.shape[1], image.shape[0])
    ink = cv2.warpAffine(picture, where[:2], shape)
    mask = cv2.warpAffine(np.full(picture.shape[:2], 255, np.uint8), where[:2], shape)
    x, y, width, height = cv2.boundingRect(mask)
    part = slice(y, y + height), slice(x, x + width)
    there, pasted = mask[part][..., None] / 255, image.copy()
    pasted[part] = (there * ink[part] + (1 - there) * image[part]).round()
    return pasted


def film(poses, *, picture=None, occluders=None, blur=None, rate=30):
    """Frames (time [s], image) of a picture at poses [(3, 3), ...], some behind an occluder or blurred."""
    picture = texture(1, 50, 50) if picture is None else picture
    frames = []
    for index, where in enumerate(poses):
        image = paste(WALL, picture, where)
        if occluders is not None and occluders[index] is not None:
            image = paste(image, texture(2, 60, 60), pose(*occluders[index], size=60))
        if blur is not None and blur[index] > 1:
            image = cv2.blur(image, (blur[index], 1))
        frames.append((index / rate, image))
    return frames


def shaken(poses, *, jitter=10.0, drift=(0.0, 0.0), turn=0.01, seed=0, rate=30):
    """A film of a picture at poses, by a camera that shakes by up to `jitter` pixels and `turn` rad, and drifts.

    Gives the frames, and the similarities (3, 3) from the first one that the wall undergoes.
    """
    rng, room = np.random.default_rng(seed), 80
    wall = texture(0, HEIGHT + 2 * room, WIDTH + 2 * room, grain=12) // 3 + 60
    into_wall = np.array([[1.0, 0, room], [0, 1, room], [0, 0, 1]])
    frames, cameras = [], []
    for index, where in enumerate(poses):
        moved = (index > 0) * rng.uniform(-1, 1, 3) * [jitter, jitter, turn]
        moved[:2] += np.array(drift) * index / len(poses)
        middle = np.array([WIDTH, HEIGHT]) / 2
        camera = pose(*(middle + moved[:2]), moved[2], size=0) @ pose(*-middle, size=0)
        world = paste(wall, texture(1, 50, 50), into_wall @ where)
        image = cv2.warpAffine(world, (camera @ np.linalg.inv(into_wall))[:2], (WIDTH, HEIGHT))
        frames.append((index / rate, image))
        cameras.append(camera)
    return frames, cameras
