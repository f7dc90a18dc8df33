"""Fits of a Preisach model with a lag, and records that do not support one."""

import itertools
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from oracles import preisach as oracle

from piezojax import (
    Record,
    identify,
    load,
    read_record,
)
from piezojax.identification import free_run
from piezojax.identification.candidates import whole_models
from piezojax.identification.estimators.estimate import Options
from piezojax.identification.estimators.model_preisach import (
    RATE_DEPENDENT,
    distinguishable_cells,
)
from piezojax.report.fit_pictures import write_fit
from piezojax.study import shipped

DT, LAG, LOWEST, NOISE = 1e-3, 2.2e-3, -1.5, 2e-3
CELLS = 10
WEIGHTS, FAST = np.tril(np.random.default_rng(3).uniform(0.05, 0.3, (2, CELLS, CELLS)))
RATE = 7e3
CORNERS = (
    [0, 100, 0, 92, 6, 84, 14, 76, 24, 66, 34, 57, 42, 100, 30, 95, 12, 48, 20, 38, 26]
    + [88, 0, 55, 5, 30, 10, 22, 100, 55, 90, 62, 82, 70, 100, 0, 70, 18, 60, 0, 45, 0]
    + [20, 0, 100, 85, 98, 75, 100, 0, 97, 15, 62, 28, 89, 51, 73, 3, 41, 9, 99, 0]
)


def drive(volts=2):
    """Return voltages from corner to corner in steps of ``volts``."""
    ways = [
        np.linspace(a, b, abs(b - a) // volts + 2)[1:]
        for a, b in itertools.pairwise(CORNERS)
    ]
    return np.concatenate([[0.0], *ways])


def record_of(input, weights=WEIGHTS, fast=None):
    """Return a record of single relays, where u(k) moves y(k+1), a lag, and noise."""
    moved = oracle.along(weights, 0.0, 100.0, 50, input, rest=0.0)
    if fast is not None:
        square = (np.diff(input, prepend=input[0]) / DT / RATE) ** 2
        quick = oracle.along(fast, 0.0, 100.0, 50, input, rest=0.0)
        moved = (moved + square * quick) / (1.0 + square)
    pole, output, y = np.exp(-DT / LAG), [moved[0]], moved[0]
    for f in moved[:-1]:
        y = f + pole * (y - f)
        output.append(y)
    noise = NOISE * np.random.default_rng(1).standard_normal(len(input))
    return Record(input, LOWEST + np.array(output) + noise, DT, source="made up")


INPUT = drive()
TRAIN = slice(0, 1200)


@pytest.fixture(scope="module")
def fit():
    return identify(record_of(INPUT), "preisach", train=TRAIN)


def test_weights_and_lag_are_recovered(fit):
    found = fit.report.parameters
    assert fit.count == len(found) == CELLS * (CELLS + 1) // 2 + 2
    truth = {
        f"hysteresis.weights.{i}.{j}": WEIGHTS[i, j]
        for i in range(CELLS)
        for j in range(i + 1)
    }
    truth |= {"hysteresis.lowest": LOWEST, "lag.time_constant": LAG}
    far = [(found[n].value - v) / found[n].standard_error for n, v in truth.items()]
    assert np.max(np.abs(far)) < 4.0
    assert 0.7 < np.std(far) < 1.4
    # The relays of the record switch separately, by up to 6 nm.
    assert fit.report.validation.rmse < 2.0 * NOISE


@pytest.fixture(scope="module")
def paces():
    input = np.concatenate([INPUT, drive(9)])
    return identify(
        record_of(input, fast=FAST),
        "rate_dependent_preisach",
        train=slice(0, input.size - 50),
    )


def test_both_densities_the_rate_and_the_lag_are_recovered(paces):
    found = paces.report.parameters
    assert paces.count == len(found) == CELLS * (CELLS + 1) + 3
    truth = {
        f"hysteresis.{name}.{i}.{j}": weights[i, j]
        for name, weights in (("slow.weights", WEIGHTS), ("fast_weights", FAST))
        for i in range(CELLS)
        for j in range(i + 1)
    }
    truth |= {"hysteresis.slow.lowest": LOWEST, "hysteresis.rate": RATE}
    truth |= {"lag.time_constant": LAG}
    far = [(found[n].value - v) / found[n].standard_error for n, v in truth.items()]
    assert np.max(np.abs(far)) < 4.0
    assert 0.7 < np.std(far) < 1.4


def test_one_rate_does_not_determine_two_densities():
    steps = np.where(np.arange(1200) // 50 % 2, -2.0, 2.0)
    input = np.concatenate([[0.0], np.cumsum(steps)])
    record = Record(input, 0.1 * input, DT)
    assert distinguishable_cells(record, slice(0, 900), RATE_DEPENDENT) == 0


def test_the_saved_model_is_the_plant(fit, tmp_path):
    write_fit(fit, tmp_path)
    again = load(tmp_path / "model.json")
    run = free_run(again, jnp.asarray(INPUT), INPUT[0])
    np.testing.assert_allclose(run, fit.simulated, rtol=0, atol=1e-12)


def test_the_turning_points_determine_the_number_of_cells():
    # one loop, a loop in another, and all loops
    once = 50.0 - 50.0 * np.cos(np.linspace(0.0, 6.0 * np.pi, 600))
    twice = np.concatenate([once, np.interp(once, [0.0, 100.0], [0.0, 55.0])])
    found = [
        distinguishable_cells(Record(u, 0.1 * u, DT), slice(0, u.size))
        for u in (once, twice, INPUT)
    ]
    assert found[0] == 0
    assert found[0] <= found[1] < found[2] == CELLS


def test_the_initial_loading_does_not_add_cells(monkeypatch):
    # One amplitude: the initial loading passes more cells before the first corner.
    record = read_record(
        shipped().parent / "data" / "micromanipulator.csv",
        time="time_s",
        input="input_V",
        output="displacement_um",
    )
    assert distinguishable_cells(record, slice(0, 1200)) == 0
    module = sys.modules[distinguishable_cells.__module__]
    monkeypatch.setattr(module, "STARTS", ("virgin",))
    assert distinguishable_cells(record, slice(0, 1200)) == 4


def test_a_record_of_one_loop_is_refused():
    once = 50.0 - 50.0 * np.cos(np.linspace(0.0, 6.0 * np.pi, 600))
    record = Record(once, 0.1 * once, DT, source="one tone")
    half = slice(0, 300)
    _, untried = whole_models([record], half, Options())
    reasons = {one.model: one.reason for one in untried}
    assert "do not distinguish even the cells" in reasons["preisach"]
    assert "of two Preisach triangles" in reasons["rate_dependent_preisach"]
    with pytest.raises(ValueError, match="a Preisach triangle with 3 cells per side"):
        identify(record, "preisach", train=half)


def test_several_records_or_inputs_are_refused():
    record = Record(INPUT, 0.1 * INPUT, DT)
    both = np.stack([INPUT, INPUT[::-1]], axis=1)
    for records, reason in (
        ([record, record], "2 records; the model takes one"),
        ([Record(both, both, DT)], "2 inputs and 2 outputs"),
    ):
        _, untried = whole_models(records, TRAIN, Options())
        assert any(u.model == "preisach" and reason in u.reason for u in untried)
