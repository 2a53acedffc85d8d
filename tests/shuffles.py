"""Films of equal things that are moved past each other, by seed, with the truth about where the first of them is."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from films import HEIGHT, WALL, WIDTH, paste, pose, texture

SIDE = 44  # of a thing [pixels]


class Shuffle(NamedTuple):
    """Frames (time [s], image), and the places (n, 2) [pixels] of the first thing's middle."""

    frames: list
    truth: np.ndarray


def rendered(paths, front, pictures, rate=30, noise=2.0, seed=0):
    """A film of things at paths [(n, 2), ...]; front: (n, things) the nearer, the larger; a path of NaN: it is away."""
    rng, frames = np.random.default_rng(seed), []
    for index in range(len(paths[0])):
        image = WALL
        for thing in np.argsort(front[index]):
            place, size = paths[thing][index], len(pictures[thing])
            if np.isfinite(place).all():
                image = paste(image, pictures[thing], pose(*place, size=size))
        image = np.clip(image + rng.normal(0, noise, image.shape), 0, 255).round().astype(np.uint8)
        frames.append((index / rate, image))
    return Shuffle(frames, paths[0])


def way(points, speed, smooth):
    """Places along straight lines through points at a largest speed [pixels a frame], at rest in each if smooth."""
    places = [np.asarray(points[:1], float)]
    for start, end in pairwise(points):
        start, end = np.asarray(start, float), np.asarray(end, float)
        count = max(2, int(np.ceil(np.linalg.norm(end - start) * (np.pi / 2 if smooth else 1) / speed)))
        share = np.arange(1, count + 1) / count
        share = (1 - np.cos(np.pi * share)) / 2 if smooth else share
        places.append(start + share[:, None] * (end - start))
    return np.concatenate(places)


def look(rng, faint=False):
    """A picture of a thing: blobs, or a faint pattern on one colour."""
    picture = texture(int(rng.integers(1, 10**6)), SIDE, SIDE, grain=int(rng.integers(5, 9)))
    return (0.6 * rng.integers(30, 255, 3) + 0.4 * picture).astype(np.uint8) if faint else picture


def swap(rng, things, swaps, speed, depth):
    """Equal things in a row whose neighbours change places on half ellipses; those nearer are in front."""
    row = np.linspace(60, WIDTH - 60, things) if things > 2 else np.array([90.0, 230.0])
    slots, middle = list(range(things)), HEIGHT / 2
    steps = [np.tile(np.column_stack([row, np.full(things, middle)]), (6, 1, 1))]  # (frames, things, 2)
    for _ in range(swaps):
        left = int(rng.integers(things - 1))
        one, other = slots.index(left), slots.index(left + 1)
        if rng.random() < 0.5:
            one, other = other, one
        here = steps[-1][-1].copy()
        a, b = here[one], here[other]
        smooth = rng.random() < 0.5
        count = max(4, int(np.ceil(np.pi / 2 * abs(b[0] - a[0]) * (np.pi / 2 if smooth else 1) / speed)))
        share = np.arange(1, count + 1)[:, None] / count
        angle = np.pi * ((1 - np.cos(np.pi * share)) / 2 if smooth else share)
        arc = np.hstack([(1 - np.cos(angle)) / 2, np.sin(angle)])
        part = np.tile(here, (count, 1, 1))
        part[:, one] = a + arc * [b[0] - a[0], depth]
        part[:, other] = b + arc * [a[0] - b[0], -depth]
        steps.append(np.concatenate([part, np.tile(part[-1], (int(rng.integers(0, 6)), 1, 1))]))
        slots[one], slots[other] = slots[other], slots[one]
    places = np.concatenate([*steps, np.tile(steps[-1][-1], (6, 1, 1))])
    first = int(rng.integers(things))
    order = [first, *(thing for thing in range(things) if thing != first)]
    paths = [places[:, thing] for thing in order]
    ranks = rng.permutation(things) * 1e-3
    front = np.stack([path[:, 1] for path in paths], axis=1) + (ranks if depth else 1e3 * ranks)
    return paths, front


def shuffled(seed):
    """Two or three equal things that change places a few times."""
    rng = np.random.default_rng([seed, 1])
    things, picture = int(rng.integers(2, 4)), look(rng, rng.random() < 0.3)
    paths, front = swap(rng, things, int(rng.integers(2, 5)), rng.uniform(5, 20), rng.choice([0.0, 8, 16, 26]))
    return rendered(paths, front, [picture] * things, seed=seed)


def crossing(seed):
    """Two equal things that pass each other on straight lines, either in front."""
    rng = np.random.default_rng([seed, 2])
    height, gap, smooth = HEIGHT / 2 + rng.uniform(-20, 20), rng.choice([0.0, 6, 15, 25]), rng.random() < 0.5
    ends = [[50, height], [WIDTH - 50, height]]
    one = way(ends, rng.uniform(3, 20), smooth)
    other = way(np.add(ends[::-1], [0, gap]), rng.uniform(3, 20), smooth)
    return rendered(*together([one, other], rng), [look(rng)] * 2, seed=seed)


def overtaking(seed):
    """A thing whose equal comes from behind and passes it."""
    rng = np.random.default_rng([seed, 3])
    height, gap = HEIGHT / 2 + rng.uniform(-20, 20), rng.choice([0.0, 6, 15, 25])
    one = way([[110, height], [WIDTH - 90, height]], rng.uniform(2, 5), smooth=False)
    other = way([[40, height + gap], [WIDTH - 30, height + gap]], rng.uniform(8, 18), smooth=False)
    return rendered(*together([one, other], rng), [look(rng)] * 2, seed=seed)


def feint(seed):
    """Two equal things that come together, one over the other, and go back where they came from."""
    rng = np.random.default_rng([seed, 4])
    height, speed, gap = HEIGHT / 2, rng.uniform(3, 20), rng.choice([0.0, 4, 10])
    meet = WIDTH / 2 + rng.uniform(-5, 5)
    smooth = rng.random() < 0.5
    one = way([[70, height], [meet, height], [70, height]], speed, smooth)
    end = WIDTH - 70
    other = way([[end, height + gap], [meet + rng.uniform(-4, 4), height + gap], [end, height + gap]], speed, smooth)
    return rendered(*together([one, other], rng), [look(rng)] * 2, seed=seed)


def covered(seed):
    """A thing over which its equal stops for a while, until one of them leaves."""
    rng = np.random.default_rng([seed, 5])
    height, speed = HEIGHT / 2, rng.uniform(5, 20)
    start, here, there, down = [60.0, height], [110.0, height], [WIDTH - 50.0, height], [110.0, HEIGHT - 30.0]
    one = way([start, here], 4, smooth=True)
    over = np.array(here) + rng.uniform(-6, 6, 2)
    rest = np.repeat([over], int(rng.integers(2, 15)), axis=0)
    other = np.concatenate([np.repeat([there], len(one), axis=0), way([there, over], speed, smooth=False), rest])
    one, other = padded([one, other])
    leave = way([here, down if rng.random() < 0.5 else there], speed, smooth=False) - here
    if rng.random() < 0.5:
        one = np.concatenate([one, here + leave])
    else:
        other = np.concatenate([other, over + leave])
    return rendered(*together([one, other], rng), [look(rng)] * 2, seed=seed)


def entering(seed):
    """A thing past which its equal goes that was not in the picture at first."""
    rng = np.random.default_rng([seed, 6])
    height, gap = HEIGHT / 2 + rng.uniform(-20, 20), rng.choice([0.0, 6, 15, 25])
    one = way([[60, height], [WIDTH - 60, height]], rng.uniform(2, 8), smooth=True)
    other = way([[WIDTH + 40, height + gap], [-40, height + gap]], rng.uniform(5, 20), smooth=False)
    other = np.concatenate([np.repeat(other[:1], int(rng.integers(0, 12)), axis=0), other])
    return rendered(*together([one, other], rng), [look(rng)] * 2, seed=seed)


def exchanged(seed):
    """Two equal things, side by side, that may change places behind something else."""
    rng = np.random.default_rng([seed, 7])
    height, speed, gap = HEIGHT / 2, rng.uniform(6, 15), rng.uniform(50, 70)
    a, b = [120.0, height], [120.0 + gap, height]
    veil = way([[WIDTH + 80, height], [120 + gap / 2, height]], speed, smooth=True)
    rest = int(rng.integers(10, 20))
    veil = np.concatenate([veil, np.repeat(veil[-1:], rest, axis=0), veil[::-1]])
    change = rng.random() < 0.6
    hidden = way([a, b], gap / rest, smooth=False)[: rest + 1] if change else np.repeat([a], rest, axis=0)
    one = np.concatenate([np.repeat([a], (len(veil) - rest) // 2, axis=0), hidden])
    paths = padded([one, np.array(a) + np.array(b) - one, veil])
    front = np.tile([0.0, 0.1, 1.0], (len(paths[0]), 1))
    return rendered(paths, front, [*[look(rng)] * 2, texture(7, 150, 150)], seed=seed)


TWINS = (shuffled, crossing, overtaking, feint, covered, entering, exchanged)


# Controls: the object can be told apart throughout


def alone(seed):
    """A thing that moves alone, back and forth."""
    rng = np.random.default_rng([seed, 11])
    points = rng.uniform([50, 50], [WIDTH - 50, HEIGHT - 50], (4, 2))
    path = way(points, rng.uniform(3, 18), rng.random() < 0.5)
    return rendered([path], np.zeros((len(path), 1)), [look(rng)], seed=seed)


def different(seed):
    """Two different things that pass each other."""
    rng = np.random.default_rng([seed, 12])
    ends, smooth = [[50, HEIGHT / 2], [WIDTH - 50, HEIGHT / 2]], rng.random() < 0.5
    one = way(ends, rng.uniform(3, 12), smooth)
    other = way(np.add(ends[::-1], [0, rng.choice([12.0, 18, 25])]), rng.uniform(3, 20), smooth)
    return rendered(*together([one, other], rng), [look(rng), look(rng)], seed=seed)


def far_twin(seed):
    """A thing whose equal moves elsewhere, never near it."""
    rng = np.random.default_rng([seed, 15])
    one = way([[50, 40], [WIDTH - 50, 45], [60, 50]], rng.uniform(3, 15), smooth=True)
    other = way([[WIDTH - 50, 135], [50, 135], [WIDTH - 60, 130]], rng.uniform(3, 15), smooth=True)
    return rendered(*together([one, other], rng), [look(rng)] * 2, seed=seed)


CONTROLS = (alone, different, far_twin)


def padded(paths):
    """Paths of one length: each rests at its end."""
    longest = max(map(len, paths))
    return [np.concatenate([path, np.repeat(path[-1:], longest - len(path), axis=0)]) for path in paths]


def together(paths, rng):
    """Paths of one length, in any order, one of them in front."""
    paths = padded(paths)
    return paths, (rng.permutation(len(paths)) * 1.0)[None].repeat(len(paths[0]), axis=0)
