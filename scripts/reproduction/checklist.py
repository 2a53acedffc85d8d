"""The paper's statements, one by one: the same here, different because of something, or not tested.

A row points to a claim by the beginning of its text, and then its verdict is measured; the other rows are about how
things are done, and say where.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from reproduction.outcome import Claim, Outcome, claims
from reproduction.page import Page


class Row(NamedTuple):
    """A statement. verdict: what is to be said of it; or claims: the beginnings of those that test it."""

    section: str
    statement: str
    verdict: str = ""
    claims: tuple[str, ...] = ()


ROWS = (
    Row("3.1", "An autoencoder with a structural bottleneck detects K = 4 keypoints (x, y, intensity).", "same"),
    Row(
        "3.1",
        "The detector follows Minderer et al.; appendix A.1: a mini ResNet-18, images of 240 x 240.",
        "differs: images of 240 x 240 are scaled to 96 x 96 for the network, as a training step at full size takes 18 "
        "times as long (4.7 instead of 0.26 CPU seconds); and losses are added without which keypoints leave the "
        "object (docs: From pixels)",
    ),
    Row("A.2", "108 sequences of 10 frames, random configurations, only the last joint moves.", "same, simulated"),
    Row(
        "3.1",
        "Dynamics from sine motions for simple tasks; for complex ones from expert demonstrations.",
        "same",
    ),
    Row(
        "A.1",
        "Keypoint predictor with 100 and 25 neurons and ReLU; joints integrate the action.",
        "differs: tanh in the shipped models, so that a converged plan can be differentiated (ReLU is measured, "
        "too), and the network predicts the change of the keypoints. Joints and velocities: same",
    ),
    Row(
        "A.3",
        "Sine motions move joints 2, 4 and 6 the most, so that the arm stays in plane.",
        "differs: plans move joints 2, 4 and 6 only; the network's small responses to the others are cut off",
    ),
    Row(
        "A.3",
        "Detector at 30 Hz and a controller at 5 Hz or 1 Hz, asynchronous.",
        "same in a table (reaching) and a condition of their own (robustness); elsewhere the detector looks when the "
        "controller asks, and the simulation waits",
    ),
    Row("A.3", "Dynamics for reaching: NMSE 0.3; for placing: 0.03.", "differs: lower in both (docs: From pixels)"),
    Row(
        "A.3",
        "Placing dynamics from self-supervised data, expert controllers and data augmentation.",
        "same: sines at 1 Hz, an expert, and both backwards and with noise; the paper does not say which augmentation",
    ),
    Row(
        "3.2",
        "Actions by gradient descent on the cost of the predicted trajectory (Equation 1, Algorithm 3).",
        "same: one update, as in Equation 4 and Algorithm 3; also with more steps, chosen on validation data, and "
        "converged",
    ),
    Row(
        "4, Alg. 1",
        "psi by gradient descent, eta = 0.001, alpha = 0.01.",
        "differs: Adam at 0.01 as in the authors' "
        "code; plain descent at 0.001 is the contender 'to the letter'. Section 5 prints 0.001 for actions",
    ),
    Row(
        "4",
        "Deterministic, fixed horizon, discrete time; state: joints, velocities, keypoints; plans start at u = 0.",
        "same",
    ),
    Row(
        "4.1",
        "The gradient goes through the inner loop (with `higher`).",
        "same gradient, by hand-arranged passes; equal to torch to 1e-13 (tests)",
    ),
    Row(
        "4",
        "A gradient through the inner loop, and not the separation of both loops, is why learning is stable.",
        "not tested as a cause; learning of both kinds is compared",
    ),
    Row("4.2", "IRL loss: squared distance of keypoints, summed over time.", "same"),
    Row("4.2", "Weighted, TimeDep and RBF costs.", "same; weights are free to become negative, in the paper and here"),
    Row(
        "4.2",
        "RBF kernels exp(b (t - mu)^2), uniformly spaced, with some overlap.",
        "same, five kernels as in the figures, b < 0 so that neighbours cross at half their height",
    ),
    Row(
        "4.3",
        "Simulation: known model, 3-D keypoints, Weighted cost, one demonstration, five tests.",
        "same; demonstrations are ours, the paper does not describe its own",
    ),
    Row(
        "4.3",
        "Our algorithm converges; the baseline oscillates between good and bad solutions.",
        claims=("Reaching: apprenticeship learning is unstable",),
    ),
    Row(
        "4.3",
        "Apprenticeship learning with per-step IRL losses as features, minimal distance 1 (A.4).",
        "tested with eight choices of features, program and sign (table in the simulation study): the minimal distance "
        "has no effect, as weights are scaled to length one; the cited code's program has no solution with these "
        "features, which are zero for the expert",
    ),
    Row(
        "5.1",
        "15 demonstrations along x, T = 25 at 5 Hz; 1 or 10 to learn from, 5 to test; 3 seeds.",
        "same, with a simulated arm and camera",
    ),
    Row("5.1", "The same detector in all experiments; plans with the learning rate of training.", "same"),
    Row("5.1", "Default: squared distance to the goal, summed over time.", "same"),
    Row(
        "5.1",
        "One of the four keypoints (red) is fixed in the background.",
        "differs: ours all sit on the object; a fifth, fixed keypoint is added in a table of its own",
    ),
    Row(
        "5.1.1",
        "Relative distance with all three learned costs is considerably less than with both baselines.",
        claims=("Reaching, 1 demonstration, one step", "Reaching, 10 demonstrations, one step"),
    ),
    Row(
        "5.1.1",
        "The same measured for the x of the three least noisy keypoints.",
        "same, for the x of the keypoints that move (all four): the table's column 'x of moving'",
    ),
    Row("5.1.1", "One demonstration does about as well as ten.", claims=("Reaching, one step: one demonstration",)),
    Row(
        "5.1.1",
        "All learned costs give relatively small weights to y.",
        claims=("Reaching: Weighted", "Reaching: TimeDep", "Reaching: RBF"),
    ),
    Row(
        "5.1.1",
        "... and to the red keypoint.",
        "explained: a keypoint that no action moves has no gradient and keeps "
        "its start exactly; with the start of the authors' code that is small",
    ),
    Row(
        "5.1.1",
        "The baseline's weights are much smaller, with a similar structure, and it performs far worse.",
        claims=("Reaching, 1 demonstration, one step", "Reaching: Apprenticeship gives y less"),
    ),
    Row(
        "5.1.1",
        "A learning rate tuned at test time would improve the baseline; learned costs need none.",
        "not tested: all plan with the rate of training",
    ),
    Row(
        "5.1.1",
        "Its procedure was very unstable, and it was unclear whether it would converge.",
        claims=("Reaching: apprenticeship learning is unstable",),
    ),
    Row(
        "5.2",
        "A human demonstration at 30 Hz, downsampled to 5 Hz, relative to its first frame.",
        "same, but the hand is made of primitives in the simulated scene",
    ),
    Row("5.2", "The object first moves along x only, then along y only.", "same"),
    Row("5.2", "No joint angles of the demonstrator are known.", "same: keypoints of the video alone"),
    Row("5.2", "Two starting configurations, one near the demonstration's start, one nearer to the goal.", "same"),
    Row(
        "5.2",
        "Costs trained for 5000 gradient steps; the loss converges around 2K.",
        claims=("Placing: the loss converges",),
    ),
    Row(
        "5.2",
        "Time-dependent weights stress x in the first half and y in the second.",
        claims=("Placing: TimeDep stresses", "Placing: RBF stresses"),
    ),
    Row(
        "5.2.1",
        "T = 10 joint displacements, executed on the arm.",
        "same, simulated; bottle and gripper collide with the furniture, the links of the arm do not",
    ),
    Row(
        "5.2.1",
        "TimeDep and RBF do much better than Default; Weighted on one start only (Table 1).",
        claims=("Placing from start 1, one step", "Placing from start 2, one step", "Placing, one step"),
    ),
    Row("5.2.1", "Standard deviations over executions.", "same, in addition to those over seeds"),
    Row("5", "Hardware: a Kuka iiwa and a camera.", "not tested: all of it is simulated (PyBullet)"),
    Row(
        "6",
        "Future work: a view-invariant detector, demonstrations from another perspective.",
        "not tested here (films from a camera of one's own: docs: Your own video)",
    ),
)


def write(page: Page, outcome: Outcome) -> None:
    """The table."""
    page.heading("Checklist: the paper, statement by statement")
    found = claims(outcome)
    page.table(["section", "the paper", "here"], [[r.section, r.statement, verdict(r, found)] for r in ROWS])


def verdict(row: Row, found: Sequence[Claim]) -> str:
    """Measured where there are claims: how many hold, and which do not."""
    if not row.claims:
        return row.verdict
    tested = [claim for claim in found if claim.text.startswith(row.claims)]
    failed = [claim for claim in tested if not claim.holds]
    if not tested:
        return "not tested in this run"
    if not failed:
        return f"same: {len(tested)} of {len(tested)} tests hold"
    return f"differs: {len(tested) - len(failed)} of {len(tested)} tests hold; not " + " Not ".join(
        f"'{claim.text}' ({claim.numbers})" for claim in failed
    )
