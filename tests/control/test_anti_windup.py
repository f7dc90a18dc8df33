"""Anti-windup of the sliding mode controllers against loops from the equations."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import three_dof
from oracles.any_order import AnyOrder
from oracles.control import Continuous, ModelReference
from oracles.loop import closed_loop
from oracles.published import plant_t2, smc_gains

from piezojax import Feedback, simulate
from piezojax.catalog import p558, p558_control, p753, p753_survey
from piezojax.control import (
    AlphaBeta,
    ContinuousSlidingMode,
    ModelReferenceSlidingMode,
    SwitchingPID,
)
from piezojax.core import paths
from piezojax.core.axes import PerAxis, packed
from piezojax.core.feedback import LoopInput
from piezojax.dynamics import ARMA, SecondOrderLag
from piezojax.hardware import Saturation, Sensor

DT = p753.DT
SAMPLES = 3_000
RATE = 400.0
DRAWS = np.random.default_rng(3).normal(size=SAMPLES)
TIME = DT * np.arange(SAMPLES + 1)

# Half of the reference is beyond the stroke of about 15 um.
BEYOND = 12.0 * (1.0 - np.cos(2.0 * np.pi * 20.0 * TIME))

MODEL = ((0.97,), (0.004,))  # V to um, with one b coefficient
CONTINUOUS = {"P": 0.001, "I": 1.0, "D": 1e-7, "m": 18e3, "alpha": 0.1, "beta": 1e-4}
REFERENCE = {
    **dict(zip("PIDR", (0.1, 2_000.0, 1e-6, 100.0), strict=True)),
    **{"alpha": 0.3, "beta": 1e-3, "m": (), "Q": 2.0, "inversion": "printed"},
    **{"model_a": MODEL[0], "model_b": MODEL[1]},
    **{"frequency": 2_000.0, "damping": 0.5},
}
NOMINAL, OBSERVED = smc_gains("smc", "5-3"), smc_gains("dob", "5-3")


def law(gains):
    return SwitchingPID(gains["P"], gains["I"], gains["D"], dt=DT)


def model_reference():
    return ModelReferenceSlidingMode(
        law(REFERENCE),
        surface=(),
        error_weight=2.0,
        control_weight=100.0,
        model=ARMA(*MODEL),
        reference_model=SecondOrderLag(2_000.0, 0.5, DT),
        filter=AlphaBeta(0.3, 1e-3, DT),
        inversion="printed",
    )


def continuous():
    return ContinuousSlidingMode(
        law(CONTINUOUS), filter=AlphaBeta(0.1, 1e-4, DT), surface=18e3
    )


CASES = {  # controller; oracle for a rate
    "nominal": (p753.sliding_mode(), lambda w: AnyOrder("smc", NOMINAL | w, 20e3)),
    "observer": (
        p753.disturbance_observer(),
        lambda w: AnyOrder("dob", OBSERVED | w, 20e3),
    ),
    "model reference": (
        model_reference(),
        lambda w: ModelReference(REFERENCE | w, 20e3),
    ),
    "continuous": (continuous(), lambda w: Continuous(CONTINUOUS | w, 20e3)),
}


def wound(controller, rate):
    names = [n for n in paths.parameters(controller) if n.endswith("anti_windup")]
    return paths.replace(controller, dict.fromkeys(names, rate))


@jax.jit
def run(loop, reference):
    inputs = LoopInput(reference[1:], DRAWS)
    return simulate(loop, inputs, loop.init(0.0))[1]


def around(controller, rate):
    return Feedback(
        wound(controller, rate), p753.plant(), p753.actuator(), Sensor(0.012)
    )


@pytest.mark.parametrize("name", CASES)
def test_the_loop_equals_the_equations(name):
    controller, oracle = CASES[name]
    found = run(around(controller, RATE), jnp.asarray(BEYOND))
    expected = closed_loop(
        oracle({"anti_windup": RATE}),
        BEYOND,
        plant_t2("trapezoid"),
        None,
        noise=0.012 * DRAWS,
    )
    clipped = expected["command"] != expected["voltage"]
    assert 0.1 < np.mean(clipped) < 0.9
    for column, values in expected.items():
        np.testing.assert_allclose(
            getattr(found, column), values, rtol=0.0, atol=1e-9, err_msg=column
        )


LATE = {**CASES, "super-twisting": (p753_survey.super_twisting(), None)}


@pytest.mark.parametrize("name", LATE)
def test_the_stage_returns_sooner_with_anti_windup(name):
    def late(rate):
        found = run(around(LATE[name][0], rate), jnp.asarray(BEYOND))
        return np.mean((found.voltage == 120.0) & (BEYOND[:-1] < 14.0))

    without = late(0.0)
    assert without > 0.02
    assert late(RATE) < 0.6 * without


@pytest.mark.parametrize(
    "make", [p753_survey.boundary_layer, lambda: p753_survey.boundary_layer().law]
)
def test_a_law_without_an_integral_has_no_rate(make):
    assert not [n for n in paths.parameters(make()) if n.endswith("anti_windup")]


# Three axes

STEPS = 500
SLOW = three_dof.T * np.arange(STEPS + 1)
FAR = np.stack([30.0 * np.sin(2.0 * np.pi * f * SLOW) for f in (3.0, 5.0, 2.0)], axis=1)
LIMIT = 20.0
CLEAR = np.random.default_rng(8).standard_normal((STEPS, 3)) * p558.NOISE_RMS
AXES = {
    "multi-axis": (
        p558_control.multi_axis(),
        "pid_smc",
        {"gains": three_dof.PID_SMC_GAINS["dynamic"]},
    ),
    "nominal": (
        p558_control.nominal(),
        "nominal_smc",
        {"arx": "matched", "gains": three_dof.DOB_SMC_GAINS["nominal_smc"]},
    ),
}


@cache
def on_three_axes(name, rate):
    controller = wound(AXES[name][0], rate)
    limits = PerAxis(tuple(Saturation(-LIMIT, LIMIT) for _ in range(3)))
    loop = p558_control.loop(controller)
    loop = Feedback(controller, loop.plant, limits, loop.sensor)
    noise = tuple((CLEAR / p558.NOISE_RMS).T)
    inputs = LoopInput(tuple(FAR[1:].T), noise)

    @jax.jit
    def simulated(loop, inputs):
        return packed(simulate(loop, inputs, loop.init(FAR[0]))[1])

    return simulated(loop, jax.tree.map(jnp.asarray, inputs))


@pytest.mark.parametrize("name", AXES)
def test_three_axes_equal_the_equations(name):
    _, kind, options = AXES[name]
    gains = options["gains"] | {"anti_windup": 5.0}
    expected = three_dof.simulate(
        kind, FAR, CLEAR, limits=(-LIMIT, LIMIT), **(options | {"gains": gains})
    )
    found = on_three_axes(name, 5.0)
    assert np.mean(np.abs(expected["u"]) > LIMIT) > 0.1
    for log, column in (("displacement", "y"), ("command", "u")):
        np.testing.assert_allclose(
            getattr(found, log), expected[column], rtol=0.0, atol=1e-9, err_msg=log
        )
    # Without anti-windup the saturated loop differs.
    assert np.max(np.abs(on_three_axes(name, 0.0).command - found.command)) > 1e-3
