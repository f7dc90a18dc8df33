"""Sliding mode, inversion and disturbance observer on models of any order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import signals
from oracles.any_order import AnyOrder
from oracles.loop import closed_loop
from oracles.published import HYSTERESIS, MODEL_533_A, MODEL_533_B, plant_t2

from piezojax import Feedback, simulate
from piezojax.catalog import p753
from piezojax.control import (
    AlphaBeta,
    DisturbanceObserverControl,
    InversionControl,
    SlidingMode,
    SwitchingPID,
)
from piezojax.core.feedback import LoopInput
from piezojax.dynamics import ARMA
from piezojax.hardware import Sensor
from piezojax.hysteresis import ColemanHodgdon, InverseColemanHodgdon

SAMPLES = 3_000
DRAWS = np.random.default_rng(5).normal(size=SAMPLES)
NOISE_RMS = 0.012
KE = 0.1347


def behind(poles):
    """Return the printed model (5.33) followed by further poles of unit gain."""
    a = -np.poly([*np.roots([1.0, *(-a for a in MODEL_533_A)]), *poles])[1:]
    return tuple(a.real), tuple(np.prod(1.0 - poles).real * np.array(MODEL_533_B))


MODELS = {
    1: ((0.955,), (0.045,)),
    2: (MODEL_533_A, tuple(MODEL_533_B)),
    3: behind(np.array([0.3])),
    4: behind(np.array([0.1 + 0.1j, 0.1 - 0.1j])),
}
"""Coefficients a and b, in um, by order; the last has fewer b than a."""


def gains_of(order):
    a, b = MODELS[order]
    return {
        **dict(zip("PIDQR", (0.01, 30.0, 1e-6, 1.0, 100.0), strict=True)),
        **{"m": 18_000.0, "alpha": 0.1, "beta": 1e-4, "Ke": KE},
        # With four equal poles at 500 rad/s half of the digits would be lost.
        "cutoff": 500.0 if order < 4 else 1_500.0,
        **{"model_a": a, "model_b": b, "hysteresis": HYSTERESIS},
    }


def sliding_mode(gains):
    dt = p753.DT
    return SlidingMode(
        SwitchingPID(gains["P"], gains["I"], gains["D"], dt=dt),
        model=ARMA(gains["model_a"], gains["model_b"]),
        filter=AlphaBeta(gains["alpha"], gains["beta"], dt),
        surface=gains["m"],
        error_weight=gains["Q"],
        control_weight=gains["R"],
    )


def observer(gains):
    feedback = sliding_mode(gains)
    return DisturbanceObserverControl(
        feedback, feedback.model, gains["Ke"], gains["cutoff"], p753.DT
    )


def inversion(gains):
    inverse = InverseColemanHodgdon(ColemanHodgdon(*gains["hysteresis"]))
    return InversionControl(sliding_mode(gains), inverse)


MAKE = {"smc": sliding_mode, "inversion": inversion, "dob": observer}


@jax.jit
def run(loop, reference):
    inputs = LoopInput(reference[1:], DRAWS)
    return simulate(loop, inputs, loop.init(0.0))[1]


@pytest.mark.parametrize("order", MODELS)
@pytest.mark.parametrize("kind", MAKE)
def test_a_loop_of_any_order_equals_the_matrix_form(kind, order):
    gains = gains_of(order)
    reference = signals.ten_references()["SIN50"][: SAMPLES + 1]
    loop = Feedback(MAKE[kind](gains), p753.plant(), p753.actuator(), Sensor(NOISE_RMS))
    found = run(loop, jnp.asarray(reference))
    expected = closed_loop(
        AnyOrder(kind, gains, 20e3),
        reference,
        plant_t2("trapezoid"),
        None,
        noise=NOISE_RMS * DRAWS,
    )
    assert 1.0 < np.abs(expected["displacement"]).max() < 15.0
    for column, values in expected.items():
        np.testing.assert_allclose(
            getattr(found, column), values, rtol=0.0, atol=1e-9, err_msg=column
        )


@pytest.mark.parametrize("order", MODELS)
def test_a_loop_starts_at_rest(order):
    loop = Feedback(
        observer(gains_of(order)), p753.plant(), p753.actuator(), Sensor(0.0)
    )
    state = loop.init(5.0)
    for _ in range(3):
        state, sample = loop.step(state, LoopInput(jnp.asarray(5.0), jnp.zeros(())))
    np.testing.assert_allclose(sample.displacement, 5.0, rtol=0.0, atol=1e-9)
