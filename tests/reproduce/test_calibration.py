"""A stage fitted through the loops: known answers, the split, the Jacobian."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax.catalog import p753
from piezojax.control import ModelReferencePID
from piezojax.hardware import Sensor
from piezojax.reproduce import calibration, chapter4, lanes
from piezojax.reproduce.calibration import EXPERIMENTS, HALVES, fit
from piezojax.reproduce.cell import printed
from piezojax.reproduce.lanes import by_column
from piezojax.reproduce.stage import stage_of
from piezojax.reproduce.summary import geomean, ratio_of
from piezojax.rollout import simulate
from piezojax.system import Feedback, loop_inputs

ROWS = ("SIN50", "PWSW50")
"""Short references whose errors the loop's speed sets."""


@pytest.fixture(scope="module")
def problem():
    """A few fast cells, over a quarter of a second instead of one."""
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
        lambda p: (p.paper, p.strength),
        problem,
        (eqx.filter_jit(problem.errors)(truth), jnp.asarray(1e-2)),
    )
    before = geomean(made.log_ratios(made.start))
    assert before > 1.05
    unit = fit(made, steps=20)
    found = made.space.named(unit)
    assert geomean(made.log_ratios(unit)) < 1.005
    assert float(found["gain"]) == pytest.approx(truth["gain"], rel=0.03)
    assert float(found["slow_pole"]) == pytest.approx(truth["slow_pole"], rel=0.1)


@pytest.mark.slow
def test_jacobian_against_finite_differences(problem):
    at = problem.start + 0.013
    residuals = eqx.filter_jit(problem.residuals)
    slope, value = eqx.filter_jit(problem.jacobian)(at)
    np.testing.assert_allclose(value, residuals(at), rtol=1e-12)
    for i in range(at.size):
        step = jnp.zeros(at.size).at[i].set(1e-6)
        central = (residuals(at + step) - residuals(at - step)) / 2e-6
        np.testing.assert_allclose(slope[:, i], central, rtol=1e-4, atol=1e-6)
    assert np.all(np.abs(np.asarray(slope)).max(axis=0) > 0.0)


def test_uncounted_cells_do_not_move_the_fit(problem):
    counts = problem.counts.at[0].set(0.0)
    half = eqx.tree_at(lambda p: p.counts, problem, counts)
    spoilt = eqx.tree_at(lambda p: p.paper, half, half.paper.at[0].multiply(7.0))
    residuals = eqx.filter_jit(lambda p: p.residuals(p.start + 0.01))
    np.testing.assert_array_equal(residuals(half), residuals(spoilt))
    full = eqx.tree_at(lambda p: p.counts, spoilt, problem.counts)
    assert not np.array_equal(residuals(full), residuals(half))


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_halves_are_disjoint_complete_and_alike(name):
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


def test_only_the_doubted_gain_is_replaced():
    cells = [
        cell
        for table in ("5-3", "5-5")
        for cell in printed("ch5", table).values()
        if cell.row == "SIN50"
    ]
    for group in by_column(cells):
        made = lanes.lanes_of(group, short=True)[0]
        other = made.with_observer_proportional(jnp.asarray(0.005))
        changed = [
            not np.array_equal(x, y)
            for x, y in zip(jax.tree.leaves(made), jax.tree.leaves(other), strict=True)
        ]
        assert sum(changed) == (1 if group[0].column == "dob" else 0)
        if group[0].column == "dob":
            gains = other.controller.feedback.proportional
            assert gains.tolist() == [0.01, 0.005]


def test_sw_of_another_amplitude_is_followed_by_all_that_follow_it():
    cells = [
        printed(chapter, table)[row, column]
        for row in ("SW50", "SIN50")
        for chapter, table, column in (
            ("ch5", "5-3", "inversion"),
            ("ch4", "4-5", "model_reference"),
        )
    ]
    for made in lanes.lanes_of(cells, short=True):
        other = made.with_superposed_amplitude(jnp.asarray(3.0))
        assert made.superposed.tolist() == [True, False]
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
        np.testing.assert_array_equal(other.target[:, 1], made.target[:, 1])
        controller = jax.tree.map(lambda leaf: leaf[0], made.controller)
        follow = (
            chapter4.COLUMNS["4-5"]["model_reference"].target
            if isinstance(controller, ModelReferencePID)
            else lambda _, reference: reference
        )
        np.testing.assert_allclose(
            other.target[:, 0], follow(controller, jnp.asarray(by_hand)), atol=1e-9
        )


def test_the_sensor_shakes_the_stage_and_is_not_in_the_error(problem):
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
    off = sample.displacement - made.target[:, 0]
    counted = np.asarray(made.weight[:, 0]) > 0.0
    rms = np.sqrt(np.mean(np.asarray(off)[counted] ** 2))
    assert float(loud[0]) == pytest.approx(rms, rel=1e-9)
    assert 0.0 < abs(float(loud[0] - quiet[0])) < 0.03


def test_what_is_in_doubt_is_not_pulled_towards_print(problem, monkeypatch):
    name = "chapter 5, P of the observer in doubt"
    cells = [printed("ch5", "5-3")["SIN50", "dob"]]
    doubtful = EXPERIMENTS[name].problem(cells, short=True)
    place = doubtful.space.paths.index("observer_proportional")
    moved = doubtful.start.at[place].add(-0.2).at[0].add(0.1)
    monkeypatch.setattr(calibration.Problem, "log_ratios", lambda *_: jnp.zeros(1))
    pull = np.asarray(doubtful.residuals(moved))[len(cells) :]
    expected = np.zeros(doubtful.start.size)
    expected[0] = 0.1
    np.testing.assert_allclose(pull, expected, atol=1e-12)
    assert len(calibration.starts(doubtful)) == 3
    assert len(calibration.starts(problem)) == 2


def test_geometric_mean_ratio_counts_both_directions():
    cell = printed("ch5", "5-3")["SIN1", "dob"]
    cells = [
        dataclasses.replace(cell, sim=2.0 * cell.paper),
        dataclasses.replace(cell, sim=0.5 * cell.paper),
    ]
    assert ratio_of(cells) == pytest.approx(2.0)
    assert geomean(np.log([1.0, 4.0])) == pytest.approx(2.0)
