"""The benchmark: all contenders compute the same, operations are counted right, and verdicts follow from numbers."""

import importlib
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp import Ipopt, Riccati
from kpirl_ocp.irl.cases.network_cases import placing_case

SCRIPTS = Path(__file__).parents[1] / "scripts"
HIDDEN, HORIZON, STEPS = (9, 5), 6, 5


@pytest.fixture
def bench(monkeypatch, virtual_machine):
    """Import modules of the benchmark by name; without compilation, which would take most of the time."""
    monkeypatch.syspath_prepend(SCRIPTS)
    for name in ("contenders", "stage_ipopt"):
        monkeypatch.setattr(f"bench.{name}.compiled", lambda function: function)
    return lambda name: importlib.import_module(f"bench.{name}")


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="processes cannot be tied to cores here")
def test_modules_of_the_benchmark_leave_the_process_its_cores():
    before = sorted(os.sched_getaffinity(0))
    code = "import os, bench.suite; print(sorted(os.sched_getaffinity(0)))"
    found = subprocess.run([sys.executable, "-c", code], cwd=SCRIPTS, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == str(before)


def random_data(bench, activation, count=1):
    return bench("problem").random_network(HIDDEN, HORIZON, STEPS, activation, count)


# Contenders


@pytest.mark.parametrize(
    ("module", "options", "activation"),
    [
        ("peer_torch", {}, "relu"),
        ("peer_torch", {}, "tanh"),
        ("peer_casadi", {}, "relu"),
        ("peer_casadi", {}, "tanh"),
        ("peer_jax", {}, "tanh"),
        ("peer_jax", {"unroll": 5}, "relu"),
    ],
)
def test_a_peer_computes_our_loss_and_gradient(module, options, activation, bench):
    pytest.importorskip({"peer_torch": "torch", "peer_casadi": "casadi", "peer_jax": "jax"}[module])
    data = random_data(bench, activation)
    loss, gradient = bench("contenders").ours(data)()
    other_loss, other = bench(module).unrolled(data, **options)()
    assert other_loss == pytest.approx(loss, rel=1e-12)
    np.testing.assert_allclose(other, gradient, rtol=0, atol=1e-12 * np.abs(gradient).max())


def test_jax_over_several_demonstrations_gives_our_means(bench):
    pytest.importorskip("jax")
    data = random_data(bench, "relu", count=3)
    loss, gradient = bench("contenders").ours(data)()
    other_loss, other = bench("peer_jax").unrolled(data)()
    assert other_loss == pytest.approx(loss, rel=1e-12)
    np.testing.assert_allclose(other, gradient, rtol=0, atol=1e-12 * np.abs(gradient).max())


def test_the_compiled_function_alone_is_the_public_call(bench):
    data = random_data(bench, "tanh")
    found = bench("race").differences(
        {"ours": bench("contenders").ours(data), "alone": bench("contenders").alone(data)}
    )
    assert found["alone"] <= 1e-13


def test_a_contender_that_is_not_installed_is_left_out_and_says_how_to_install_it(bench, monkeypatch):
    contenders, race = bench("contenders"), bench("race")
    monkeypatch.setattr(contenders.importlib.util, "find_spec", lambda name: None if name == "jax" else object())
    preset = bench("settings").PRESETS["tiny"]
    results = race.race(random_data(bench, "relu"), (contenders.JAX[0], contenders.OURS), preset)
    assert str(results[contenders.JAX[0]]) == "not installed: pip install .[bench]"
    assert results[contenders.OURS].timing.calls >= 1


def test_demonstrations_can_be_reached_with_the_model(bench):
    data = placing_case(HORIZON, STEPS, count=2)
    assert data.observed.shape == (2, HORIZON + 1, 8)
    np.testing.assert_array_equal(data.observed[:, 0], data.s0[:, :8])
    np.testing.assert_array_equal(data.goal, data.observed[:, -1])
    assert np.abs(data.observed).max() < 1  # within the image


@pytest.mark.parametrize("horizon", [1, 4])
def test_ipopt_with_our_stage_functions_solves_the_program_of_ipopt(horizon, bench):
    data = bench("problem").random_network(HIDDEN, horizon, STEPS, "tanh")
    arguments = data.s0[0], data.psi.ravel(), data.goal[0]
    expected = Ipopt().solve(data.bounded, *arguments)
    objective, trajectory, iterations, word = bench("stage_ipopt").StageIpopt(data.bounded, 1e-10).solve(*arguments)
    assert word == "Solve_Succeeded"
    assert iterations == expected.iterations
    assert objective == pytest.approx(expected.objective, rel=1e-12)
    np.testing.assert_allclose(trajectory.actions, expected.actions, atol=1e-10)


@pytest.mark.parametrize("model", ["random", "trained"])
def test_bounds_on_actions_and_joints_are_active_and_independent(model, bench):
    problem = bench("problem")
    data = problem.random_network((100, 25), 15, 1, "tanh") if model == "random" else placing_case(10, 1)
    solution = Riccati().solve(data.bounded, data.s0[0], data.psi.ravel(), data.goal[0])
    assert solution.status.ok
    assert (np.abs(solution.multipliers.action) > 1e-6).any()
    reach, room = data.reach, np.abs(np.asarray(data.bounded.state_bounds)[1, 1, 8:15] - data.s0[0, 8:15])
    assert (np.abs(room / reach - np.round(room / reach)) > 0.1).all()


# Operations


def test_products_are_counted_once_per_stage_in_maps_and_accumulations(bench):
    products = bench("flops").products
    matrix, s, u = ca.DM(np.random.default_rng(0).normal(size=(4, 3))), ca.MX.sym("s", 4), ca.MX.sym("u", 3, 2)
    step = ca.Function("step", [s, u], [s + ca.tanh(matrix @ u)[:, 0]])
    assert products(step) == 2 * 4 * 3 * 2
    assert products(step.map(7)) == 7 * products(step)
    assert products(step.mapaccum(5)) == 5 * products(step)
    assert products(step.mapaccum(5).map(3)) == 15 * products(step)


@pytest.mark.parametrize("count", [1, 3])
def test_operations_of_the_unrolled_gradient_are_those_of_its_passes(count, bench):
    """Four passes a step (rollout, adjoint, and the tangents of both) and two or three at the end."""
    hidden, data = (100, 25), bench("problem").random_network((100, 25), 25, 20, count=count)
    per_stage = 2 * (8 * hidden[0] + hidden[0] * hidden[1] + hidden[1] * 8 + 14 * hidden[0])
    assert 1.0 <= bench("ceilings").work(data) / (count * (4 * 20 + 2) * 25 * per_stage) <= 1.05


def test_a_ceiling_is_within_what_a_core_can_do(bench):
    """Between a hundredth of an operation and 64 operations per cycle, at 1 to 6 GHz."""
    preset = replace(bench("settings").PRESETS["tiny"], most=20)
    for columns in (1, 128):
        assert 0.01 < bench("ceilings").rate(128, 128, columns, preset) < 400


# Time


def test_contenders_take_turns_until_each_has_spent_its_budget_or_been_called_often_enough(bench, monkeypatch):
    timing, log = bench("timing"), []
    monkeypatch.setattr(timing, "seconds", lambda call: (call(), 0.0))
    times = {"quick": 0.006, "slow": 1.0}

    def contender(name):
        return lambda: log.append(name) or times[name]

    found = timing.interleaved({name: contender(name) for name in times}, budget=0.013, most=100)
    assert found["slow"].calls == 1
    assert found["quick"].calls == 3
    assert log[:3] == ["quick", "slow", "quick"]
    assert timing.interleaved({"quick": contender("quick")}, budget=1.0, most=2)["quick"].calls == 2


def test_a_timing_shows_median_and_spread_in_milliseconds(bench):
    timing = bench("timing").Timing.of([(0.001 * k, 0.0005) for k in range(1, 12)])
    assert str(timing) == "6 (2 - 10)"
    assert timing.numbers["minimum_ms"] == pytest.approx(1.0)
    assert timing.numbers["processor_ms"] == pytest.approx(0.5)
    assert str(bench("timing").Timing.of([(0.25, 0.2)])) == "250 (once)"


def test_what_would_take_too_long_is_left_out_with_the_reason(bench):
    hypergradients, race = bench("hypergradients"), bench("race")
    patience = hypergradients._Patience(limit=1.0)
    timing = bench("timing").Timing.of([(0.2, 0.2)])
    patience.remember("torch", 100, race.Result(timing))
    patience.remember("torch", 10, race.Result(timing))  # the longer case is the one that counts
    assert patience.reason("torch", 500) is None
    assert patience.reason("torch", 2000) == "left out: N T = 100 took 0.2 s, this is 20 times that"
    assert patience.reason("ours", 2000) is None


# Verdicts


@pytest.mark.parametrize(("measured", "verdict"), [(0.5, "met"), (0.51, "missed"), (None, "not measured")])
def test_a_bar_is_met_up_to_its_limit(measured, verdict, bench):
    assert bench("bars").Bar("claim", 0.5, measured).verdict == verdict


def test_missed_bars_come_first_and_met_ones_are_counted(bench):
    bars = bench("bars")
    table = bars.table([bars.Bar(name, 0.5, measured) for name, measured in (("a", 0.5), ("b", 0.6), ("c", None))])
    assert [row[0] for row in table.rows] == ["b", "a", "c"]
    assert "1 of 3 are met." in str(table)


def times(median, minimum=None):
    return {"median_ms": median, "minimum_ms": minimum or median, "processor_ms": median}


def test_we_are_held_against_the_faster_jax_and_a_missing_peer_gives_no_verdict(bench):
    contenders, bars = bench("contenders"), bench("bars").bars
    results = {name: times(4.0) for name in contenders.JAX} | {
        contenders.OURS: times(1.0),
        contenders.ALONE: times(0.9),
    }
    results[contenders.JAX[1]] = times(2.5, 2.0)
    results[contenders.TORCH] = {"left_out": contenders.NOT_INSTALLED}
    jax, torch = bars({"hypergradients": {"paper": {"random": results}}})
    assert (jax.measured, jax.verdict) == (0.4, "met")
    assert jax.note == "0.5 by minima, 0.4 by processor time; compiled function alone 0.36"
    assert (torch.verdict, torch.note) == ("not measured", contenders.NOT_INSTALLED)


def test_a_solve_counts_only_where_it_ends_at_the_same_optimum(bench):
    solvers, bars = bench("solvers"), bench("bars").bars
    good = {"ok": True, "reference_ok": True, "gap": 1e-7}
    loose, tight = (times(10.0) | good | {"gap": 1e-2}), (times(20.0) | good)
    results = {name: [tight] for name in solvers.RICCATI.values()} | {solvers.PLAIN: [times(1000.0) | good]}
    results[solvers.RICCATI[1e-6]] = [loose]
    (bar,) = bars({"solvers": {"random": results}})
    assert bar.measured == pytest.approx(0.02)
    assert bar.note.startswith("Riccati, 1e-08")
    (bar,) = bars({"solvers": {"random": results | {solvers.PLAIN: [times(1000.0) | good | {"ok": False}]}}})
    assert bar.verdict == "not measured"


# Pages


def test_the_readme_shows_the_fastest_peer_of_every_problem(bench):
    page, control = bench("page"), bench("control")
    numbers = {"pendulum": {control.OURS: times(1.25), control.PEER: times(9.0)}, "LQR": {control.OURS: times(0.5)}}
    numbers["LQR"] |= {control.PEER: times(8.0), "HPIPM": times(0.75)}
    rows = ["|  | pendulum | LQR |", "| --- | --- | --- |", "| `Riccati` | 1.2 | 0.5 |"]
    table = "\n".join([*rows, "| fastest peer | 9 (Ipopt) | 0.75 (HPIPM) |"])
    assert page.readme_table(numbers) == table
    first = page.in_readme("a\n<!-- benchmark -->\nold\n<!-- end of benchmark -->\nb", numbers)
    assert first == f"a\n<!-- benchmark -->\n{table}\n<!-- end of benchmark -->\nb"
    assert page.in_readme(page.README.read_text(), numbers).count("| `Riccati` |") == 1
    with pytest.raises(ValueError, match="has no lines"):
        page.in_readme("nothing", numbers)


@pytest.mark.parametrize("state_bounds", [True, False])
def test_hpipm_is_given_the_qp_that_we_solve(bench, state_bounds):
    case = bench("control_problems").bounded_lqr(state_bounds, horizon=5)
    peers = bench("qp_peers").qp_peers(case, 1e-8)
    assert list(peers) == list(bench("qp_peers").NAMES)
    solve, iterations = peers["HPIPM"]
    H, g, *_ = bench("qp_peers")._program(case)
    x = solve()["x"]
    assert iterations > 0
    assert float(x.T @ H @ x / 2 + g.T @ x) == pytest.approx(Riccati().solve(case.problem, case.s0).objective, rel=1e-7)


def test_gradients_of_a_batch_of_qps_are_those_of_mpc_pytorch(bench):
    pytest.importorskip("mpc")
    qps = bench("qps")
    batch = qps.random_batch(3, 4, 1e4)
    found = qps._compare(qps._peer(batch)(), qps._ours(qps.qp(4, 1e4), batch, 1)())
    assert found["done"] == "3"
    assert found["difference"] < 1e-8
