import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.adaptive_inverse import AdaptiveInverse as Oracle
from oracles.control import make_controller
from oracles.loop import closed_loop
from oracles.published import plant_t2, smc_gains

import piezojax as pj
from piezojax.analysis.stability.sampled_margins import peak_of
from piezojax.analysis.stability.small_motion import sensitivity
from piezojax.catalog import p753, p753_stage
from piezojax.control.recursive_weights import RecursiveWeights
from piezojax.core.feedback import LoopInput, Observation

SAMPLES = 10_000
NOISE_RMS = 0.012
DRAWS = np.random.default_rng(5).normal(size=SAMPLES)
NEVER = 1e15  # s: no forgetting

NUMBERS = {
    "weights": (7.0, 8e-3, 8e-7, 0.7, 0.5),
    "deviations": (3.0, 4e-3, 4e-7, 2.0, 2.0),
    "thresholds": (0.4, 1.5),
    "cutoff": 1500.0,
    "equation_error": 5.0,
    "share": 0.8,
    "lead": 1.1e-3,
    "offset_deviation": 4.0,
    "dt": p753.DT,
}
PID = {"P": 0.5, "I": 3e3, "D": 1e-5, "derivative_filter": 1e-4, "anti_windup": 100.0}
CONTROLLERS = {
    "pid": (pj.control.PID(*PID.values(), dt=p753.DT), "pid", PID),
    "weak equivalent control": (
        eqx.tree_at(
            lambda c: c.feedback.correction,
            p753.disturbance_observer(),
            jnp.asarray(0.4),
        ),
        "dob",
        {**smc_gains("dob", "5-3"), "correction": 0.4},
    ),
}


def adaptive(controller, **changes):
    return pj.control.AdaptiveInverse(
        controller, **{"memory": NEVER, **NUMBERS, **changes}
    )


def reference(samples=SAMPLES + 1):
    time = np.arange(samples) * p753.DT
    return 2.5 * (1.0 - np.cos(2.0 * np.pi * 25.0 * time)) + np.sin(300.0 * time) ** 3


def around(controller, plant=None):
    plant = p753.plant() if plant is None else plant
    return pj.Feedback(
        controller, plant, p753.actuator(), pj.hardware.Sensor(NOISE_RMS)
    )


@jax.jit
def run(loop, wanted, draws):
    return pj.simulate(loop, LoopInput(wanted[1:], draws), loop.init(wanted[0]))


@pytest.mark.parametrize("name", CONTROLLERS)
def test_the_loop_equals_least_squares_over_all_past_samples(name):
    controller, kind, gains = CONTROLLERS[name]
    inner = make_controller(kind, gains, p753.RATE)
    expected = closed_loop(
        Oracle(inner, **NUMBERS),
        reference(),
        plant_t2("trapezoid"),
        None,
        noise=NOISE_RMS * DRAWS,
    )
    _, found = run(around(adaptive(controller)), reference(), DRAWS)
    for column in ("displacement", "voltage"):
        np.testing.assert_allclose(
            getattr(found, column), expected[column], rtol=0.0, atol=1e-8
        )
    # The controller alone has a larger error.
    _, alone = run(around(controller), reference(), DRAWS)
    assert np.abs(alone.displacement - found.displacement).max() > 0.05


def test_with_a_share_of_zero_the_loop_equals_the_controller():
    printed = p753.disturbance_observer()
    adaptive = p753.adaptive_disturbance_observer()
    _, expected = run(around(printed), reference(), DRAWS)
    _, found = run(around(adaptive), reference(), DRAWS)
    np.testing.assert_allclose(
        found.displacement, expected.displacement, rtol=0.0, atol=1e-9
    )


def test_deviations_of_gain_poles_and_hysteresis_are_learned():
    stage = p753_stage.stage(gain=0.2, poles=-0.2, hysteresis=0.2)
    controller = p753.adaptive_disturbance_observer()
    errors = []
    for share in (0.0, 1.0):
        one = eqx.tree_at(lambda c: c.share, controller, jnp.asarray(share))
        _, found = run(around(one, stage), reference(), 0.0 * DRAWS)
        error = (found.displacement - found.reference)[SAMPLES // 2 :]
        errors.append(float(jnp.sqrt(jnp.mean(error**2))))
    assert errors[1] < errors[0] / 4.0


def test_stops_follow_the_input_of_the_dynamics():
    """With a slow pole the stage lags the hysteresis by a twentieth of a cycle."""
    stage = p753_stage.stage(poles=-0.2, hysteresis=0.2)
    wanted = 5.0 - 2.5 * np.cos(2.0 * np.pi * 50.0 * np.arange(SAMPLES + 1) * p753.DT)
    controller = p753.with_adaptive_inverse(p753.pid())
    errors = []
    for lead in (0.0, controller.lead):
        one = eqx.tree_at(
            lambda c: (c.share, c.lead), controller, (jnp.asarray(1.0), lead)
        )
        _, found = run(around(one, stage), wanted, 0.0 * DRAWS)
        error = (found.displacement - found.reference)[2000:6000]
        errors.append(float(jnp.sqrt(jnp.mean(error**2))))
    assert errors[1] < errors[0] / 2.0, errors


def test_at_rest_weights_are_constant_and_margins_equal_the_controllers():
    inner = CONTROLLERS["pid"][0]
    whole = adaptive(inner, memory=0.1, share=1.0)
    loop = around(whole)
    _, found = run(loop, jnp.full(SAMPLES + 1, 3.0), 0.0 * DRAWS)
    np.testing.assert_allclose(found.displacement, 3.0, atol=1e-9)
    np.testing.assert_allclose(found.voltage, found.voltage[0], atol=1e-9)
    peaks = [
        float(peak_of(sensitivity(around(one), 3.0, duration=0.02)))
        for one in (inner, whole)
    ]
    assert peaks[0] > 1.05
    np.testing.assert_allclose(peaks[1], peaks[0], rtol=1e-9)


def test_gradients_equal_finite_differences_and_jit_is_eager():
    wanted, draws = reference(801), DRAWS[:800]

    def error(scale):
        values = jnp.asarray([0.8, 1500.0, 5.0, 0.02, 1.1e-3]) * scale
        whole = eqx.tree_at(
            lambda c: (c.share, c.cutoff, c.equation_error, c.memory, c.lead),
            adaptive(CONTROLLERS["pid"][0]),
            tuple(values),
        )
        _, found = run(around(whole), wanted, draws)
        return jnp.mean((found.displacement - found.reference) ** 2)

    slope = jax.jit(jax.jacfwd(error))(jnp.ones(5))
    once = jax.jit(error)
    step = 1e-5
    for i, along in enumerate(np.eye(5)):
        ends = [float(once(jnp.ones(5) + s * step * along)) for s in (1.0, -1.0)]
        assert slope[i] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-4)
    whole = adaptive(CONTROLLERS["pid"][0])
    zero, seen = jnp.zeros(()), Observation(*jnp.asarray([1.0, 1.1, 0.9, 8.0]))
    state = whole.init(Observation(zero, zero, zero, zero))
    for left, right in zip(
        jax.tree.leaves(whole.step(state, seen)),
        jax.tree.leaves(jax.jit(type(whole).step)(whole, state, seen)),
        strict=True,
    ):
        np.testing.assert_allclose(left, right, rtol=1e-12, atol=1e-12)


def test_forgetting_restores_the_prior_covariance():
    """With a row of zeros the covariance returns to its initial value."""
    learner = RecursiveWeights((1.0, 2.0), (0.5, 0.0), 0.1, 0.01, 1e-3)
    rows = np.random.default_rng(1).normal(size=(100, 2))
    state = learner.init()

    @jax.jit
    def step(state, row, target):
        return learner.step(state, (tuple(row), jnp.asarray(target)))

    for row in rows:
        state, weights = step(state, row, 3.0 * row[0] + 2.0 * row[1])
    np.testing.assert_allclose(weights, (3.0, 2.0), atol=0.02)
    assert weights[1] == 2.0
    assert state.covariance[0, 0] < 0.25 * 0.25
    for _ in range(200):
        state, weights = step(state, np.zeros(2), 0.0)
    np.testing.assert_allclose(state.covariance, np.diag([0.25, 0.0]), atol=1e-8)
    np.testing.assert_allclose(weights, (3.0, 2.0), atol=0.02)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"weights": (1.0, 2.0)}, "2 weights and 5 deviations; each weight needs one"),
        (
            {"weights": (1.0,) * 6, "deviations": (1.0,) * 6},
            "6 weights for 2 thresholds; there must be three weights and one more for",
        ),
        ({"thresholds": (0.4, 0.0)}, "thresholds in um is 0; it must be finite and ab"),
        ({"deviations": (-1.0,) + (1.0,) * 4}, "deviations .* is -1; .* at least 0"),
        ({"cutoff": 7e4}, "cutoff in rad/s is 70000; .* above 0 and below 62831.9"),
        (
            {"equation_error": 0.0},
            "equation_error .* is 0; it must be finite and above 0",
        ),
        ({"memory": -1.0}, "memory in s is -1; it must be finite and above 0"),
        ({"offset_deviation": 0.0}, "offset_deviation in V is 0"),
        ({"lead": -1e-3}, "lead in s is -0.001; it must be .* at least 0"),
        ({"share": np.nan}, "share is nan; it must be finite"),
        ({"dt": 0.0}, "dt in s is 0"),
    ],
)
def test_impossible_values_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        adaptive(CONTROLLERS["pid"][0], **changes)
