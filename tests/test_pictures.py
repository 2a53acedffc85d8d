"""Results show a picture, not a wall of numbers; figures have one style and true labels."""

import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp import LBFGS, OCP, Demonstration, Implicit, Riccati, Soft, learn, sensitivity
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.figures import colours, new_figure, panels_of_bands, save, wrapped_figure
from kpirl_ocp.ocp.models import MLP, Robot
from kpirl_ocp.perception.data.formats import Take
from kpirl_ocp.perception.scene.frame import Frame
from kpirl_ocp.pictures import COLOURS, GREY, PAGE, svg_file
from kpirl_ocp.reporting import plus_minus, spread
from kpirl_ocp.viewing.plots import plot

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
from reproduction.drawing import bars, success
from reproduction.page import Page


@pytest.fixture(scope="module")
def problem():
    s, u, psi = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("psi", 2)
    return OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        horizon=12,
        dynamics=s + 0.2 * ca.vertcat(s[1], u),
        stage_cost=psi[0] * (s[0] - 1) ** 2 + psi[1] * u**2,
        terminal_cost=10 * (s[0] - 1) ** 2,
        action_bounds=(-1, 2),
    )


@pytest.fixture(scope="module")
def solution(problem):
    return Riccati().solve(problem, [0, 0], [1, 0.1])


@pytest.fixture(scope="module")
def results(problem, solution):
    """Every kind of result that has a picture."""
    seen = Demonstration([0, 0], [], Riccati().solve(problem, [0, 0], [2, 0.1]).states)
    certificate = Implicit()(problem, seen, [1, 0.1]).certificate
    learning = learn(problem, [seen], [1, 0.1], Implicit(), LBFGS(), steps=3, progress=False)
    return {"solution": solution, "certificate": certificate, "learning": learning}


KINDS = ("solution", "certificate", "learning")


@pytest.mark.parametrize("kind", KINDS)
def test_a_notebook_shows_a_picture_that_any_browser_draws(results, kind):
    page = results[kind]._repr_html_()
    (picture,) = re.findall(r"<svg.*</svg>", page, flags=re.DOTALL)
    assert ET.fromstring(picture).tag.endswith("svg")
    assert "array(" not in page


@pytest.mark.parametrize("kind", KINDS)
def test_what_a_console_prints_is_short(results, kind):
    assert len(repr(results[kind])) < 500
    assert "array(" not in repr(results[kind])


def test_a_record_of_arrays_prints_their_shapes_and_the_numbers_of_short_ones(results):
    solution = results["solution"]
    seen = Demonstration([0, 0], [], solution.states)
    assert repr(seen) == (
        "Demonstration(s0=[0.0, 0.0], context=[], observations=<array (13, 2)>, actions=None, frames=None)"
    )
    take = Take({"action": solution.actions}, np.arange(12.0), {"camera": np.zeros((12, 4, 4, 3), np.uint8)}, "wave")
    assert repr(take) == (
        "Take(arrays={'action': <array (12, 1)>}, times=<array (12,)>, "
        "videos={'camera': <array (12, 4, 4, 3)>}, task='wave')"
    )
    assert repr(solution.trajectory) == "Trajectory(states=<array (13, 2)>, actions=<array (12, 1)>)"
    assert "path=<array (12, 0)>" in repr(solution.multipliers)


def test_the_text_of_a_method_names_its_loss():
    assert re.search(r"^Implicit\(solver=Riccati\(.*\), loss=squared_distance, policy='raise'", repr(Implicit()))


def test_a_certificate_prints_its_verdict_before_its_numbers(problem, results):
    certificate = results["certificate"]
    assert repr(certificate).startswith("SensitivityCertificate(certified, kkt_residual=")
    assert f"curvature={certificate.curvature:.2g}" in repr(certificate)
    seen = Demonstration([0, 0], [], certificate.solution.states)
    result = Implicit()(problem, seen, [1, 0.1])
    assert repr(result) == f"HypergradientResult(loss=0, gradient={result.gradient.tolist()}, {result.certificate!r})"


def test_the_sensitivity_of_a_plan_prints_the_plan(problem, solution):
    assert repr(sensitivity(problem, solution)) == f"Sensitivity({solution!r}, policy='raise')"


def test_a_robot_a_network_and_a_frame_print_one_line():
    assert repr(Robot.iiwa()) == "<Robot lbr_iiwa: 7 joints, 3 keypoints on lbr_iiwa_link_7>"
    network = MLP.from_layers([np.ones((5, 3)), np.ones((2, 5))], [np.ones(5), np.ones(2)], "tanh")
    assert repr(network) == "<MLP 3 -> 5 -> 2, tanh, identity>"
    frame = Frame(np.zeros((4, 6, 3), np.uint8), np.zeros((4, 6), bool), np.array([1.0, 2.0]))
    assert repr(frame) == "Frame(rgb=<array (4, 6, 3)>, bottle=<array (4, 6)>, place=[1.0, 2.0], parts=None)"


def test_the_picture_of_a_certificate_says_what_was_measured(results):
    page = results["certificate"]._repr_html_()
    assert ">certified<" in page
    for name, value in results["certificate"].evidence().items():
        assert f"<td>{name.replace('_', ' ')}</td><td>{value:.2g}</td>" in page
    assert results["certificate"].evidence()["kkt_residual"] == results["certificate"].kkt_residual


def test_a_plotted_solution_is_the_solution_with_its_bounds(problem, solution):
    states, actions = plot(solution, problem).axes
    for line, values in zip(states.lines, solution.states.T, strict=True):
        np.testing.assert_array_equal(line.get_ydata(), values)
    steps, lower, upper = (patch.get_data() for patch in actions.patches)
    np.testing.assert_array_equal(steps.values, solution.actions[:, 0])
    np.testing.assert_array_equal(lower.values, np.full(12, -1.0))
    np.testing.assert_array_equal(upper.values, np.full(12, 2.0))
    assert len(plot(solution).axes[1].patches) == 1


def test_bounds_far_away_do_not_flatten_what_is_plotted(problem, solution):
    low, high = plot(solution).axes[0].get_ylim()
    far = replace(problem, state_bounds=(-np.inf, [1e3, np.inf]))
    assert plot(solution, far).axes[0].get_ylim() == (low, high)
    near = replace(problem, state_bounds=(-np.inf, [high + 0.1, np.inf]))
    assert plot(solution, near).axes[0].get_ylim()[1] > high + 0.1


def test_what_a_statement_adds_has_names_of_its_own_in_a_plot():
    s, u, q = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("q")
    stated = OCP.from_expressions(
        state=s,
        action=u,
        static=q,
        dynamics=s + q * ca.vertcat(s[1], u),
        stage_cost=ca.sumsqr(s) + u**2,
        terminal_cost=q**2,
        soft=Soft(s[0] - 0.5, 1.0),
        horizon=4,
    )
    plan = Riccati().solve(stated, [1.0, 0.0])
    legends = [[text.get_text() for text in axes.get_legend().get_texts()] for axes in plot(plan, stated).axes]
    assert legends == [["s0", "s1", "q0", "end slack 0"], ["u0", "slack 0"]]


def test_a_notebook_shows_what_plot_returns(solution):
    assert ET.fromstring(plot(solution)._repr_svg_()).tag.endswith("svg")


def test_plotted_learning_is_its_loss_and_its_parameters(results):
    learning = results["learning"]
    loss, parameters = plot(learning).axes
    np.testing.assert_array_equal(loss.lines[0].get_ydata(), learning.losses)
    for line, values in zip(parameters.lines, learning.psis.T, strict=True):
        np.testing.assert_array_equal(line.get_ydata(), values)
    assert [text.get_text() for text in parameters.get_legend().get_texts()] == ["psi[0]", "psi[1]"]


def test_a_plotted_certificate_carries_its_verdict(results, problem):
    figure = plot(results["certificate"], problem)
    assert figure.get_suptitle() == "certified"


def test_what_has_no_picture_is_refused():
    with pytest.raises(ProblemError, match="not a list"):
        plot([1, 2])


def test_importing_the_package_does_not_import_matplotlib():
    check = "import sys, kpirl_ocp; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", check], check=False).returncode == 0


@pytest.mark.parametrize("count", [1, 2, 3, 5, 8])
def test_no_figure_is_wider_than_a_page_so_that_its_text_stays_as_it_is(count):
    for figure, axes in (new_figure(1, count), wrapped_figure(count)):
        assert figure.get_figwidth() <= PAGE
        assert len(axes) == count


def test_a_cost_has_the_same_colour_in_every_figure():
    assert colours(["RBF", "Weighted"])["RBF"] == colours(["Weighted", "TimeDep", "RBF", "Default"])["RBF"]
    assert colours(["Default"]) == {"Default": GREY}
    chosen = colours(["ours", "Weighted", "theirs", "TimeDep"])
    assert len(set(chosen.values())) == 4
    assert set(chosen.values()) <= set(COLOURS)


def test_a_name_has_one_colour_in_all_panels_and_one_entry_in_a_legend_that_hides_no_line():
    figure, axes = new_figure(1, 2)
    one, two = {"ours": [np.ones(3)], "Weighted": [np.ones(3)]}, {"Weighted": [np.ones(4)], "theirs": [np.ones(2)]}
    panels_of_bands(axes, {"train": one, "test": two}, "loss")
    shown = [{line.get_label(): line.get_color() for line in axis.lines} for axis in axes]
    assert shown[0]["Weighted"] == shown[1]["Weighted"] == COLOURS[0]
    assert shown[0]["ours"] != shown[1]["theirs"]
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["ours", "Weighted", "theirs"]
    figure.draw_without_rendering()
    assert all(not legend.get_window_extent().overlaps(axis.get_tightbbox()) for axis in axes)


def test_the_same_figure_gives_the_same_file(solution):
    assert svg_file(plot(solution)) == svg_file(plot(solution))


@pytest.mark.parametrize("groups", [2, 16])
def test_names_of_bars_do_not_touch(groups):
    values = {"all dimensions": np.ones(3), "x of moving keypoints": np.ones(3)}
    panels = {"1 demonstration": {f"TimeDep, more steps, start {i}": values for i in range(groups)}}
    figure = bars(panels | {"10 demonstrations": panels["1 demonstration"]}, "relative distance")
    figure.draw_without_rendering()
    assert figure.get_figwidth() <= PAGE
    for axis in figure.axes:
        boxes = [label.get_window_extent() for label in axis.get_yticklabels()]
        assert not any(one.overlaps(two) for one, two in pairwise(boxes))
    assert all(box.x0 >= 0 for box in boxes)


def test_the_legend_of_many_bars_stays_on_the_page():
    rates = {f"TimeDep, more steps, loop {i}": 0.5 for i in range(6)}
    figure = success({"as trained": rates, "another start": rates}, "within 8 px")
    figure.draw_without_rendering()
    box = figure.legends[0].get_window_extent()
    assert box.x0 >= 0
    assert box.x1 <= figure.bbox.x1


def test_a_table_aligns_numbers_to_the_right_and_text_to_the_left(tmp_path):
    page = Page("A report")
    page.table(["4 costs", "loss", "here"], [["4, Alg. 1", "0.3 ± 0.1", "differs: 1 of 3"], ["5", "", "same"]])
    written = page.write(tmp_path / "report.html").read_text()
    assert '<th>4 costs</th><th class="number">loss</th><th>here</th>' in written
    assert '<td>5</td><td class="number"></td><td>same</td>' in written
    assert "<table><tr>" in written


def test_a_table_of_words_alone_is_as_narrow_as_a_phone(tmp_path):
    page = Page("A report")
    page.table(["section", "the paper", "here"], [["4", "psi by gradient descent " * 4, "same"]])
    written = page.write(tmp_path / "report.html").read_text()
    assert '<table class="words"><tr><th>section</th><th class="long">the paper</th><th>here</th>' in written


def test_one_run_has_no_deviation():
    assert spread([175.2]) == "175"
    assert spread([174.0, 176.0]) == "175 ± 1"


def test_rounding_is_no_deviation():
    assert spread([0.1 + 0.2, 0.3, 0.3]) == "0.3 ± 0"
    assert spread([1.0, 1.0 + 1e-9]) == "1 ± 5e-10"


@pytest.mark.parametrize(
    ("mean", "deviation", "text"),
    [
        (175.2, 138.0, "175 ± 140"),
        (1567.0, 230.4, "1570 ± 230"),
        (0.0766, 0.00312, "0.0766 ± 0.0031"),
        (5.5, 4.0, "5.5 ± 4"),
        (13.0, 0.0, "13 ± 0"),
        (-2.5e-7, 1e9, "-2.5e-07 ± 1e+09"),
        (np.nan, 1.0, "nan ± 1"),
    ],
)
def test_mean_and_deviation_are_written_without_exponents_where_they_are_easily_read(mean, deviation, text):
    assert plus_minus(mean, deviation) == text


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        ((12, 80), ["20", "30", "40", "60"]),
        ((0.02, 0.4), ["0.02", "0.03", "0.04", "0.06", "0.1", "0.2", "0.3", "0.4"]),
        ((0.1, 900), ["0.1", "1", "10", "100"]),
    ],
    ids=str,
)
def test_narrow_logarithmic_axes_have_plain_numbers(tmp_path, limits, expected):
    figure, (axes,) = new_figure(1, 1)
    axes.set(yscale="log", ylim=limits)
    save(figure, tmp_path / "figure.svg")
    ticks = [*axes.yaxis.get_major_ticks(), *axes.yaxis.get_minor_ticks()]
    shown = [t.label1.get_text() for t in ticks if limits[0] <= t.get_loc() <= limits[1]]
    assert sorted(filter(None, shown), key=float) == expected


def test_axes_over_many_decades_have_powers_of_ten(tmp_path):
    figure, (axes,) = new_figure(1, 1)
    axes.set(yscale="log", ylim=(1e-12, 1))
    save(figure, tmp_path / "figure.svg")
    assert "10^{-12}" in axes.yaxis.get_major_formatter()(1e-12)


def test_a_figure_is_drawn_with_the_problem_alone():
    s, u = ca.SX.sym("s"), ca.SX.sym("u")
    problem = OCP.from_expressions(state=s, action=u, dynamics=s + u, stage_cost=s**2 + u**2, horizon=2)
    solution = Riccati().solve(problem, [1.0])
    with pytest.raises(ProblemError, match=r"plot\(solution, problem\) needs the OCP as problem, got Solution\."):
        plot(solution, solution)
