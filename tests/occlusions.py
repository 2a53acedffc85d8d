"""Films of a thing that something else hides for a while, by seed, with the truth about where the thing is."""

from __future__ import annotations

import cv2
import numpy as np
from films import HEIGHT, WIDTH, paste, pose, texture
from shuffles import Shuffle, look, padded, way

MIDDLE = HEIGHT / 2


def cloth(rng, height, width):
    """A picture with structure at every size, like cloth, wood or print."""
    layers = [texture(int(rng.integers(10**6)), height, width, grain) / grain**-0.5 for grain in (3, 6, 12, 25)]
    picture = np.sum(layers, axis=0) * rng.uniform(0.6, 1, 3)
    low, high = np.percentile(picture, [2, 98])
    return np.clip(255 * (picture - low) / (high - low), 0, 255).astype(np.uint8)


def skin(rng, height, width):
    """A picture of one colour with a faint shade: a hand or an arm, fingers and all."""
    shade = texture(int(rng.integers(10**6)), height, width, grain=25).mean(axis=2, keepdims=True) - 128
    picture = np.array([200, 150, 120]) * rng.uniform(0.6, 1.1) + 0.25 * shade
    lines = np.abs(np.sin(np.arange(height) * np.pi / rng.uniform(11, 16))) < 0.12  # between fingers
    picture[lines] *= 0.75
    return np.clip(picture, 0, 255).astype(np.uint8)


def filmed(thing, path, cover, cover_path, seed, blur=0):
    """A film of a thing at path (n, 2) behind a cover (h, w, 3) at its own path, blurred, noisy and compressed."""
    rng = np.random.default_rng([seed, 99])
    path, cover_path = padded([path, cover_path])
    wall = cloth(rng, HEIGHT, WIDTH) // 3 + 60
    frames = []
    for index, (place, over) in enumerate(zip(path, cover_path, strict=True)):
        image = paste(wall, thing, pose(*place, size=len(thing)))
        image = pasted(image, cover, over)
        image = cv2.GaussianBlur(image, (0, 0), blur) if blur else image
        noisy = image + rng.normal(0, rng.uniform(1, 4), image.shape)
        frames.append((index / 30, np.clip(noisy, 0, 255).round().astype(np.uint8)))
    return Shuffle(compressed(frames), path)


def pasted(image, picture, middle):
    """The image with an upright picture of any size around a middle (2,)."""
    height, width = picture.shape[:2]
    where = np.array([[1, 0, middle[0] - width / 2], [0, 1, middle[1] - height / 2], [0, 0, 1]])
    return paste(image, picture, where)


def compressed(frames):
    """Frames as they come back from Motion JPEG; two encodings of a film with x264 are not the same to the last bit."""
    return [(time, decoded(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 70])[1])) for time, image in frames]


def decoded(picture):
    return cv2.imdecode(picture, cv2.IMREAD_COLOR)


def thing_and_blur(rng):
    picture = look(rng, faint=rng.random() < 0.2) if rng.random() < 0.5 else cloth(rng, 44, 44)
    return picture, rng.choice([0.0, 0.0, 1.0])


def still(place, frames):
    return np.repeat([np.asarray(place, float)], frames, axis=0)


# Kinds of film


def post(seed):
    """A thing that passes behind a textured post of about its size."""
    rng = np.random.default_rng([seed, 21])
    thing, blur = thing_and_blur(rng)
    height = MIDDLE + rng.uniform(-20, 20)
    path = way([[50, height], [WIDTH - 50, height + rng.uniform(-15, 15)]], rng.uniform(1.5, 10), rng.random() < 0.5)
    cover = cloth(rng, HEIGHT, int(rng.uniform(15, 70)))
    return filmed(thing, path, cover, still([rng.uniform(130, 190), MIDDLE], 2), seed, blur)


def board(seed):
    """A thing that goes behind a board, rests there, and comes back or goes on."""
    rng = np.random.default_rng([seed, 22])
    thing, blur = thing_and_blur(rng)
    speed, hidden = rng.uniform(1.5, 8), [160 + rng.uniform(-10, 10), MIDDLE]
    end = [60.0, MIDDLE] if rng.random() < 0.5 else [WIDTH - 50.0, MIDDLE + 10]
    there = way([[60, MIDDLE], hidden], speed, rng.random() < 0.5)
    path = np.concatenate([there, still(hidden, int(rng.integers(3, 25))), way([hidden, end], speed, smooth=True)])
    side = int(rng.uniform(30, 75))
    return filmed(thing, path, cloth(rng, side, side), still([160, MIDDLE + rng.uniform(-8, 8)], 2), seed, blur)


def hand(seed):
    """A hand that comes to rest on a part of a thing, perhaps carries it, and leaves before the thing rests."""
    rng = np.random.default_rng([seed, 23])
    thing, blur = thing_and_blur(rng)
    start, there = [80.0, MIDDLE], [80 + rng.uniform(60, 140), MIDDLE + rng.uniform(-30, 30)]
    cover = skin(rng, int(rng.uniform(25, 50)), int(rng.uniform(25, 70)))
    grip, away = rng.uniform([-22, -20], [22, 20]), np.array([rng.uniform(-40, 40), 120.0])
    comes, leaves = (way([grip + away * a, grip + away * b], rng.uniform(3, 12), True) for a, b in [(1, 0), (0, 1)])
    carries = rng.random() < 0.5
    carried = way([start, there], rng.uniform(2, 8), True) if carries else still(start, int(rng.integers(5, 40)))
    rest = carried[-1]
    path = np.concatenate([still(start, len(comes)), carried])
    cover_path = np.concatenate([start + comes, carried + grip, rest + leaves])
    if rng.random() < 0.5:
        path = np.concatenate([path, still(rest, len(leaves))])
    path = np.concatenate([path, way([rest, rest + rng.uniform([20, -40], [60, 40])], rng.uniform(2, 6), True)])
    return filmed(thing, path, cover, cover_path, seed, blur)


def arm(seed):
    """An arm that sweeps over a thing while it moves or rests, and may wait on it."""
    rng = np.random.default_rng([seed, 24])
    thing, blur = thing_and_blur(rng)
    height = MIDDLE + rng.uniform(-15, 15)
    path = way([[60, height], [WIDTH - 70, height]], rng.uniform(1, 5), smooth=True)
    cover = (skin if rng.random() < 0.6 else cloth)(rng, 300, int(rng.uniform(18, 50)))
    meet = path[len(path) // 2]
    speed, side = rng.uniform(2, 14), rng.choice([-1, 1])
    comes = way([[meet[0] + side * 150, MIDDLE], [meet[0], MIDDLE]], speed, smooth=False)
    waits = still(comes[-1], int(rng.integers(1, 15)))
    leaves = way([comes[-1], [meet[0] - rng.choice([-1, 1]) * 200, MIDDLE]], speed, smooth=False)
    lead = max(0, len(path) // 2 - len(comes))
    path = np.concatenate([still(path[0], max(0, len(comes) - len(path) // 2)), path])
    return filmed(thing, path, cover, np.concatenate([still(comes[0], lead), comes, waits, leaves]), seed, blur)


def lookalike(seed):
    """A thing of the same colours, with another pattern, that enters and passes in front, or stops there a while."""
    rng = np.random.default_rng([seed, 25])
    colour = rng.integers(30, 255, 3)
    thing, other = ((0.6 * colour + 0.4 * cloth(rng, side, side)).astype(np.uint8) for side in (44, 50))
    height = MIDDLE + rng.uniform(-15, 15)
    path = way([[60, height], [WIDTH - 70, height]], rng.uniform(1, 6), smooth=True)
    meet, gap, speed = path[len(path) // 2], rng.choice([0.0, 8, 18]), rng.uniform(3, 12)
    comes = way([[WIDTH + 40, height + gap], [meet[0], height + gap]], speed, smooth=False)
    leaves = way([comes[-1], [-40, height + gap]], speed, smooth=False)
    lead = max(0, len(path) // 2 - len(comes))
    path = np.concatenate([still(path[0], max(0, len(comes) - len(path) // 2)), path])
    waits = still(comes[-1], int(rng.integers(1, 15)))
    over = np.concatenate([still(comes[0], lead), comes, waits, leaves])
    return filmed(thing, path, other, over, seed, rng.choice([0.0, 1.0]))


OCCLUSIONS = (post, board, hand, arm, lookalike)


def beside(seed):
    """A control: what comes covers a fifth of the thing at most."""
    rng = np.random.default_rng([seed, 31])
    thing, blur = thing_and_blur(rng)
    path = way([[60, MIDDLE], [WIDTH - 60, MIDDLE]], rng.uniform(2, 8), rng.random() < 0.5)
    make = skin if rng.random() < 0.5 else cloth
    over = still([160, MIDDLE + 22 + 20 - rng.uniform(0, 9)], 2)
    return filmed(thing, path, make(rng, 40, int(rng.uniform(20, 80))), over, seed, blur)


def narrow(seed):
    """A control: a thing passes behind a bar that is a fifth as wide."""
    rng = np.random.default_rng([seed, 32])
    thing, blur = thing_and_blur(rng)
    path = way([[60, MIDDLE], [WIDTH - 60, MIDDLE]], rng.uniform(2, 8), rng.random() < 0.5)
    return filmed(thing, path, cloth(rng, HEIGHT, 9), still([rng.uniform(130, 190), MIDDLE], 2), seed, blur)


APART = (beside, narrow)
