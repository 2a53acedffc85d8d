"""Arrays of any shape, type, layout and content reach C in one form, or are refused; none is read past its end."""

import re
from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp import OCP, Ipopt, Riccati, Trajectory
from kpirl_ocp.errors import KpirlError
from kpirl_ocp.ocp.export import ExportedSolver, export_c
from kpirl_ocp.ocp.sensitivity import sensitivity
from kpirl_ocp.ocp.solvers import pull_many, solve_many
from kpirl_ocp.types import Multipliers, Solution, Status

T = 4
MULTIPLIERS = ["dynamics", "state", "action", "path", "path_equality", "terminal", "terminal_equality"]
ARGUMENTS = ([0.5, -0.2], [0.4, 1.0], [0.3])


@lru_cache
def problem():
    """Every kind of row that has a multiplier."""
    s, u, p, c = (ca.SX.sym(name, n) for name, n in (("s", 2), ("u", 2), ("p", 2), ("c", 1)))
    return OCP.from_expressions(
        state=s,
        action=u,
        parameters=p,
        context=c,
        horizon=T,
        dynamics=s + 0.3 * ca.vertcat(s[1], u[0] - ca.sin(s[0])) + 0.1 * u[1],
        stage_cost=ca.sumsqr(s - p) + 0.1 * ca.sumsqr(u),
        path_constraint=u[0] + u[1] - 1.2,
        path_equality=u[1] - 0.2 * s[0] * c,
        terminal_constraint=s[0] - 5,
        terminal_equality=s[1] - 0.1,
        action_bounds=(-2, 2),
        state_bounds=(-9, 9),
    )


@lru_cache
def plan():
    found = Riccati().solve(problem(), *ARGUMENTS)
    found.raise_if_failed()
    return found


def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported")
    export_c(problem(), Riccati(), folder, psi=ARGUMENTS[1])
    return ExportedSolver(folder)


def strided(array):
    """Every other entry of an array twice as large, backwards, whose gaps are NaN."""
    wide = np.full(tuple(2 * n for n in array.shape), np.nan)
    view = wide[tuple(slice(None, None, -2) for _ in array.shape)]
    view[...] = array
    return view


def read_only(array):
    copy = array.copy()
    copy.flags.writeable = False
    return copy


def unaligned(array):
    memory = np.zeros(array.nbytes + 1, np.uint8)[1:]
    view = memory.view(float).reshape(array.shape)
    view[...] = array
    return view


SAME = {
    "Fortran": np.asfortranarray,
    "strided": strided,
    "read only": read_only,
    "unaligned": unaligned,
    "other end first": lambda array: array.astype(">f8"),
    "list": lambda array: array.tolist() if array.size else array,
    "long double": lambda array: array.astype(np.longdouble),
}
OTHER = {
    "a row less": lambda array: array[:-1],
    "a row more": lambda array: np.concatenate([array, array[-1:]]),
    "far less": lambda array: array[:0],
    "far more": lambda array: np.zeros((1000, *array.shape[1:])),
    "transposed": lambda array: array.T if array.ndim == 2 and array.shape[0] != array.shape[1] else array[None],
    "flat": lambda array: array.ravel() if array.ndim == 2 else array[:, None],
    "one axis more": lambda array: array[None],
    "a number": lambda array: 0.0,
    "words": lambda array: "abc",
    "objects": lambda array: np.full(array.shape, object()),
    "complex": lambda array: array + 1j,
    "nothing": lambda array: np.zeros(0),
    "a lonely axis": lambda array: array[..., None],
}
BAD = {
    "NaN": lambda array: np.full_like(array, np.nan),
    "infinite": lambda array: np.full_like(array, np.inf),
    "huge": lambda array: np.full_like(array, 1e308),
    "tiny": lambda array: np.full_like(array, 5e-324),
    "integers": lambda array: np.zeros(array.shape, np.int8),
    "single": lambda array: array.astype(np.float32),
    "all the same memory": lambda array: np.broadcast_to(np.float64(0.1), array.shape),
}
PLACES = ["states", "actions", *MULTIPLIERS]


def changed(place, change):
    """The plan with one array changed."""
    one = plan()
    if place in MULTIPLIERS:
        given = vars(one.multipliers)
        return replace(one, multipliers=Multipliers(**given | {place: change(given[place])}))
    return replace(one, trajectory=replace(one.trajectory, **{place: change(getattr(one, place))}))


def uses(guess):
    """Everything that hands a solution to C."""
    slopes = np.ones((1, T + 1, 2)), np.ones((1, T, 2))
    yield lambda: Riccati().solve(problem(), *ARGUMENTS, guess=guess)
    yield lambda: Riccati(max_iterations=3).solve(problem(), *ARGUMENTS, guess=Trajectory(guess.states, guess.actions))
    yield lambda: Ipopt(max_iterations=3).solve(problem(), *ARGUMENTS, guess=guess)
    yield lambda: solve_many(problem(), [ARGUMENTS[0]], *ARGUMENTS[1:], guesses=[guess], threads=1)
    yield lambda: pull_many(problem(), [guess], *slopes, policy="flag", threads=1)
    yield lambda: sensitivity(problem(), guess, "flag").push(psi=[1.0, 0.0])


def answer(call):
    """What a call returns; None where it is refused, in one line."""
    try:
        return call()
    except KpirlError as error:
        message = str(error)
    assert re.fullmatch(".+", message)
    return None


def refused(call):
    return answer(call) is None


def finite(result, *names):
    return all(np.isfinite(getattr(result, name)).all() for name in names)


def assert_sound(result):
    """A plan that is called a solution is one, and a gradient that is certified has numbers."""
    if isinstance(result, list):
        for one in result:
            assert_sound(one)
    elif isinstance(result, Solution):
        assert isinstance(result.status, Status)
        assert not result.status.ok or finite(result, "states", "actions", "objective")
    elif result is not None and result.certificate.certified:
        assert finite(result, *(("psi", "s0", "context") if hasattr(result, "psi") else ("states", "actions")))


@pytest.mark.parametrize("place", PLACES)
def test_arrays_of_other_shapes_and_kinds_are_refused_everywhere(place):
    for name, change in OTHER.items():
        if change is OTHER["a row less"] and getattr(plan().multipliers, place, plan().states).size == 0:
            continue
        try:
            guess = changed(place, change)
        except KpirlError:  # no numbers
            continue
        taken = [index for index, call in enumerate(uses(guess)) if not refused(call)]
        allowed = {1} if place in MULTIPLIERS else set()  # a trajectory has no multipliers
        assert set(taken) <= allowed, (name, taken)


@pytest.mark.parametrize("place", PLACES)
def test_numbers_of_any_size_end_in_a_status(place):
    for change in BAD.values():
        for call in uses(changed(place, change)):
            assert_sound(answer(call))


@pytest.mark.parametrize("place", PLACES)
def test_the_layout_of_an_array_changes_no_bit(place):
    expected = Riccati().solve(problem(), *ARGUMENTS, guess=plan())
    for name, change in SAME.items():
        found = Riccati().solve(problem(), *ARGUMENTS, guess=changed(place, change))
        for part in ("states", "actions"):
            assert getattr(found, part).tobytes() == getattr(expected, part).tobytes(), name
        for part in MULTIPLIERS:
            assert getattr(found.multipliers, part).tobytes() == getattr(expected.multipliers, part).tobytes(), name


@pytest.mark.parametrize("name", SAME)
def test_the_layout_of_arguments_and_slopes_changes_no_bit(name):
    change, rng = SAME[name], np.random.default_rng(0)
    arguments = [change(np.array(value)) for value in ARGUMENTS]
    assert Riccati().solve(problem(), *arguments).states.tobytes() == plan().states.tobytes()
    assert solve_many(problem(), *arguments, threads=1)[0].states.tobytes() == plan().states.tobytes()
    slopes, move = (rng.normal(size=(T + 1, 2)), rng.normal(size=(T, 2))), rng.normal(size=2)
    at = sensitivity(problem(), plan(), "flag")
    moved = sensitivity(problem(), replace(plan(), psi=change(plan().psi), context=change(plan().context)), "flag")
    for part in ("psi", "s0", "context"):
        expected = getattr(at.pull(*slopes), part).tobytes()
        assert getattr(at.pull(*map(change, slopes)), part).tobytes() == expected
        assert getattr(moved.pull(*slopes), part).tobytes() == expected
    assert at.push(psi=change(move)).states.tobytes() == at.push(psi=move).states.tobytes()
    for place in PLACES:
        tangent = sensitivity(problem(), changed(place, change), "flag").push(psi=move)
        assert tangent.states.tobytes() == at.push(psi=move).states.tobytes(), place


def test_a_solution_keeps_its_numbers_when_the_callers_arrays_change():
    """As psi -= rate * gradient changes them."""
    psi, s0 = np.array(ARGUMENTS[1]), np.array(ARGUMENTS[0])
    found = Riccati().solve(problem(), s0, psi, ARGUMENTS[2])
    psi += 1.0
    s0 += 1.0
    np.testing.assert_array_equal(found.psi, ARGUMENTS[1])
    np.testing.assert_array_equal(found.states[0], ARGUMENTS[0])


def test_exported_code_gets_arrays_of_one_form_or_none(tmp_path_factory):
    ours = exported(tmp_path_factory)
    expected = ours.solve(problem(), *ARGUMENTS, guess=plan())
    for place in PLACES:
        for name, change in OTHER.items():
            if name == "a row less" and place in MULTIPLIERS and not vars(plan().multipliers)[place].size:
                continue
            assert refused(lambda p=place, c=change: ours.solve(problem(), *ARGUMENTS, guess=changed(p, c))), place
            assert refused(lambda p=place, c=change: ours.shift(problem(), changed(p, c))), place
        for change in BAD.values():
            assert_sound(ours.solve(problem(), *ARGUMENTS, guess=changed(place, change)))
        for name, change in SAME.items():
            found = ours.solve(problem(), *map(change, map(np.array, ARGUMENTS)), guess=changed(place, change))
            assert found.actions.tobytes() == expected.actions.tobytes(), (place, name)


def batched(argument=None, change=None, guess=None):
    """A plan of the layer for a batch of two, with one argument changed as far as torch knows such an array."""
    torch = pytest.importorskip("torch")
    from kpirl_ocp.bridges import OCPLayer

    def tensor(value):
        try:
            return torch.as_tensor(value.copy()) if isinstance(value, np.ndarray) else value
        except (TypeError, ValueError):
            return value

    s0, psi, context = (np.array([value] * 2) for value in ARGUMENTS)
    given = {"psi": psi, "s0": s0, "context": context}
    if argument:
        given[argument] = change(given[argument])
    return OCPLayer(problem())(*map(tensor, given.values()), guess=guess)


@pytest.mark.parametrize("argument", ["psi", "s0", "context"])
def test_layers_take_what_fits_and_refuse_the_rest(argument):
    expected = batched().states.numpy().tobytes()
    for name, change in SAME.items():
        found = answer(lambda change=change: batched(argument, change))
        assert found is None or found.states.numpy().tobytes() == expected, name
    for name, change in OTHER.items():
        assert refused(lambda change=change: batched(argument, change)), name
    for change in BAD.values():
        found = answer(lambda change=change: batched(argument, change))
        assert_sound([] if found is None else list(found.solutions))


@pytest.mark.parametrize("place", PLACES)
def test_layers_refuse_guesses_that_do_not_fit(place):
    assert refused(lambda: batched(guess=[plan()]))
    assert batched(guess=[plan(), None]).states.shape == (2, T + 1, 2)
    for name, change in OTHER.items():
        if name == "a row less" and place in MULTIPLIERS and not vars(plan().multipliers)[place].size:
            continue
        assert refused(lambda change=change: batched(guess=[changed(place, change), None])), name
