"""Preview inverses of models with zeros outside the unit circle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import signals
from oracles.hysteresis import inverse_trapezoid_step
from oracles.loop import closed_loop
from oracles.published import HYSTERESIS, MODEL_533_A, MODEL_533_B, plant_t2, unit_dc
from scipy.signal import lfilter

from piezojax import simulate
from piezojax.catalog import p753, p753_survey
from piezojax.control import InverseFeedforward
from piezojax.control.preview import INVERSES
from piezojax.core.feedback import LoopInput
from piezojax.dynamics import (
    ARMA,
)

SAMPLES = 2_000
MODELS = {  # a, b
    "printed (5.33)": (MODEL_533_A, MODEL_533_B),
    "one zero": ((1.5, -0.56), (0.02, 0.026)),
    "delayed, zeros on both sides": (
        (1.2, -0.3, 0.02),
        (0.0, *(0.01 * np.poly([0.5, -1.3, 1.6]))),
    ),
}
NEAREST = {
    "printed (5.33)": np.sqrt(MODEL_533_B[2] / MODEL_533_B[0]),
    "one zero": 1.3,
    "delayed, zeros on both sides": 1.3,
}
STABLE = {"direct": {}, "zero_phase": {}, "stable": {"preview": 120}}


@jax.jit
def run(made, reference):
    return made(reference)


def inverse(name, kind, **options):
    made = INVERSES[kind](ARMA(*MODELS[name]), **options)
    return lambda reference: run(made, reference)


def response(name, input):
    """Return the output of the model from k = 0 on, at rest at zero before."""
    a, b = MODELS[name]
    return lfilter([0.0, *b], [1.0, *(-x for x in a)], input)


def smooth(samples=SAMPLES):
    """Return a bump of 5 um in the middle, at rest on both sides."""
    return 5.0 * np.exp(-(((np.arange(samples) - samples / 2) / (samples / 40)) ** 2))


def transfer(name, kind, **options):
    """Return the response of inverse and model, and its frequencies in rad/sample."""
    impulse = np.zeros(SAMPLES)
    impulse[SAMPLES // 2] = 1.0
    output = response(name, inverse(name, kind, **options)(jnp.asarray(impulse)))
    w = 2.0 * np.pi * np.fft.rfftfreq(SAMPLES)
    return w, np.fft.rfft(output) * np.exp(1j * w * (SAMPLES // 2))


@pytest.mark.parametrize("name", MODELS)
def test_the_zero_phase_inverse_has_zero_phase(name):
    w, found = transfer(name, "zero_phase")
    zeros = np.roots(np.trim_zeros(MODELS[name][1]))
    outside = zeros[np.abs(zeros) > 1.0]
    assert outside.size
    gain = np.ones_like(w)
    for zero in outside:
        gain *= abs(1.0 - zero * np.exp(-1j * w)) ** 2 / abs(1.0 - zero) ** 2
    assert np.abs(np.angle(found)).max() < 1e-9
    np.testing.assert_allclose(found, gain, rtol=0.0, atol=1e-9 * gain.max())
    np.testing.assert_allclose(found[0], 1.0, rtol=1e-9)


def test_zeros_near_the_unit_circle_are_not_cancelled():
    model = ARMA((0.5,), (1.0, 0.95))  # cancelling this zero would cause ringing
    reference = jnp.asarray(np.eye(1, 400, 200)[0])
    ringing = INVERSES["zero_phase"](model)(reference)
    calm = INVERSES["zero_phase"](model, margin=0.9)(reference)
    assert np.abs(ringing[250]) > 1e-2
    np.testing.assert_allclose(calm[250:], 0.0, atol=1e-12)


@pytest.mark.parametrize("name", MODELS)
def test_stable_inversion_is_exact_with_enough_preview(name):
    reference = smooth()
    input = inverse(name, "stable", preview=150)(jnp.asarray(reference))
    np.testing.assert_allclose(response(name, input), reference, rtol=0.0, atol=1e-9)
    assert np.abs(input).max() < 1e3 * np.abs(reference).max()


@pytest.mark.parametrize("name", MODELS)
def test_the_error_falls_geometrically_with_the_preview(name):
    lengths = np.arange(10, 54, 4)
    errors = []
    for preview in lengths:
        _, found = transfer(name, "stable", preview=int(preview))
        errors.append(np.abs(found - 1.0).max())
    slope = np.polyfit(lengths, np.log(errors), 1)[0]
    np.testing.assert_allclose(slope, -np.log(NEAREST[name]), rtol=0.05)


@pytest.mark.parametrize("name", MODELS)
def test_the_direct_inverse_diverges_and_the_others_do_not(name):
    reference = jnp.asarray(smooth())
    direct = inverse(name, "direct")(reference)
    assert np.abs(direct[-1]) > 1e30
    for kind in ("zero_phase", "stable"):
        bounded = inverse(name, kind, **STABLE[kind])(reference)
        assert np.abs(bounded).max() < 1e4


@pytest.mark.parametrize("kind", STABLE)
def test_all_methods_invert_stable_zeros_exactly(kind):
    model = ARMA((1.5, -0.56), (0.02, 0.01))
    reference = smooth()
    input = INVERSES[kind](model, **STABLE[kind])(jnp.asarray(reference))
    output = lfilter([0.0, 0.02, 0.01], [1.0, -1.5, 0.56], input)
    np.testing.assert_allclose(output, reference, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("kind", ["zero_phase", "stable"])
@pytest.mark.parametrize("name", MODELS)
def test_a_start_at_rest_stays_at_rest(name, kind):
    model = ARMA(*MODELS[name])
    input = inverse(name, kind, **STABLE[kind])(jnp.full(300, 5.0))
    np.testing.assert_allclose(input, 5.0 / model.dc_gain(), rtol=1e-9)


def test_the_preview_has_the_stated_length_and_holds_the_last_reference():
    made = INVERSES["stable"](ARMA(*MODELS["delayed, zeros on both sides"]), preview=8)
    assert made.preview == 1 + 8
    slope = jax.jacobian(made)(jnp.zeros(40))
    assert np.any(slope[5, : 5 + 10] != 0.0)
    assert slope[5, 5 + made.preview] != 0.0
    np.testing.assert_array_equal(slope[5, 5 + made.preview + 1 :], 0.0)
    held = made(jnp.concatenate([smooth(40), jnp.full(20, smooth(40)[-1])]))
    np.testing.assert_allclose(made(jnp.asarray(smooth(40))), held[:40], atol=1e-12)


def test_batches_and_jit_equal_eager():
    made = INVERSES["zero_phase"](ARMA(*MODELS["printed (5.33)"]))
    batch = jnp.stack([jnp.asarray(smooth(200)), jnp.linspace(0.0, 5.0, 200)])
    found = jax.jit(jax.vmap(made))(batch)
    for lane in range(2):
        np.testing.assert_allclose(found[lane], made(batch[lane]), atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "model", "options", "message"),
    [
        ("zero_phase", ((0.5,), (1.0, -1.0)), {}, "the model has a zero at z = 1"),
        ("zero_phase", ((0.5,), (0.0,)), {}, "all b of the model are 0"),
        ("direct", ((0.5,), (0.0, 0.0)), {}, "all b of the model are 0"),
        ("zero_phase", ((0.5,), (1.0,)), {"margin": 1.5}, "margin is 1.5; .* most 1"),
        ("zero_phase", ((0.5,), (1.0,)), {"margin": 0.0}, "margin is 0; .* above 0"),
        ("stable", ((0.5,), (1.0, 1.0)), {"preview": 9}, "a zero on the unit circle"),
        (
            "stable",
            ((0.5,), (1.0, 2.0)),
            {"preview": 1},
            "preview in samples is 1; it must be finite and at least 2",
        ),
    ],
)
def test_models_without_an_inverse_are_refused(kind, model, options, message):
    with pytest.raises(ValueError, match=message):
        INVERSES[kind](ARMA(*model), **options)


class Feedforward:
    """Zero-phase inverse of (5.33) at unit gain, then the inverse hysteresis."""

    def __init__(self):
        b = np.array(unit_dc(MODEL_533_A, MODEL_533_B))
        # Both zeros lie outside: B(z) forward in time, divided by B(1)^2.
        self.ahead = (b / b.sum() ** 2).tolist()
        self.w, self.f, self.u = None, 0.0, 0.0

    def step(self, z, r_next, r, r_prev):
        steps = enumerate(self.ahead)
        w = sum(x * (r_next + j * (r_next - r)) for j, x in steps)
        if self.w is None:
            self.w = [sum(self.ahead) * r] * 2
        a1, a2 = MODEL_533_A
        f = w - a1 * self.w[0] - a2 * self.w[1]
        self.w = [w, self.w[0]]
        self.u = inverse_trapezoid_step(self.f, self.u, f, *HYSTERESIS)
        self.f = f
        return self.u

    def applied(self, u):
        """Do nothing, because there is no feedback."""


def test_inside_a_loop_the_reference_is_extrapolated():
    reference = signals.sine(50, 5.0, 0.1 + 1.0 / p753.RATE)
    inverse = p753_survey.preview_feedforward_pid().inverse
    loop = p753.loop(InverseFeedforward(inverse), 0.0)

    @jax.jit
    def run(loop, reference):
        inputs = LoopInput(reference[1:], jnp.zeros(len(reference) - 1))
        return simulate(loop, inputs, loop.init(0.0))[1]

    found = run(loop, jnp.asarray(reference))
    expected = closed_loop(Feedforward(), reference, plant_t2("trapezoid"), None)
    for column in ("displacement", "command"):
        np.testing.assert_allclose(
            getattr(found, column), expected[column], rtol=0.0, atol=1e-9
        )
    error = expected["displacement"] - reference[:-1]
    assert np.abs(error[200:]).max() < 0.02  # of 10 um, without feedback
