"""The model of a simulated record is chosen, and its parameters are recovered."""

import jax.numpy as jnp
import numpy as np
import pytest

from piezojax import (
    Record,
    read_record,
)
from piezojax.core.paths import get, replace
from piezojax.core.system import Series
from piezojax.identification import (
    free_run,
    identify_all,
)
from piezojax.identification.chain import structure
from piezojax.identification.estimators.estimate import Options
from piezojax.study import shipped

DT = 1e-3
SAMPLES = 900
TRAIN = slice(0, 600)
NOISE = 0.01
ONE_TONE = 30.0 - 30.0 * np.cos(2.0 * np.pi * 10.0 * DT * np.arange(SAMPLES))
TRUTH = {"a": 0.0077, "b": 0.1167, "c": -0.0487}


def made_by_coleman_hodgdon():
    """Return a record of a Coleman-Hodgdon model and a lag, the plant, exact output."""
    shape = structure("coleman_hodgdon+lag", Record(ONE_TONE, 0.12 * ONE_TONE, DT))
    truth = {f"hysteresis.{path}": value for path, value in TRUTH.items()}
    truth |= {"lag.time_constant": 2.5e-3, "calibration.offset": -3.0}
    plant = replace(shape.system, truth)
    clean = np.asarray(free_run(plant, jnp.asarray(ONE_TONE), ONE_TONE[0]))
    noise = NOISE * np.random.default_rng(1).standard_normal(SAMPLES)
    return Record(ONE_TONE, clean + noise, DT, source="made up"), plant, clean


@pytest.mark.parametrize(("first", "count"), [(0.0, 1), (27.0, 2)])
def test_each_start_of_a_fit_is_another(first, count):
    # A descent from a second start at the lowest voltage would be the first again.
    voltage = np.append(first, ONE_TONE)
    shape = structure("prandtl_ishlinskii", Record(voltage, 0.12 * voltage, DT))
    assert len(shape.starts) == len(np.unique(shape.starts, axis=0)) == count


def check_recovered(found, plant, clean):
    """Check parameters within 4 standard errors, and the output within the noise."""
    for path, parameter in found.report.parameters.items():
        if parameter.standard_error is None or "rest_" in path:
            continue
        off = abs(parameter.value - float(get(plant, path)))
        assert off < 4.0 * parameter.standard_error, path
    error = (found.simulated - clean)[found.validate]
    assert np.sqrt(np.mean(error**2)) < 0.5 * NOISE


def test_the_model_of_the_simulated_record_is_chosen():
    # The others are a linear model and one that contains it with four more parameters.
    record, plant, clean = made_by_coleman_hodgdon()
    among = ["coleman_hodgdon", "shaped_coleman_hodgdon"]
    found = identify_all(
        record, hysteresis=among, train=TRAIN, options=Options(steps=40)
    )
    assert set(found.fits) == {"lag", *(f"{name}+lag" for name in among)}
    assert found.report.best == "coleman_hodgdon+lag"
    check_recovered(found.best, plant, clean)


PLAYS = {
    **{f"polynomial.{i}": v for i, v in enumerate((0.071, 1.3e-4, -7e-7))},
    **{f"weights.{i}": 0.011 * 0.82**i for i in range(10)},
}


def made_by_plays(name, **more):
    """Return a record of 10 Hz at several amplitudes, the plant, its exact output.

    One amplitude alone would determine the weights of the plays from a single loop.
    """
    level = np.select(
        [np.arange(SAMPLES) < stop for stop in (300, 400, 500, 600, 700, 800)],
        [1.0, 0.8, 0.6, 0.35, 0.9, 0.5],
        0.7,
    )
    input = level * 5.0 / 3.0 * ONE_TONE
    seen = Record(input, 0.12 * input, DT).until(TRAIN.stop)
    truth = {f"hysteresis.{path}": value for path, value in (PLAYS | more).items()}
    truth |= {"hysteresis.rest_input": 0.0, "calibration.offset": -3.0}
    truth |= {"lag.time_constant": 1.1e-3}
    plant = replace(structure(f"{name}+lag", seen).system, truth)
    clean = np.asarray(free_run(plant, jnp.asarray(input), 0.0))
    noise = NOISE * np.random.default_rng(1).standard_normal(SAMPLES)
    return Record(input, clean + noise, DT, source="made up"), plant, clean


def test_stops_are_chosen_as_equivalent_plays():
    record, plant, clean = made_by_plays(
        "stop_prandtl_ishlinskii", **{"polynomial.0": 0.152}
    )
    among = ["prandtl_ishlinskii", "stop_prandtl_ishlinskii"]
    found = identify_all(
        record, hysteresis=among, train=TRAIN, options=Options(steps=60)
    )
    assert {f"{name}+lag" for name in among} < set(found.fits)
    assert found.report.best == "prandtl_ishlinskii+lag"
    rows = {row.model: row for row in found.report.rows}
    note = rows["stop_prandtl_ishlinskii+lag"].note
    assert note == "equivalent to prandtl_ishlinskii+lag"
    stops, *others = plant.parts
    same = Series((stops.as_plays(), *others), plant.names)
    check_recovered(found.best, same, clean)


@pytest.mark.slow
def test_the_models_of_the_micromanipulator():
    # The sensor noise is 0.067 um, and cycles differ by as much.
    record = read_record(
        shipped().parent / "data" / "micromanipulator.csv",
        time="time_s",
        input="input_V",
        output="displacement_um",
    )
    report = identify_all(record, hysteresis=["shaped_coleman_hodgdon"]).report
    assert report.rows[0].validation_rmse <= 0.15
    assert not [row for row in report.rows if row.status == "failed"]
