"""The input that was in force before a record is fitted with the stage."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from piezojax.core.paths import parameters
from piezojax.core.system import Affine, series
from piezojax.dynamics import FirstOrderLag
from piezojax.identification import Record, identify
from piezojax.identification.chain import structure
from piezojax.identification.estimators.approach import (
    BEFORE,
    Before,
    input_before,
    without_before,
)
from piezojax.identification.estimators.free_runs import free_run, from_rest

DT, NOISE, SAMPLES = 1e-4, 2e-3, 4000
THRESHOLDS, WEIGHTS, LINEAR = np.array([5.0, 20.0]), np.array([0.02, 0.01]), 0.08
FREQUENCY, DAMPING = 800.0, 0.02


def play_outputs(voltages, memory):
    found = []
    for voltage in voltages:
        memory = np.clip(memory, voltage - THRESHOLDS, voltage + THRESHOLDS)
        found.append(LINEAR * voltage + WEIGHTS @ memory)
    return np.array(found), memory


def readings(before, voltages):
    """Return readings of plays before a resonance, at rest under ``before``.

    The stage was at 0 V, then moved to ``before``. A reading is taken when the voltage
    of its row starts to act.
    """
    _, memory = play_outputs(np.linspace(0.0, before, 200), np.zeros(2))
    pushes, _ = play_outputs(np.r_[before, voltages], memory)
    rate = 2.0 * np.pi * FREQUENCY
    continuous = ([rate**2], [1.0, 2.0 * DAMPING * rate, rate**2])
    numerator, denominator, _ = scipy.signal.cont2discrete(continuous, DT, "zoh")
    numerator = numerator.ravel()  # its first coefficient is 0
    rest = pushes[0] * scipy.signal.lfilter_zi(numerator, denominator)
    moved, _ = scipy.signal.lfilter(numerator, denominator, pushes[1:], zi=rest)
    noise = np.random.default_rng(3).standard_normal(voltages.size)
    return moved + NOISE * noise


def drive(first):
    """Return cycles of three heights, from ``first`` on, after 5 ms of it."""
    time = DT * np.arange(SAMPLES)
    wave = np.sin(2.0 * np.pi * 10.0 * time) * (0.3 + 0.7 * np.cos(6.0 * time) ** 2)
    wave += 0.1 * np.sin(2.0 * np.pi * 470.0 * time)
    return np.r_[np.full(50, first), np.clip(first + 45.0 * wave, 0.0, 100.0)]


@pytest.mark.parametrize("before", [50.0, 38.0])
def test_the_input_before_a_record_is_found(before):
    voltages = drive(50.0)
    record = Record(voltages, readings(before, voltages), DT)
    fit = identify(record, "prandtl_ishlinskii+mode")
    # The thresholds of the model differ from those of the stage, which does not matter
    # before the first motion.
    assert np.std(fit.errors(slice(0, 100))[0]) < 1.5 * NOISE
    assert fit.report.validation.rmse_percent_of_span < 0.1
    found = fit.report.parameters["input before the record"]
    assert fit.units["input before the record"] == "V"
    assert found.value == pytest.approx(before, abs=1.5)
    assert not any("before" in path for path in parameters(fit.plant))


def test_the_part_for_it_changes_no_output():
    stage = series(lag=FirstOrderLag(1e-3, dt=DT), calibration=Affine(0.1, 2.0))
    parts = dict(zip(stage.names, stage.parts, strict=True))
    begun = series(before=Before(30.0), **parts)
    voltages = jnp.asarray(drive(50.0))
    expected = free_run(stage, voltages, 30.0)
    np.testing.assert_allclose(from_rest(begun, voltages), expected, atol=1e-12)
    assert from_rest(stage, voltages)[0] == pytest.approx(7.0)
    assert without_before(begun) == stage
    assert without_before(stage.parts[0]) == stage.parts[0]
    unnamed = stage.parts[0] >> stage.parts[1]
    assert without_before(unnamed) is unnamed
    assert (float(input_before(begun, 1.0)), input_before(stage, 1.0)) == (30.0, 1.0)


def test_a_structure_has_it_once():
    voltages = drive(50.0)
    shape = structure("prandtl_ishlinskii", Record(voltages, 0.1 * voltages, DT))
    begun = shape.with_before(voltages)
    assert begun.with_before(voltages) is begun
    assert begun.without([BEFORE]).space.paths == shape.space.paths
    assert set(begun.own) == {BEFORE, *shape.own}
    bounds = begun.space.ranges()[BEFORE]
    margin = 0.5 * np.ptp(voltages)
    assert bounds.lower == min(voltages.min(), 0.0) - margin
    assert bounds.upper == voltages.max() + margin
    for unit in begun.starts:
        system = begun.space.put(begun.system, jnp.asarray(unit))
        assert float(input_before(system, 0.0)) == pytest.approx(50.0)
