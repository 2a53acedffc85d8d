"""The quick profile of `make stress`: generated cases with known answers, statuses, long lives, and kills."""

import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

from bench.control_problems import problems
from stress import bars
from stress.certificates.contest import count
from stress.certificates.families import FAMILIES, draw
from stress.certificates.steps import is_smooth, steps_for
from stress.certificates.verdicts import Verdict, healthy, judge, stated
from stress.kills.campaign import torment
from stress.kills.programs import PROGRAMS
from stress.lives import memory
from stress.peers import casadi_sensitivities
from stress.peers.program import Program
from stress.peers.rates import Answer, answer
from stress.settings import PROFILES
from stress.starts import board, minimum_time, obstacles
from stress.starts.systems import SYSTEMS
from stress.statuses import confirmed

from kpirl_ocp import FiniteDifference, Implicit, Ipopt, Riccati, Status, Unrolled
from kpirl_ocp.errors import CertificateError
from kpirl_ocp.ocp.codegen import compiler as native
from kpirl_ocp.ocp.conditions.audit import audit

pytestmark = pytest.mark.usefixtures("virtual_machine")

QUICK = PROFILES["quick"]


MET = {
    "certificates": {"wrong": [], "healthy": 0.951},
    "statuses": {"wrong": []},
    "starts": {"all": {"lost": 0, "many": 0, "mean": 0.69}},
    "obstacles": {"all": {"lost": 0}},
    "lives": {"solves": {"middle": 100.0, "end": 119.0, "handles": 0}},
    "kills": {"learning": {"different": [], "left": []}},
}


@pytest.mark.parametrize(
    ("part", "numbers", "said"),
    [
        ("certificates", {"wrong": [17], "healthy": 0.951}, "certified and wrong: cases [17]"),
        ("certificates", {"wrong": [], "healthy": 0.949}, "94.9 % of the healthy cases"),
        ("statuses", {"wrong": [("SQP", 3)]}, "not confirmed"),
        ("starts", {"all": {"lost": 1, "many": 0, "mean": 0.69}}, "noisy starts"),
        ("obstacles", {"all": {"lost": 1}}, "between obstacles"),
        ("starts", {"all": {"lost": 0, "many": 1, "mean": 0.69}}, "noisy starts"),
        ("starts", {"all": {"lost": 0, "many": 0, "mean": 0.71}}, "noisy starts"),
        ("starts", {"all": {"lost": 0, "many": 0, "mean": np.nan}}, "noisy starts"),
        ("lives", {"solves": {"middle": 100.0, "end": 121.0, "handles": 0}}, "solves: memory or open files grow"),
        ("lives", {"solves": {"middle": 100.0, "end": 100.0, "handles": 1}}, "solves: memory or open files grow"),
        ("kills", {"learning": {"different": ["cost.json"], "left": []}}, "learning does not go on"),
        ("kills", {"learning": {"different": [], "left": [".x.part"]}}, "learning does not go on"),
    ],
)
def test_every_bar_that_is_missed_is_a_sentence_and_those_that_are_met_are_none(part, numbers, said):
    assert bars.broken({}) == bars.broken(MET) == []
    (sentence,) = bars.broken(MET | {part: numbers})
    assert said in sentence


@pytest.fixture(scope="module")
def contest():
    return count(range(QUICK.cases))


def test_no_case_is_certified_and_wrong(contest):
    assert contest[1] == []


@pytest.mark.parametrize("index", [17, 32, 309, 351, 359])
def test_differences_that_agree_are_not_certified_where_they_are_wrong(index):
    """Saddles, flat minima, a change of the active set and a kink between psi and the nearest difference."""
    assert judge(draw(index), "FiniteDifference") is not Verdict.WRONG


@pytest.mark.parametrize(("index", "verdict"), [(16, "RIGHTLY_FLAGGED"), (22, "RIGHT")])
def test_gradients_of_gradient_steps_are_those_of_the_steps(index, verdict):
    assert judge(draw(index), "Unrolled") is Verdict[verdict]


def test_most_healthy_gradients_of_steps_are_certified_and_none_that_is_wrong(monkeypatch):
    monkeypatch.setattr(native, "compiler", lambda: None)  # for functions that are called a few times
    counts, wrong = count(range(0, 80, 2), "Unrolled")
    total = sum(counts.values(), Counter())
    assert wrong == []
    assert healthy(total) >= 0.95
    assert min(total[verdict] for verdict in (Verdict.RIGHT, Verdict.RIGHTLY_FLAGGED)) >= 5


@pytest.mark.parametrize("index", [94, 140, 198, 250])
def test_a_gradient_of_steps_that_diverge_is_not_certified(index):
    """Rounding is enlarged with all else: 1e13 to 1e62 times. Differences at six steps agree with no such gradient."""
    case = draw(index)
    with pytest.raises(CertificateError, match="The steps diverge: they enlarge differences"):
        Unrolled(steps_for(case), case.loss)(case.problem, case.demonstration, case.psi, case.guess)


@pytest.mark.parametrize(("index", "smooth"), [(22, True), (202, False), (840, True), (20, False)])
def test_what_steps_make_of_psi_is_smooth_or_not_by_its_values_alone(index, smooth):
    """Smooth; with a kink; smooth, though rounding is enlarged; and steps that end far above where they began."""
    case = draw(index)
    assert is_smooth(case, steps_for(case)) is smooth


def test_constraints_that_gradient_steps_do_not_honour_are_no_cases_for_them():
    by_family = {case.family: case for case in map(draw, range(60))}
    case = by_family["linear-quadratic with active constraints"]
    assert not stated(case, "Unrolled")
    assert stated(case, "Implicit")
    assert stated(by_family["unconverged"], "Unrolled")


def test_a_gradient_of_smooth_steps_that_holds_next_to_psi_alone_is_not_certified():
    """Steps that are too long for a quartic: at 1e-10 of psi the slopes are those of the gradient, at 1e-6 others."""
    case = draw(3652)
    found = Unrolled(steps_for(case), case.loss, "flag")(case.problem, case.demonstration, case.psi, case.guess)
    assert 1e6 < found.certificate.remainder < 1e8
    assert len(found.certificate.failures) == 1
    assert found.certificate.failures[0].startswith("The steps end on a kink or cross one, or they diverge")


@pytest.mark.parametrize("index", [7, 631])
def test_slow_steps_in_units_of_a_small_cost_are_not_taken_for_rounding(index):
    case = draw(index)
    given = (case.demonstration.s0, case.psi, case.demonstration.context)
    assert case.solver.solve(case.problem, *given, guess=case.guess).status is Status.CONVERGED


@pytest.mark.parametrize("index", [202, 264])
def test_a_gradient_of_steps_that_end_on_a_kink_of_the_cost_is_not_certified(index):
    """The cost bends in an action: the slopes of the loss to both sides differ, or the steps go to and fro."""
    case = draw(index)
    with pytest.raises(CertificateError, match="The steps end on a kink or cross one"):
        Unrolled(steps_for(case), case.loss)(case.problem, case.demonstration, case.psi, case.guess)


def test_an_acceptable_solution_that_newton_steps_still_move_is_not_certified():
    """A fold in odd units: the solver stops at 1.4 % of an action, and says that rounding leaves no more."""
    assert judge(draw(6111)) is not Verdict.WRONG


def test_most_healthy_cases_are_certified(contest):
    total = sum(contest[0].values(), Counter())
    assert healthy(total) >= 0.95
    assert contest[0].keys() == FAMILIES.keys()
    assert min(total[verdict] for verdict in (Verdict.RIGHT, Verdict.RIGHTLY_FLAGGED)) >= QUICK.cases // 4


def test_derivatives_of_steep_functions_are_certified_where_they_hold_over_a_millionth_of_psi():
    verdicts = Counter(judge(draw(index)) for index in range(8, 1208, 20))
    assert verdicts[Verdict.WRONG] == 0
    assert min(verdicts[Verdict.RIGHT], verdicts[Verdict.RIGHTLY_FLAGGED]) >= 10


def test_a_corner_that_the_plan_meets_beside_psi_is_seen_though_it_does_not_lie_along_the_adjoint():
    """It is 1.2e-7 away, rounded within 3e-10: the slope is 8.3 here and to one side, 1.1 to the other."""
    case = FAMILIES["steep, but smooth"](np.random.default_rng([7, 221]), True)
    found = Implicit(case.solver, case.loss, "flag")(case.problem, case.demonstration, case.psi, case.guess)
    assert case.truth(found.certificate.solution.trajectory).gradient is None
    assert not found.certificate.certified
    assert found.certificate.failures[0].startswith("Derivatives disagree with differences")


def test_known_answers_agree_with_finite_differences():
    compared = 0
    for index in (index for index in range(0, 120, 2) if draw(index).due):
        case = draw(index)
        method = FiniteDifference(Ipopt(tolerance=1e-12), case.loss, step=1e-4, policy="flag")
        found = method(case.problem, case.demonstration, case.psi, case.guess)
        if found.certificate.certified:
            compared += 1
            assert case.truth(found.certificate.solution.trajectory).agrees(found.gradient), index
    assert compared >= 20


def test_a_peer_is_judged_by_the_same_answers():
    """CasADi's own derivative is right on a smooth case; a wrong number is silently wrong, NaN is a refusal."""
    case = next(case for case in map(draw, range(0, 100, 2)) if case.family == "smooth")
    gradient, plan = casadi_sensitivities.gradient(Program(case))
    assert case.truth(plan).agrees(gradient)
    assert answer(casadi_sensitivities.gradient, case) is Answer.RIGHT
    assert answer(lambda _: (gradient + 1, plan), case) is Answer.SILENTLY_WRONG
    assert answer(lambda _: (np.nan * gradient, plan), case) is Answer.REFUSED


def test_statuses_of_random_problems_are_confirmed():
    counts, wrong, pairs = confirmed.count(QUICK.statuses)
    assert wrong == []
    assert sum(map(len, pairs.values())) == QUICK.statuses
    for name in ("Riccati", "Ipopt"):
        assert counts[name][confirmed.COLUMNS[0]] >= 0.9 * QUICK.statuses


def raced(name, seeds):
    """Runs of `Riccati` and `Ipopt` from noisy starts of a system."""
    return board.race({name: SYSTEMS[name]().start}, seeds)[name]


@pytest.mark.parametrize("name", ["pendulum swing-up", "LQR, bounds on states too", "unicycle, parking"])
def test_nothing_that_ipopt_solves_from_a_noisy_start_is_lost(name):
    found = board.summary(raced(name, range(8)))
    assert (found["starts"], found["lost"], found["won"]) == (8, 0, 0)
    assert found["mean"] < 0.9


@pytest.mark.parametrize("unicycle", [False, True], ids=["point mass", "unicycle"])
@pytest.mark.parametrize("straight", [False, True], ids=["from rest", "straight"])
def test_a_way_between_obstacles_is_found(unicycle, straight):
    """Whatever Ipopt says of them: it finds a way in three quarters of such cases."""
    for seed in range(6):
        problem, s0, psi, context, guess = obstacles.start(unicycle, straight, seed)
        found = Riccati().solve(problem, s0, psi, context, guess).raise_if_failed()
        assert audit(problem, psi, context, found.trajectory, found.multipliers).worst <= 1e-8


@pytest.mark.parametrize("name", ["quadrotor in a plane", "crane"])
def test_a_shortest_time_is_found_from_a_cold_start(name):
    for seed in range(3):
        problem, s0, psi, context, guess = minimum_time.start(name, seed)
        ours, theirs = (solver.solve(problem, s0, psi, context, guess) for solver in (Riccati(), Ipopt()))
        assert ours.status is theirs.status is Status.CONVERGED
        assert audit(problem, psi, context, ours.trajectory, ours.multipliers).worst <= 1e-8
        assert ours.objective == pytest.approx(problem.static_of(ours)[0], rel=1e-9)


@pytest.mark.parametrize("seed", [16, 23, 35])
def test_multipliers_of_equalities_that_contradict_each_other_are_forgotten(seed):
    """No turn moves a unicycle at rest aside: a first step leaves 1e7 times what the end is off as multipliers.

    With these in the Hessian, plans took 2.5 to 4 times Ipopt's iterations.
    """
    given = obstacles.start(True, True, seed)
    ours, theirs = (solver.solve(*given).raise_if_failed() for solver in (Riccati(), Ipopt()))
    assert ours.iterations <= 1.2 * theirs.iterations
    assert ours.objective == pytest.approx(theirs.objective, rel=1e-8)


LOST = {
    "quadrotor": (0, 24, 108, 112),
    "chain of masses": (35, 155, 191),
    "rocket landing in a cone": (35,),
    "cart-pole swing-up": (123, 199),
    "quadrotor, two obstacles": (100007,),
    "2R arm, reaching": (58,),
}


@pytest.mark.parametrize(("name", "seed"), [(name, seed) for name, seeds in LOST.items() for seed in seeds])
def test_starts_that_were_lost_are_solved(name, seed):
    """Tumbling through gimbal lock, which takes costates, along the dynamics too; slacks far below what is tolerated of
    a violation; lifted steps that end far from feasible, or below rounding; a point that restoration shows to be
    infeasible, but not others.
    """
    ((ours, theirs),) = raced(name, [seed])
    assert ours.converged
    assert theirs.converged


@pytest.mark.parametrize("seed", [0, 12, 24])
def test_a_first_step_without_costates_that_leads_into_gimbal_lock_is_taken_back(seed):
    """Its Hessian is far from positive then: going on from there took twice Ipopt's iterations."""
    ((ours, theirs),) = raced("quadrotor", [seed])
    assert ours.converged
    assert ours.iterations <= 1.2 * theirs.iterations


def test_steps_that_the_filter_shortens_for_their_second_order_are_corrected():
    """Where lengths were cut to a 64th, the swing-up took 2.8 times Ipopt's iterations."""
    ((ours, theirs),) = raced("cart-pole swing-up", [10])
    assert ours.converged
    assert ours.iterations <= 1.2 * theirs.iterations


@pytest.mark.parametrize("case", [254, 962])
def test_one_step_that_leads_nowhere_leaves_tau_within_reach(case):
    """Slacks times multipliers would grow a millionfold; with tau in proportion it took up to four times as long."""
    problem, numbers = confirmed.random_problem(case)
    ours, theirs = (solver.solve(problem, *numbers) for solver in (Riccati(), Ipopt()))
    assert ours.status is Status.CONVERGED
    assert ours.iterations <= 1.5 * theirs.iterations


@pytest.mark.parametrize("case", [85, 567, 681, 875, 1040, 4348, 4953, 7919, 21413, 21646, 21821])
def test_nonlinear_cases_in_odd_units_converge(case):
    """Multipliers that grow a millionfold; steps along the dynamics that close a gap at any price; a filter that forgot
    at every tau, though there was no inequality; turns between a large tau and a small one, each with a new filter
    (4348, 4953); steps as short as the first weight makes them, though a smaller one would do (85, 681, 7919).
    """
    given = draw(case)
    learner = given.demonstration
    found = given.solver.solve(given.problem, learner.s0, given.psi, learner.context, guess=given.guess)
    assert found.status is Status.CONVERGED


@pytest.mark.parametrize("case", problems(tiny=False), ids=lambda case: case.name)
def test_control_problems_of_the_benchmark_take_at_most_half_as_many_iterations_again_as_with_ipopt(case):
    """From rest: the quadrotor took 1.9 times as many where weights just made its Hessian positive."""
    ours, theirs = (board.solved_quietly(solver, *case.arguments) for solver in (Riccati(), Ipopt()))
    assert ours.status is theirs.status is Status.CONVERGED
    assert ours.iterations <= 1.5 * theirs.iterations


def test_near_feasible_points_a_lower_cost_is_not_bought_with_any_violation():
    """The cart-pole took 47 iterations where steps might leave feasible points for any gain, Ipopt 38."""
    (case,) = (case for case in problems(tiny=False) if case.name == "cart-pole swing-up")
    ours, theirs = (solver.solve(*case.arguments).raise_if_failed() for solver in (Riccati(), Ipopt()))
    assert ours.iterations <= theirs.iterations


def test_seeds_that_are_reported_are_not_those_to_develop_on():
    assert board.REPORTED > 1000


def test_memory_and_handles_of_one_process_stay_flat():
    lives = memory.measure(QUICK).numbers
    assert [life["handles"] for life in lives.values()] == [0, 0]
    solves = lives["solves of one problem"]
    assert solves["end"] - solves["middle"] < 2  # MB


@pytest.mark.parametrize("name", ["data collection", "cost learning"])
def test_a_program_that_is_killed_goes_on_and_ends_with_the_same_bytes(name, tmp_path):
    (program,) = (program for program in PROGRAMS if program.name == name)
    if name == "data collection":
        for package in ("cv2", "pybullet", "torch"):
            pytest.importorskip(package)
        program = replace(program, words=[word.replace("60", "8") for word in program.words])
    found = torment(program, tmp_path, tmp_path, QUICK.kills)
    assert (found["different"], found["left"]) == ([], [])
