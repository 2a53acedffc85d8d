"""Coverage of the intervals of learned weights, and the design of demonstrations."""

from argparse import Namespace
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from tqdm import tqdm

from kpirl_ocp import OCP, Demonstration, Implicit, Riccati, figures
from kpirl_ocp.errors import OptionError
from kpirl_ocp.irl.cases.tasks import HORIZON, as_demonstration, demonstrate
from kpirl_ocp.irl.identifiability.design import expected_information
from kpirl_ocp.irl.identifiability.identify import identify
from kpirl_ocp.irl.identifiability.plan_jacobian import plan_jacobian
from kpirl_ocp.ocp.models import KeypointCost, Robot, Weighted, keypoint_ocp
from kpirl_ocp.reporting import kept_if_interrupted, table, write_metrics
from kpirl_ocp.types import Array

METHOD = Implicit(policy="flag")  # trial points of the least-squares solver need no certificate
LEVEL = 0.9


@dataclass(frozen=True, eq=False)
class Experiment:
    """The problem, starts and goals to draw from, and the spread of true log-weights around zero."""

    problem: OCP
    places: list[Demonstration]
    spread: float

    @classmethod
    def reaching(cls, places: int, seed: int, spread: float) -> "Experiment":
        """From the starts and goals of the simulation study."""
        robot = Robot.iiwa()
        problem = keypoint_ocp(
            robot, KeypointCost(Weighted(), effort=1.0, positivity="exp"), HORIZON, joint_limits=False
        )
        episodes = demonstrate(robot, "reaching", places, seed)
        return cls(problem, [as_demonstration(robot, episode) for episode in episodes], spread)

    def truth(self, rng: np.random.Generator) -> Array:
        """Log-weights (9,)."""
        return rng.normal(0.0, self.spread, self.problem.n_parameters)

    def demonstrate(
        self, place: Demonstration, psi: Array, noise: float, rng: np.random.Generator, goal_seen: bool = False
    ) -> Demonstration:
        """The optimal motion for psi, with noise [m] on all keypoints but the first ones; and on the goal, if seen."""
        goal = place.context + goal_seen * rng.normal(0.0, noise, place.context.shape)
        states = Riccati().solve(self.problem, place.s0, psi, place.context).raise_if_failed().states
        observations = np.array(self.problem.observe(states.T)).T
        observations[1:] += rng.normal(0.0, noise, observations[1:].shape)
        return replace(place, context=goal, observations=observations)

    def learn(self, demonstrations: list[Demonstration], psi0: Array, noise: float, prior: bool = False) -> Array:
        """psi with the least IRL loss; with a prior, the loss over noise^2 and |psi|^2 over spread^2 together."""
        seen = np.concatenate([demo.observations[1:].ravel() for demo in demonstrations])
        extra = np.eye(len(psi0)) / self.spread if prior else np.zeros((0, len(psi0)))

        def residuals(psi: Array) -> Array:
            plans = [Riccati().solve(self.problem, demo.s0, psi, demo.context).states for demo in demonstrations]
            planned = np.concatenate([np.array(self.problem.observe(plan.T)).T[1:].ravel() for plan in plans])
            return np.concatenate([(planned - seen) / noise, extra @ psi])

        def slopes(psi: Array) -> Array:
            rows = [plan_jacobian(self.problem, demo, psi, METHOD).jacobian for demo in demonstrations]
            return np.vstack([np.vstack(rows) / noise, extra])

        return least_squares(residuals, psi0, slopes, xtol=1e-6, ftol=1e-8, max_nfev=50).x


def coverage(
    experiment: Experiment, repetitions: int, count: int, noise: float, goal_seen: bool, seed: int
) -> dict[str, float]:
    """Shares of intervals that hold the truth: of the weights, and along the directions that are known.

    With one demonstration the intervals are those of data and spread together, with more those of the data alone.
    """
    rng, weights, directions, known = np.random.default_rng([seed, count, goal_seen]), [], [], []
    for _ in tqdm(range(repetitions), desc=f"coverage, demonstrations: {count}"):
        psi = experiment.truth(rng)
        places = rng.choice(len(experiment.places), count, replace=False)
        demos = [experiment.demonstrate(experiment.places[i], psi, noise, rng, goal_seen) for i in places]
        learned = experiment.learn(demos, np.zeros_like(psi), noise, prior=count == 1)
        found = identify(experiment.problem, demos, learned, spread=experiment.spread, method=METHOD)
        intervals = found.credible_intervals if count == 1 else found.intervals
        weights.append(_holds(intervals(LEVEL), psi))
        rows = found.directions.T[: found.known()]
        directions.append(_holds(intervals(LEVEL, rows), rows @ psi))
        known.append(found.known())
    return {
        "weights": float(np.mean(weights)),
        "known directions": float(np.concatenate(directions).mean()),
        "known": float(np.mean(known)),
        "intervals": int(np.size(weights)),
    }


def _holds(intervals: Array, values: Array) -> Array:
    return (intervals[:, 0] <= values) & (values <= intervals[:, 1])


def design(experiment: Experiment, repetitions: int, most: int, noise: float, seed: int) -> dict[str, Array]:
    """Root mean square error of log-weights (repetitions, most) after 1, 2, .. demonstrations, both ways of asking."""
    errors = {"random": np.zeros((repetitions, most)), "most informative": np.zeros((repetitions, most))}
    for repetition in tqdm(range(repetitions), desc="design"):
        for name, error in errors.items():
            rng = np.random.default_rng([seed, repetition])  # the same truth and the same first demonstration
            psi, learned = experiment.truth(rng), np.zeros(experiment.problem.n_parameters)
            left = list(rng.permutation(len(experiment.places)))
            demos: list[Demonstration] = []
            for step in range(most):
                if name == "most informative" and demos:
                    found = identify(experiment.problem, demos, learned, experiment.spread, noise, METHOD)
                    candidates = [experiment.places[i] for i in left]
                    gains = expected_information(experiment.problem, found, candidates, METHOD)
                    left.insert(0, left.pop(int(np.argmax(gains))))
                demos.append(experiment.demonstrate(experiment.places[left.pop(0)], psi, noise, rng))
                learned = experiment.learn(demos, learned, noise, prior=True)
                error[repetition, step] = np.sqrt(np.mean((learned - psi) ** 2))
    return errors


def needed(errors: Array, bar: float) -> Array:
    """Demonstrations (repetitions,) until the error stays below the bar; one more than there are if it never does."""
    below = np.flip(np.minimum.accumulate(np.flip(errors < bar, axis=1), axis=1), axis=1)
    return np.where(below.any(axis=1), below.argmax(axis=1), errors.shape[1]) + 1


def draw(errors: dict[str, Array], bar: float, path: Path) -> Path:
    figure, (axis,) = figures.new_figure(1, 1, width=5.5, height=3.6)
    for colour, (name, values) in zip(figures.COLOURS, errors.items(), strict=False):
        counts = np.arange(1, values.shape[1] + 1)
        low, middle, high = np.percentile(values, [25, 50, 75], axis=0)
        axis.plot(counts, middle, ".-", color=colour, label=f"{name} (median, quartiles)")
        axis.fill_between(counts, low, high, color=colour, alpha=0.15, lw=0)
    axis.axhline(bar, color=figures.GREY, linestyle=":")
    axis.set(xlabel="demonstrations", ylabel="r.m.s. error of log-weights", ylim=(0, None))
    axis.grid(alpha=0.3, which="both")
    axis.legend(title="next demonstration", fontsize=8)
    return figures.save(figure, path)


def main(args: Namespace) -> None:
    if args.demonstrations > args.places:
        raise OptionError("--demonstrations cannot be more than the --places to choose from")
    covered: dict[str, dict[str, float]] = {}
    with kept_if_interrupted(
        args.out, vars(args), {"coverage": covered}, lambda: f"{len(covered)} of 3 rows of coverage"
    ):
        measure(args, covered)


def measure(args: Namespace, covered: dict[str, dict[str, float]]) -> None:
    """Both experiments; rows of coverage are put into `covered` as they come."""
    experiment = Experiment.reaching(args.places, args.seed, spread=0.5)
    for name, count, goal_seen in (
        ("one demonstration, data and spread", 1, False),
        ("five demonstrations, data alone", 5, False),
        ("one, data and spread, goal = a noisy view", 1, True),
    ):
        repetitions = -(-args.simulated // count)
        covered[name] = coverage(experiment, repetitions, count, args.noise, goal_seen, args.seed)
    header = ["90 % intervals from", "of weights", "of known directions", "known, of 9", "intervals"]
    keys = ("weights", "known directions", "known", "intervals")
    print(table(header, [[name, *(row[key] for key in keys)] for name, row in covered.items()]), "\n")

    bar = 0.2
    errors = design(
        replace(experiment, spread=1.0), args.design_repetitions, args.demonstrations, args.design_noise, args.seed
    )
    counts = {name: needed(values, bar) for name, values in errors.items()}
    rows = [[name, float(np.mean(counts[name])), *map(float, np.median(v, axis=0))] for name, v in errors.items()]
    print(table(["next demonstration", f"needed for {bar}", *map(str, range(1, args.demonstrations + 1))], rows))
    results = {"coverage": covered, "errors": errors, "bar": bar, "needed": counts}
    print(f"\nnumbers: {write_metrics(args.out, vars(args), results)}")
    print(f"figure:  {draw(errors, bar, args.out / 'design.png')}")
