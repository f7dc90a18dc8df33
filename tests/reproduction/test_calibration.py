"""A stage fitted through closed loops: known stages, the halves, the Jacobian."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax.catalog import p753
from piezojax.control import ModelReferenceSlidingMode
from piezojax.core.feedback import Feedback, loop_inputs
from piezojax.core.paths import parameters
from piezojax.core.rollout import simulate
from piezojax.hardware import Sensor
from piezojax.reproduction import chapter4, lanes
from piezojax.reproduction.calibration import EXPERIMENTS, HALVES, HalfFit
from piezojax.reproduction.calibration_report import held_out_ratios
from piezojax.reproduction.cell import Cell, printed
from piezojax.reproduction.selection import starts
from piezojax.reproduction.stage_fit import STEEPEST, Problem, fit
from piezojax.reproduction.stage_parameters import stage_of
from piezojax.reproduction.summary import geomean, ratio_of
from piezojax.reproduction.suspect_numbers import CANDIDATES, REFERENCE, candidates_of

ROWS = ("SIN50", "PWSW50")
"""Short references whose errors depend on the speed of the loop."""


@pytest.fixture(scope="module")
def problem():
    """Return a problem of few fast cells, over a quarter of a second instead of one."""
    short = pytest.MonkeyPatch()
    short.setattr(lanes, "WARM_UP", 0.05)
    short.setattr(lanes, "SHORT", 0.08)
    cells = [
        cell
        for table in ("5-3", "5-5")
        for cell in printed("ch5", table).values()
        if cell.row in ROWS and cell.column == "pid_smc"
    ]
    yield EXPERIMENTS["chapter 5"].problem(cells, short=True)
    short.undo()


@pytest.mark.slow
def test_a_known_stage_is_found_from_its_own_cells(problem):
    truth = {n: float(v) for n, v in problem.space.named(problem.start).items()}
    truth["slow_pole"] *= 1.3
    truth["gain"] *= 0.9
    made = eqx.tree_at(
        lambda p: (p.paper, p.penalty_weight),
        problem,
        (eqx.filter_jit(problem.errors)(truth), jnp.asarray(1e-2)),
    )
    before = geomean(made.log_ratios(made.start))
    assert before > 1.05
    free = range(made.stage)
    point, least = fit(made, free, starts(made), steps=12)
    found = made.space.named(point)
    assert geomean(made.log_ratios(point)) < 1.005
    assert least == pytest.approx(float(jnp.sum(made.residuals(point) ** 2)))
    np.testing.assert_array_equal(point[made.stage :], made.start[made.stage :])
    assert float(found["gain"]) == pytest.approx(truth["gain"], rel=0.03)
    assert float(found["slow_pole"]) == pytest.approx(truth["slow_pole"], rel=0.1)


@pytest.mark.slow
def test_jacobian_against_finite_differences(problem):
    at = problem.start + 0.013
    names = ("proportional, Table 5-4, PID-SMC", "size of SIN", "DC gain of (5.34)")
    doubted = [problem.space.paths.index(name) for name in names]
    free = [*range(problem.stage), *doubted]
    residuals = eqx.filter_jit(problem.residuals)
    slope, value = eqx.filter_jit(problem.jacobian)(at, jnp.asarray(free))
    np.testing.assert_allclose(value, residuals(at), rtol=1e-12)
    for column, i in enumerate(free):
        step = jnp.zeros(at.size).at[i].set(1e-6)
        central = (residuals(at + step) - residuals(at - step)) / 2e-6
        np.testing.assert_allclose(slope[:, column], central, rtol=1e-4, atol=1e-6)
    assert np.all(np.abs(np.asarray(slope)).max(axis=0) > 0.0)


def test_steps_ignore_slopes_beyond_the_limit(problem, monkeypatch):
    def wild(self, point):
        return jnp.stack([jnp.exp(1e3 * point[0]), jnp.nan * point[1], point[2]])

    monkeypatch.setattr(Problem, "log_ratios", wild)
    three = eqx.tree_at(lambda p: p.counts, problem, jnp.ones(3))
    slope, value = three.jacobian(three.start, jnp.arange(3))
    assert np.all(np.isfinite(slope))
    assert np.all(np.isfinite(value))
    assert value[1] == STEEPEST
    assert not np.any(slope[1])
    assert slope[2, 2] > 0.0


def test_uncounted_cells_do_not_change_the_fit(problem):
    counts = problem.counts.at[0].set(0.0)
    half = eqx.tree_at(lambda p: p.counts, problem, counts)
    spoilt = eqx.tree_at(lambda p: p.paper, half, half.paper.at[0].multiply(7.0))
    residuals = eqx.filter_jit(lambda p: p.residuals(p.start + 0.01))
    np.testing.assert_array_equal(residuals(half), residuals(spoilt))
    full = eqx.tree_at(lambda p: p.counts, spoilt, problem.counts)
    assert not np.array_equal(residuals(full), residuals(half))


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_halves_are_disjoint_complete_and_similar(name):
    experiment = EXPERIMENTS[name]
    halves = experiment.cells()
    assert tuple(halves) == HALVES
    places = {
        half: [(c.table, c.row, c.column) for c in cells]
        for half, cells in halves.items()
    }
    even, odd = (set(places[half]) for half in HALVES)
    wanted = {
        (table, row, column)
        for table in experiment.tables
        for row, column in printed(experiment.chapter, table)
        if column in experiment.columns
    }
    assert not even & odd
    assert even | odd == wanted
    assert len(even) == len(odd) == len(wanted) // 2
    for table in experiment.tables:
        for column in experiment.columns:
            counts = [
                sum((t, c) == (table, column) for t, _, c in half)
                for half in (even, odd)
            ]
            assert counts == [5, 5]


def test_the_first_cells_of_the_even_half():
    cells = EXPERIMENTS["chapter 5"].cells()["even"]
    assert [(c.table, c.row, c.column) for c in cells[:4]] == [
        ("5-3", "SIN1", "pid_smc"),
        ("5-3", "SIN1", "dob"),
        ("5-3", "SIN10", "inversion"),
        ("5-3", "SIN30", "pid_smc"),
    ]


def every_cell(name):
    return [cell for half in EXPERIMENTS[name].cells().values() for cell in half]


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_number_of_every_loop_is_a_candidate(name):
    free = {"error_weight", "autoregressive", "rest_input", "rest_output"}
    free |= {"correction", "anti_windup"}
    cells = every_cell(name)
    for cell in cells:
        doubts = [doubt for doubt in CANDIDATES.values() if doubt.appears_in(cell)]
        paths = parameters(lanes._maker(cell)())
        for path in paths:
            held = [doubt for doubt in doubts if path in doubt.leaves(paths)]
            assert len(held) == (0 if free & set(path.split(".")) else 1), path
        assert sum(doubt.leaf == REFERENCE for doubt in doubts) == 1
        for doubt in doubts:
            assert doubt.leaf == REFERENCE or doubt.leaves(paths)
    quantities = EXPERIMENTS[name].quantities()
    for doubt in candidates_of(cells):
        assert quantities[doubt].start == 1.0


def test_the_number_of_candidates():
    assert len(candidates_of(every_cell("chapter 5"))) == 33
    assert len(candidates_of(every_cell("chapter 4"))) == 17


@pytest.mark.parametrize(
    ("doubt", "column", "expected"),
    [
        ("proportional, Table 5-4, observer", "dob", {"feedback.law.proportional": 1}),
        ("proportional, Table 5-2", "pid_smc", {"law.proportional": 0}),
        ("K_e", "dob", {"gain": None}),
        (
            "DC gain of (5.33)",
            "dob",
            {
                f"{m}moving.{i}": None
                for m in ("model.", "feedback.model.")
                for i in "012"
            },
        ),
        ("K_e", "inversion", {}),
    ],
)
def test_only_the_suspect_number_is_replaced(doubt, column, expected):
    """``expected`` are the changed leaves, in the lane of one table or of both."""
    cells = [printed("ch5", t)["SIN50", column] for t in ("5-3", "5-5")]
    made = lanes.lanes_of(cells, short=True)[0]
    factors = dict.fromkeys(CANDIDATES, 1.0) | {doubt: 0.1}
    before = parameters(made.controller)
    after = parameters(made.scaled(factors).controller)
    changed = {}
    for path, leaf in before.items():
        share = np.asarray(after[path]) / np.where(leaf == 0.0, 1.0, leaf)
        if np.any(leaf != after[path]):
            changed[path] = [bool(np.isclose(s, 0.1)) for s in share]
    assert changed == {
        path: [True, True] if lane is None else [lane == 0, lane == 1]
        for path, lane in expected.items()
    }


def test_a_scaled_sw_is_the_reference_of_all_its_cells():
    cells = [
        printed(chapter, table)[row, column]
        for row in ("SW50", "SIN50")
        for chapter, table, column in (
            ("ch5", "5-3", "inversion"),
            ("ch4", "4-5", "model_reference"),
        )
    ]
    for made in lanes.lanes_of(cells, short=True):
        other = made.scaled(dict.fromkeys(CANDIDATES, 1.0) | {"size of SW": 0.6})
        assert made.affected["size of SW"].tolist() == [True, False]
        time = np.arange(made.reference.shape[0]) / 20_000.0 - 0.1
        by_hand = 0.6 * (
            5.0
            + 30.0 / 7.0 * np.sin(2.0 * np.pi * 2.5 * time + np.pi)
            + 25.0 / 7.0 * np.sin(2.0 * np.pi * 10.0 * time + 0.5 * np.pi)
            + 5.0 / 7.0 * np.sin(2.0 * np.pi * 25.0 * time + 0.2 * np.pi)
            + 5.0 / 7.0 * np.sin(2.0 * np.pi * 50.0 * time)
        )
        np.testing.assert_allclose(other.reference[:, 0], by_hand, atol=1e-9)
        np.testing.assert_array_equal(other.reference[:, 1], made.reference[:, 1])
        np.testing.assert_array_equal(other.target()[:, 1], made.target()[:, 1])
        controller = jax.tree.map(lambda leaf: leaf[0], made.controller)
        follow = (
            chapter4.COLUMNS["4-5"]["model_reference"].target
            if isinstance(controller, ModelReferenceSlidingMode)
            else lambda _, reference: reference
        )
        np.testing.assert_allclose(
            other.target()[:, 0], follow(controller, jnp.asarray(by_hand)), atol=1e-9
        )


def test_errors_are_relative_to_the_scaled_reference_model():
    cell = printed("ch4", "4-5")["SIN50", "model_reference"]
    made = lanes.lanes_of([cell], short=True)[0]
    other = made.scaled(dict.fromkeys(CANDIDATES, 1.0) | {"zeta, 4.5.4.3": 2.0})
    controller = jax.tree.map(lambda leaf: leaf[0], made.controller)
    damped = eqx.tree_at(lambda c: c.reference_model.damping, controller, 0.5)
    follow = chapter4.COLUMNS["4-5"]["model_reference"].target
    wanted = follow(damped, made.reference[:, 0])
    np.testing.assert_allclose(other.target()[:, 0], wanted, atol=1e-12)
    assert not np.allclose(made.target()[:, 0], wanted, atol=1e-3)


def test_sensor_noise_moves_the_stage_and_is_not_in_the_error(problem):
    values = {n: float(v) for n, v in problem.space.named(problem.start).items()}
    errors = eqx.filter_jit(problem.errors)
    quiet, loud = (
        errors(values | {"noise": noise, "sensor_lag": 1e-7}) for noise in (0.0, 0.03)
    )
    made = problem.lanes[0]
    loop = Feedback(
        jax.tree.map(lambda leaf: leaf[0], made.controller),
        stage_of(values, problem.numerator),
        p753.actuator(),
        Sensor(0.03),
    )
    inputs = loop_inputs(made.reference[:, 0], made.noise)
    sample = simulate(loop, inputs, loop.init(0.0))[1]
    off = sample.displacement - made.target()[:, 0]
    counted = np.asarray(made.weight[:, 0]) > 0.0
    rms = np.sqrt(np.mean(np.asarray(off)[counted] ** 2))
    assert float(loud[0]) == pytest.approx(rms, rel=1e-9)
    assert 0.0 < abs(float(loud[0] - quiet[0])) < 0.03


def test_suspect_numbers_have_no_penalty(problem, monkeypatch):
    one = eqx.tree_at(lambda p: p.counts, problem, jnp.ones(1))
    moved = one.start.at[one.stage + 2].add(-0.2).at[0].add(0.1)
    monkeypatch.setattr(Problem, "log_ratios", lambda *_: jnp.zeros(1))
    expected = np.zeros(one.stage + 1)
    expected[1] = 0.1
    np.testing.assert_allclose(one.residuals(moved), expected, atol=1e-12)


def test_geometric_mean_ratio_counts_both_directions():
    cell = printed("ch5", "5-3")["SIN1", "dob"]
    cells = [
        dataclasses.replace(cell, sim=2.0 * cell.paper),
        dataclasses.replace(cell, sim=0.5 * cell.paper),
    ]
    assert ratio_of(cells) == pytest.approx(2.0)
    assert geomean(np.log([1.0, 4.0])) == pytest.approx(2.0)


def test_the_held_out_ratio_covers_all_cells_of_a_half():
    def swap(half, ratios):
        cells = [Cell("5-3", f"row {i}", "pid", "um", 2.0, 2.0 * r) for i, r in ratios]
        return HalfFit(half, 1.0, {}, (), (), [], cells, [])

    found = {
        "one": [swap("even", [(0, 1.5), (1, 1.5), (2, 1.5)]), swap("odd", [(3, 1.0)])],
        "other": [swap("even", [(4, 1.0)]), swap("odd", [(5, 2.0)])],
    }
    halves = held_out_ratios(found)
    assert halves["even"]["held_out"]["cells"] == 4
    # Each cell has equal weight, not each experiment.
    assert halves["even"]["held_out"]["geomean_ratio"] == pytest.approx(1.5**0.75)
    assert not halves["even"]["met"]
    assert halves["odd"]["held_out"]["geomean_ratio"] == pytest.approx(2.0**0.5)
