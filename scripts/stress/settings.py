"""Sizes of the campaigns: the quick profile is part of `make test`, the full one takes hours."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Profile:
    """cases: of the contest; peers take every `every`-th of them, other methods `others`.

    kills: of each program; every_program: also of those that take long.
    solves, problems: in one process. statuses: random problems.
    starts: noisy ones of each system. units: draws of each classic problem.
    obstacles: draws for each vehicle and guess. times: draws of each problem of a free final time.
    """

    cases: int
    every: int
    others: int
    kills: int
    every_program: bool
    solves: int
    problems: int
    statuses: int
    starts: int
    units: int
    obstacles: int
    times: int


PROFILES = {
    "quick": Profile(
        cases=300,
        every=10,
        others=20,
        kills=2,
        every_program=False,
        solves=1_000,
        problems=30,
        statuses=30,
        starts=1,
        units=1,
        obstacles=2,
        times=1,
    ),
    "full": Profile(
        cases=10_000,
        every=5,
        others=1_000,
        kills=20,
        every_program=True,
        solves=100_000,
        problems=1_000,
        statuses=1_000,
        starts=20,
        units=10,
        obstacles=40,
        times=40,
    ),
}
