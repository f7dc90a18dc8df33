"""The Bouc-Wen oscillator from a simulated record and from the shared benchmark."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from oracles import bouc_wen as oracle

from piezojax import (
    Record,
)
from piezojax.identification import (
    average_periods,
    bouc_wen,
    fit_neural_state_space,
    fit_structure,
    steady_response,
)
from piezojax.identification.estimators.model_bouc_wen import linear_oscillator
from piezojax.identification.records.resample import resample

RATE = 750.0
SHARED = Path(__file__).parents[2].parent / "shared/data/bouc_wen/train.h5"


def record_of(force, displacement):
    """Return a record of one steady period in N and m."""
    return Record(force, displacement, 1.0 / RATE, "N", "m", "made", len(force))


def predicted(system, record, factor):
    """Return the settled output of `record`, with `factor` times the samples."""
    fine = resample(record, factor)
    outputs = steady_response(system, jnp.asarray(fine.input), fine.samples)
    return np.asarray(outputs)[::factor]


def rms(error):
    return np.sqrt(np.mean(error**2))


TRUTH = {
    "mass": 1.3,
    "damping": 25.0,
    "stiffness": 6e4,
    "alpha": 3e4,
    "beta": 70.0,
    "gamma": 0.9,
    "delta": -0.3,
    "nu": 1.5,
}
LINES = np.arange(4, 103)  # lines of 512 samples at 750 Hz: 6 to 149 Hz


def made(seed, truth=TRUTH):
    force = oracle.multisine(512, LINES, 50.0, seed)
    displacement = oracle.steady_displacement(force, 1.0 / RATE, truth, periods=4)
    return record_of(force, displacement)


def of_two_starts(record):
    """Return the structure with two of its starts, which suffice here."""
    structure = bouc_wen(record)
    return structure._replace(starts=structure.starts[:2])


def test_all_parameters_are_recovered_from_a_simulated_record():
    factor = 16
    fine = resample(made(1), factor)
    system, errors = fit_structure(of_two_starts(fine), fine, steps=60)
    found = {
        "mass": system.mass,
        "damping": system.damping,
        "stiffness": system.stiffness,
        "alpha": system.hysteresis.alpha,
        "beta_gamma": system.hysteresis.beta_gamma,
        "beta_delta": system.hysteresis.beta_delta,
        "nu": system.hysteresis.nu,
    }
    expected = TRUTH | {"beta_gamma": 70.0 * 0.9, "beta_delta": 70.0 * -0.3}
    for name, value in found.items():
        np.testing.assert_allclose(value, expected[name], rtol=0.02, err_msg=name)
    assert np.min(errors) < 1e-3
    fresh = made(2)
    error = rms(predicted(system, fresh, factor) - fresh.output)
    assert error < 1e-3 * np.std(fresh.output)


def test_linear_oscillator_is_found_exactly():
    force = oracle.multisine(512, LINES, 50.0, 3)
    s = 2j * np.pi * np.fft.rfftfreq(512, 1.0 / RATE)
    response = 1.0 / (2.0 * s**2 + 40.0 * s + 1e5)
    displacement = np.fft.irfft(response * np.fft.rfft(force), 512)
    found = linear_oscillator(record_of(force, displacement))
    np.testing.assert_allclose(found, [2.0, 40.0, 1e5], rtol=1e-9)


def test_starts_are_in_the_box_and_divide_the_stiffness():
    record = made(1)
    structure = bouc_wen(record)
    mass, _, stiffness = linear_oscillator(record)
    assert np.all((structure.starts > 0.0) & (structure.starts < 1.0))
    for start in structure.starts:
        named = structure.space.named(jnp.asarray(start))
        both = named["stiffness"] + named["hysteresis.alpha"]
        np.testing.assert_allclose([named["mass"], both], [mass, stiffness], rtol=1e-9)


def test_a_record_of_another_system_is_refused():
    force = oracle.multisine(512, LINES, 50.0, 3)
    with pytest.raises(ValueError, match="made: the best linear oscillator has mass"):
        bouc_wen(record_of(force, -1e-5 * force))


PERIOD = 8192


@pytest.fixture(scope="module")
def benchmark():
    """Return the shared training record and a new noiseless period of its spectrum."""
    h5py = pytest.importorskip("h5py")
    if not SHARED.exists():
        pytest.skip(f"the shared record {SHARED} is absent")
    with h5py.File(SHARED) as file:
        force, displacement = (np.ravel(file[f"multisine/{name}"]) for name in "uy")
        assert float(np.ravel(file["multisine/fs"])[0]) == RATE
    record = Record(force, displacement, 1.0 / RATE, "N", "m", "train.h5", PERIOD)
    amplitudes = np.abs(np.fft.rfft(force[:PERIOD]))
    lines = np.flatnonzero(amplitudes > 0.5 * amplitudes.max())
    fresh = oracle.multisine(PERIOD, lines, np.std(force), 2024)
    truth = oracle.steady_displacement(fresh, 1.0 / RATE, oracle.BENCHMARK)
    return average_periods(record), record_of(fresh, truth)


@pytest.mark.slow
def test_the_true_model_reproduces_the_shared_record(benchmark):
    mean, _ = benchmark
    made = oracle.steady_displacement(mean.input, 1.0 / RATE, oracle.BENCHMARK)
    # noise of 7.4e-6 m, averaged over four periods
    assert rms(made - mean.output) < 4e-6


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
def test_white_box_on_the_shared_record(benchmark):
    mean, fresh = benchmark
    fine = resample(mean, 8)
    system, _ = fit_structure(of_two_starts(fine), fine, settle=8 * 1000, steps=60)
    assert rms(predicted(system, fresh, 8) - fresh.output) < 6e-7  # m; bar 3e-6


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
def test_black_box_on_the_shared_record(benchmark):
    mean, fresh = benchmark
    system = fit_neural_state_space(resample(mean), settle=1000, steps=120)
    assert rms(predicted(system, fresh, 1) - fresh.output) < 1.2e-5  # m; bar 2e-5
