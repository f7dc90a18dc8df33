"""A stage fitted through the loops: known answers, the split, the Jacobian."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax.reproduce import lanes
from piezojax.reproduce.calibration import EXPERIMENTS, HALVES, fit
from piezojax.reproduce.cell import printed
from piezojax.reproduce.lanes import by_column
from piezojax.reproduce.summary import geomean, ratio_of

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


def test_geometric_mean_ratio_counts_both_directions():
    cell = printed("ch5", "5-3")["SIN1", "dob"]
    cells = [
        dataclasses.replace(cell, sim=2.0 * cell.paper),
        dataclasses.replace(cell, sim=0.5 * cell.paper),
    ]
    assert ratio_of(cells) == pytest.approx(2.0)
    assert geomean(np.log([1.0, 4.0])) == pytest.approx(2.0)
