"""Surveyed control schemes on the P-753, against loops from their equations."""

import math
from functools import cache
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
import pytest
from oracles import signals, survey
from oracles.control import make_controller
from oracles.loop import closed_loop
from oracles.published import HYSTERESIS, RATE, plant_t2, smc_gains

from piezojax import (
    simulate,
    study,
)
from piezojax.catalog import CONTROLLERS, p753
from piezojax.catalog import p753_survey as catalog
from piezojax.control import (
    RepetitiveControl,
)
from piezojax.core import paths
from piezojax.core.feedback import LoopInput
from piezojax.dynamics import (
    FirstOrderLag,
)

DT = 1.0 / RATE
NOISE_RMS = 0.012
SAMPLES = 20_000
DRAWS = np.random.default_rng(31).normal(size=SAMPLES)

PID_GAINS = {
    "P": 0.5,
    "I": 3000.0,
    "D": 0.0,
    "derivative_filter": 1e-4,
    "anti_windup": 100.0,
}


def switched(law):
    return survey.Switched(law, smc_gains("smc", "5-3"), DT)


def around_pid():
    pid = make_controller("pid", PID_GAINS, RATE)
    return survey.Repetitive(pid, 0.7, math.exp(-1 / 8), 2_000, 40, 8)


def around_sliding_mode():
    inner = make_controller("smc", smc_gains("smc", "5-3"), RATE)
    return survey.Repetitive(inner, 0.2, math.exp(-1 / 4), 400, 0, 0)


class Case(NamedTuple):
    make: object
    oracle: object


CASES = {
    "boundary layer": Case(
        catalog.boundary_layer, lambda: switched(survey.BoundaryLayer(1e4, 4e4))
    ),
    "super-twisting": Case(
        catalog.super_twisting,
        lambda: switched(survey.SuperTwisting(10.0, 1e6, 1e4, DT)),
    ),
    "feedforward": Case(
        catalog.inverse_feedforward,
        lambda: survey.Feedforward(HYSTERESIS, None, RATE),
    ),
    "feedforward and PID": Case(
        catalog.feedforward_pid,
        lambda: survey.Feedforward(HYSTERESIS, PID_GAINS, RATE),
    ),
    "repetitive": Case(catalog.repetitive, around_pid),
    "repetitive around sliding mode": Case(
        lambda: RepetitiveControl(
            p753.sliding_mode(), FirstOrderLag(4 * DT, DT), 0.2, 400
        ),
        around_sliding_mode,
    ),
}


def references():
    """SIN10, a jump to 4 um and back to 1 um, and rest at 5 um; one second."""
    samples = SAMPLES + 1
    time = np.arange(samples)
    jump = np.where(time < 1_000, 0.0, np.where(time < 9_000, 4.0, 1.0))
    return np.stack(
        [signals.sine(10.0, 5.0, samples * DT), jump, np.full(samples, 5.0)]
    )


@jax.jit
def run(loop, references, draws):
    def one(reference, draws):
        inputs = LoopInput(reference[1:], draws)
        return simulate(loop, inputs, loop.init(reference[0]))[1]

    return jax.vmap(one)(references, draws)


@cache
def samples_of(name):
    draws = np.stack([DRAWS, DRAWS, np.zeros(SAMPLES)])
    return run(p753.loop(CASES[name].make(), NOISE_RMS), references(), draws)


@pytest.mark.parametrize("name", CASES)
def test_the_loop_equals_the_equations(name):
    samples = samples_of(name)
    for lane in range(2):
        expected = closed_loop(
            CASES[name].oracle(),
            references()[lane],
            plant_t2("trapezoid"),
            None,
            noise=NOISE_RMS * DRAWS,
        )
        assert 0.5 < np.abs(expected["displacement"]).max() < 25.0
        for column, values in expected.items():
            np.testing.assert_allclose(
                getattr(samples, column)[lane],
                values,
                rtol=0.0,
                atol=1e-9,
                err_msg=column,
            )


@pytest.mark.parametrize("name", CASES)
def test_a_start_at_rest_stays_at_rest(name):
    samples = samples_of(name)
    voltage = samples.voltage[2, 0]
    assert voltage > 20.0
    np.testing.assert_allclose(samples.displacement[2], 5.0, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(samples.command[2], voltage, rtol=0.0, atol=1e-6)


# Errors with our start values, rounded up: um rms over the second half of SIN10.
LEVELS = {
    "boundary layer": 0.75,
    "super-twisting": 0.03,
    "feedforward": 0.3,
    "feedforward and PID": 0.05,
    "repetitive": 0.003,
}


@pytest.mark.parametrize("name", LEVELS)
def test_start_values_track_sin10(name):
    samples = samples_of(name)
    error = samples.displacement[0] - samples.reference[0]
    rms = np.sqrt(np.mean(error[SAMPLES // 2 :] ** 2))
    assert 0.5 * LEVELS[name] < rms < LEVELS[name]
    assert np.all(samples.command[0] == samples.voltage[0])


STUDY = """
title = "start values"
rate = 20000
plant.catalog = "p753"
actuator = {{ lower = -20.0, upper = 120.0 }}
sensor.noise_rms = 0.012
controller.catalog = "{name}"
references = {{ tune = ["SIN10"], duration = 0.1, settle = 0.05 }}
"""


@pytest.mark.parametrize(
    "name",
    [
        "p753_boundary_layer",
        "p753_super_twisting",
        "p753_feedforward",
        "p753_feedforward_pid",
        "p753_repetitive",
    ],
)
def test_a_study_names_the_controller_and_all_of_its_parameters(name, tmp_path):
    controller = CONTROLLERS[name]()
    text = STUDY.format(name=name)
    for path, value in paths.parameters(controller).items():
        lower, upper = sorted([0.9 * float(value), 1.1 * float(value) or 1e-9])
        text += f'[parameters."controller.{path}"]\n'
        text += f"lower = {lower!r}\nupper = {upper!r}\n"
        text += 'scale = "linear"\n'
    file = tmp_path / "study.toml"
    file.write_text(text)
    case = study.read(file)
    assert eqx.tree_equal(case.loop.controller, controller)
