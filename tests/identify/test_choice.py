"""The model that made a record is the one that is chosen, its parameters recovered."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from piezojax import Record, identify_all, read_record
from piezojax.identify import free_run
from piezojax.identify.candidates import at, chained
from piezojax.identify.estimate import Options
from piezojax.identify.models import structure
from piezojax.paths import get, replace
from piezojax.study import shipped

DT = 1e-3
SAMPLES = 900
TRAIN = slice(0, 600)
NOISE = 0.01
MICROMANIPULATOR = (
    Path(__file__).parents[2].parent / "shared/data/micromanipulator/Model_Vi_Do.dat"
)
PLAYS = range(10)
TRUTHS = {
    "coleman_hodgdon": {"a": 0.0077, "b": 0.1167, "c": -0.0487},
    "shaped_coleman_hodgdon": {
        "pull.1": 0.0077,
        "pull.2": 6e-5,
        "pull.3": -6e-7,
        "slope.0": 0.08,
        "slope.1": 8e-4,
        "slope.2": -6e-6,
        "c": -0.0487,
    },
    "prandtl_ishlinskii": {
        "polynomial.0": 0.1,
        "polynomial.1": 2e-4,
        "polynomial.2": -2e-6,
        **{f"weights.{i}": 0.015 / (1 + i) for i in PLAYS},
    },
    "asymmetric_prandtl_ishlinskii": {
        "polynomial.0": 0.1,
        "polynomial.1": 2e-4,
        "polynomial.2": -2e-6,
        **{f"weights.{i}": 0.015 / (1 + i) for i in PLAYS},
        **{f"skew.{i}": 0.03 / (1 + i) for i in PLAYS},
    },
}
"""Parameters of a hysteresis, beside its start; one that is not here has its own."""


def excitation():
    """Six amplitudes, two frequencies; the widest stroke first."""
    time = np.arange(SAMPLES) * DT
    span = np.array([60.0, 40.0, 20.0, 50.0, 30.0, 10.0])[(time / 0.15).astype(int)]
    hertz = np.where(time < 0.45, 10.0, 20.0)
    return 10.0 + 0.5 * span * (1.0 - np.cos(2.0 * np.pi * hertz * time))


INPUT = excitation()
ONE_TONE = 30.0 - 30.0 * np.cos(2.0 * np.pi * 10.0 * DT * np.arange(SAMPLES))
SAME = {"stop_prandtl_ishlinskii": "prandtl_ishlinskii"}
"""A model that is another one, written in another way."""


def made_by(name, input=INPUT, seed=1):
    """A record made by the hysteresis ``name`` and a lag, the plant, its clean output.

    A model without TRUTHS is taken at its own start, moved by 2 % of each bound's
    width: a start is often degenerate.
    """
    shape = structure(f"{name}+lag", Record(input, 0.12 * input, DT))
    own = TRUTHS.get(name)
    if own is None:
        unit = shape.starts[0]
        moved = unit + 0.02 * np.where(unit < 0.5, 1.0, -1.0)
        kept = [path for path in shape.space.paths if path not in shape.own]
        values = shape.space.named(jnp.asarray(moved))
        own = {p.removeprefix("hysteresis."): values[p] for p in kept if "hyst" in p}
    truth = {f"hysteresis.{path}": value for path, value in own.items()}
    truth |= {"lag.time_constant": 2.5e-3, "calibration.offset": -3.0}
    plant = replace(shape.system, truth)
    clean = np.asarray(free_run(plant, jnp.asarray(input), input[0]))
    noise = NOISE * np.random.default_rng(seed).standard_normal(SAMPLES)
    return Record(input, clean + noise, DT, source="made up"), plant, clean


def check_recovered(found, plant, clean):
    """Every parameter within its standard error, as a plant within the noise."""
    for path, parameter in found.report.parameters.items():
        if parameter.standard_error is None or "rest_" in path:
            continue
        off = abs(parameter.value - float(get(plant, path)))
        assert off < 4.0 * parameter.standard_error, path
    error = (found.simulated - clean)[found.validate]
    assert np.sqrt(np.mean(error**2)) < 0.5 * NOISE


def test_the_model_that_made_a_record_is_chosen():
    # Among a linear one and one that holds it and has four parameters more.
    record, plant, clean = made_by("coleman_hodgdon", ONE_TONE)
    among = ["coleman_hodgdon", "shaped_coleman_hodgdon"]
    found = identify_all(
        record, hysteresis=among, train=TRAIN, options=Options(steps=40)
    )
    assert set(found.fits) == {"lag", *(f"{name}+lag" for name in among)}
    assert found.report.best == "coleman_hodgdon+lag"
    check_recovered(found.best, plant, clean)


@pytest.mark.slow
@pytest.mark.parametrize("name", at("hysteresis"))
def test_each_model_is_chosen_among_all(name):
    record, plant, clean = made_by(name)
    found = identify_all(record, train=TRAIN)
    chosen = found.report.best.removesuffix("+lag")
    assert chosen in (name, SAME.get(name))
    check_recovered(found.fits[chained(name, "", "lag")], plant, clean)


@pytest.mark.slow
def test_the_micromanipulator():
    # Its sensor's noise is 0.067 um, cycles differ by as much.
    if MICROMANIPULATOR.is_file():
        columns = np.loadtxt(MICROMANIPULATOR)
        record = Record(columns[:, 0], columns[:, 4], 1.0 / 200.0, source="whole")
    else:
        record = read_record(
            shipped().parent / "data" / "micromanipulator.csv",
            time="time_s",
            input="input_V",
            output="displacement_um",
        )
    report = identify_all(record).report
    assert report.rows[0].validation_rmse <= 0.15
    assert not [row for row in report.rows if row.status == "failed"]
