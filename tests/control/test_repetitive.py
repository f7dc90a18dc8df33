"""Repetitive control: the error from period to period on a linear loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax import (
    Feedback,
    loop_inputs,
    simulate,
)
from piezojax.control import (
    PID,
    RepetitiveControl,
)
from piezojax.core.system import Affine
from piezojax.dynamics import (
    ARMA,
    FirstOrderLag,
)
from piezojax.hardware import (
    Sensor,
)

DT, PERIOD, PERIODS = 1e-3, 50, 40
INNER = PID(0.2, 200.0, dt=DT)
STAGE = ARMA((0.5,), (0.5,))


def loop_of(controller):
    return Feedback(controller, STAGE, Affine(), Sensor(0.0))


@jax.jit
def errors_of(loop):
    time = jnp.arange(PERIODS * PERIOD)
    # harmonics that the loop follows well, poorly, and hardly at all
    angle = 2.0 * jnp.pi * time[:, None] / PERIOD * jnp.asarray([1.0, 3.0, 9.0])
    reference = (1.0 - jnp.cos(angle)).sum(axis=1)
    samples = simulate(loop, loop_inputs(reference), loop.init(0.0))[1]
    return samples.reference - samples.displacement


def harmonics(errors):
    spectra = np.fft.rfft(np.reshape(errors, (PERIODS, PERIOD)), axis=1)
    return spectra[:, [1, 3, 9]]


def inner_loop(harmonic):
    """Return T, from r to z, at a harmonic of the period."""
    z = np.exp(2j * np.pi * harmonic / PERIOD)
    controller = 0.2 + 200.0 * DT / (1.0 - 1.0 / z)
    # The reading lags the voltage by one sample.
    stage = 0.5 / z / (1.0 - 0.5 / z)
    return controller * stage / (1.0 + controller * stage)


def factor(harmonic, gain, lead):
    """Return Q (1 - gain z^lead T) with the filter of weights 1/4, 1/2, 1/4."""
    angle = 2.0 * np.pi * harmonic / PERIOD
    through = 0.5 + 0.5 * np.cos(angle)
    return through * (1.0 - gain * np.exp(1j * angle * lead) * inner_loop(harmonic))


def learning(gain, lead):
    smooth = ARMA((), (0.25, 0.5, 0.25))
    return loop_of(RepetitiveControl(INNER, smooth, gain, PERIOD, lead, 1))


ALL = np.linspace(1e-3, PERIOD / 2, 2_000)


@pytest.mark.parametrize(("gain", "lead"), [(1.0, 2), (0.5, 2)])
def test_errors_contract_to_the_residual_of_the_filter(gain, lead):
    slowest = np.abs(factor(ALL, gain, lead)).max()
    assert slowest < 0.8
    found = harmonics(errors_of(learning(gain, lead)))
    harmonic = np.array([1, 3, 9])
    through = 0.5 + 0.5 * np.cos(2.0 * np.pi * harmonic / PERIOD)
    sensitivity = 1.0 - inner_loop(harmonic)
    left = (1.0 - through) * sensitivity / (1.0 - factor(harmonic, gain, lead))
    limit = -0.5 * PERIOD * left
    distance = np.linalg.norm(found - limit, axis=1)
    assert distance[-1] < 0.02
    # from period 1 on, at least as fast as the bound of the condition
    assert np.all(
        distance[5:] < 2.0 * distance[1] * slowest ** np.arange(4, PERIODS - 1)
    )
    assert np.abs(found[-1, 0]) < 0.1 * np.abs(found[0, 0])


def test_errors_grow_if_the_condition_is_violated():
    assert np.abs(factor(ALL, 3.0, 0)).max() > 1.2
    found = np.reshape(errors_of(learning(3.0, 0)), (PERIODS, PERIOD))
    rms = np.sqrt(np.mean(found**2, axis=1))
    assert rms[-1] > 100.0 * rms[1]


def test_with_zero_gain_the_loop_equals_the_feedback():
    controller = RepetitiveControl(INNER, FirstOrderLag(5e-3, DT), 0.0, PERIOD, 4, 5)
    np.testing.assert_array_equal(
        errors_of(loop_of(controller)), errors_of(loop_of(INNER))
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gain": -0.1}, "gain is -0.1; .* at least 0"),
        ({"period": 1}, "period in samples is 1; .* at least 2"),
        ({"lead": -1}, "lead in samples is -1; .* at least 0"),
        ({"advance": -1}, "advance in samples is -1; .* at least 0"),
        (
            {"lead": 30, "advance": 20},
            "lead is 30 and advance 20 samples; their sum must be below the period, 50",
        ),
    ],
)
def test_bad_parameters_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        RepetitiveControl(INNER, Affine(), **({"gain": 0.5, "period": 50} | options))


@pytest.mark.parametrize("name", ["period", "lead", "advance"])
def test_counts_must_be_whole(name):
    counts = {"gain": 0.5, "period": 50, name: 7.5}
    # The type checker of the tests may raise first.
    message = rf"{name} in samples is 7\.5; it must be whole|parameter '{name}'"
    with pytest.raises((ValueError, TypeError), match=message):
        RepetitiveControl(INNER, Affine(), **counts)


def test_the_longest_allowed_lead_learns():
    controller = RepetitiveControl(INNER, Affine(), 0.1, PERIOD, PERIOD - 1)
    state = loop_of(controller).init(0.0)
    assert state.controller.line.shape == (PERIOD,)
    assert np.all(np.isfinite(errors_of(loop_of(controller))))
