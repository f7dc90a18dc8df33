"""Controllers of chapter 4 against loops from its equations."""

from functools import cache
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import signals
from oracles.loop import closed_loop
from oracles.published import HYSTERESIS, plant_t2, unit_dc

from piezojax import (
    Feedback,
    loop_inputs,
    series,
    simulate,
)
from piezojax.catalog import p753
from piezojax.catalog import p753_chapter4 as catalog
from piezojax.control import (
    AlphaBeta,
    Anticipation,
    ModelReferenceSlidingMode,
    SwitchingPID,
)
from piezojax.control.output_tracking import INVERSIONS
from piezojax.core.feedback import LoopInput, Observation
from piezojax.core.metrics import (
    Tracking,
)
from piezojax.dynamics import (
    ARMA,
    SecondOrderLag,
)
from piezojax.hardware import (
    Sensor,
)

NOISE_RMS = 0.012
DRAWS = np.random.default_rng(21).normal(size=20_000)

# Table 4-1: a_1, a_2, b_0, b_1, b_2.
MODELS = {
    1_000: (0.3212, 0.01025, 0.003889, 0.1189, -0.01765),
    2_000: (0.0712, 0.12058, 0.002944, 0.10592, 0.01797),
    5_000: (0.7567, -0.16145, 0.003463, 0.01386, 0.00447),
    10_000: (1.0589, -0.15055, 0.002018, 0.00075, 0.01001),
    20_000: (1.6092, -0.6248, 0.000778, -0.00041, 0.00134),
}
# Table 4-4: P, I, D, R.
TRACKING = {
    1_000: (9.6, 1_500.0, 0.001, 0.05),
    2_000: (4.0, 1_000.0, 2e-5, 0.001),
    5_000: (2.0, 1_500.0, 2e-5, 0.001),
    10_000: (1.5, 3_500.0, 2e-5, 0.001),
    20_000: (1.0, 12_000.0, 2e-5, 0.001),
}
# Section 4.5.4.3: P, I, D.
CONTINUOUS = {
    5_000: (1e-4, 0.03, 1e-7),
    10_000: (0.002, 0.6, 1e-7),
    20_000: (0.001, 1.0, 1e-7),
}
FILTERS = {1_000: (0.3, 0.001)}

# Table 3-2, numerator of y_2, with unit DC gain.
STAGE_A = (1.6531, -0.6758)
STAGE_B = unit_dc(STAGE_A, (-0.07323, 0.1736, -0.09756))
STAGE = {"hysteresis": HYSTERESIS, "step": "trapezoid", "p": STAGE_A, "g": STAGE_B}
# ours: a stage that is fast enough for the slow rates
QUICK_A, QUICK_B = (0.3, 0.05), (0.6, 0.04, 0.01)
QUICK = {"hysteresis": HYSTERESIS, "step": "trapezoid", "p": QUICK_A, "g": QUICK_B}


def common(rate, m, q=1.0):
    alpha, beta = FILTERS.get(rate, (0.1, 1e-4))
    model = MODELS[rate]
    return {
        "alpha": alpha,
        "beta": beta,
        "m": m,
        "Q": q,
        "model_a": model[:2],
        "model_b": model[2:],
    }


def tracking(rate):
    pid = dict(zip("PIDR", TRACKING[rate], strict=True))
    reference_model = {"frequency": 3_000.0, "damping": 0.25}
    return common(rate, (0.99,)) | pid | reference_model


def continuous(rate):
    return common(rate, 18_000.0) | dict(zip("PID", CONTINUOUS[rate], strict=True))


def gains_of(a, b, m, inversion):
    """Return gains (ours) for a model of another order at 20 kHz."""
    return {
        **dict(zip("PIDR", (0.1, 2_000.0, 1e-6, 100.0), strict=True)),
        **{"alpha": 0.3, "beta": 1e-3, "m": m, "Q": 2.0},
        **{"model_a": a, "model_b": b, "frequency": 2_000.0, "damping": 0.5},
        "inversion": inversion,
    }


def controller_of(gains, rate=20_000):
    """Return the model-reference controller of the package with the oracle's gains."""
    controller = ModelReferenceSlidingMode(
        SwitchingPID(gains["P"], gains["I"], gains["D"], dt=1 / rate),
        surface=gains["m"],
        error_weight=gains["Q"],
        control_weight=gains["R"],
        model=ARMA(gains["model_a"], gains["model_b"]),
        reference_model=SecondOrderLag(gains["frequency"], gains["damping"], 1 / rate),
        filter=AlphaBeta(gains["alpha"], gains["beta"], 1 / rate),
        inversion=gains.get("inversion", "tikhonov"),
    )
    lead = gains.get("lead")
    return controller if lead is None else Anticipation(controller, (lead,))


FIRST = gains_of((0.97,), (0.004,), (), "printed")
THIRD = gains_of(
    (1.2, -0.3, 0.02), (0.006, 0.002, 0.001, 0.0005), (0.2, -0.4), "printed"
)
TIKHONOV = THIRD | {"inversion": "tikhonov", "R": 0.01}
AHEAD = TIKHONOV | {"lead": 2.5}
UNEVEN = gains_of((1.2, -0.3, 0.02), (0.006, 0.002), (0.2, -0.4), "printed")

BANG_BANG = {
    **common(20_000, 18_000.0),
    **{"K": 1.0, "R": 1.0},
}
TRADITIONAL = {
    20_000: {**common(20_000, 18_000.0), "P": 0.001, "I": 10.0, "D": 1e-6, "R": 400.0},
    1_000: {**common(1_000, 1_000.0), "P": 0.6, "I": 240.0, "D": 0.0005, "R": 100.0},
}


class Published(NamedTuple):
    controller: eqx.Module
    kind: str
    gains: dict
    plant: dict = STAGE
    rate: int = 20_000


CASES = {
    **{
        f"model reference at {rate} Hz": Published(
            catalog.model_reference(rate),
            "model reference",
            tracking(rate),
            plant,
            rate,
        )
        for rate, plant in zip(MODELS, [QUICK] * 4 + [STAGE], strict=True)
    },
    "first order": Published(controller_of(FIRST), "model reference", FIRST),
    "third order": Published(controller_of(THIRD), "model reference", THIRD),
    "third, Tikhonov": Published(controller_of(TIKHONOV), "model reference", TIKHONOV),
    "third, ahead": Published(controller_of(AHEAD), "model reference", AHEAD),
    "orders apart": Published(controller_of(UNEVEN), "model reference", UNEVEN),
    **{
        f"continuous at {rate} Hz": Published(
            catalog.continuous(rate), "continuous", continuous(rate), plant, rate
        )
        for rate, plant in zip(CONTINUOUS, [QUICK, QUICK, STAGE], strict=True)
    },
    "traditional at 20 kHz": Published(
        catalog.traditional(), "smc", TRADITIONAL[20_000]
    ),
    "bang-bang": Published(
        catalog.bang_bang(), "bang-bang", BANG_BANG, plant_t2("trapezoid")
    ),
}


def references(rate):
    """Return a sum of sines with a fade-in, a jump, and a constant; one second."""
    found = signals.ten_references()["SW50"][:: 20_000 // rate]
    found = found * np.minimum(np.arange(found.size) / (0.1 * rate), 1.0)
    samples = rate + 1
    jump = np.where(np.arange(samples) < rate // 50, 0.0, 5.0)
    return np.stack([found[:samples], jump, np.full(samples, 5.0)])


@jax.jit
def run(loop, references, draws):
    def one(reference, draws):
        inputs = LoopInput(reference[1:], draws)
        return simulate(loop, inputs, loop.init(reference[0]))[1]

    return jax.vmap(one)(references, draws)


@cache
def samples_of(name):
    """Return the references, the draws, and the outputs of the package."""
    case = CASES[name]
    draws = np.stack([DRAWS[: case.rate]] * 2 + [np.zeros(case.rate)])
    return (
        references(case.rate),
        draws,
        run(loop_of(case), references(case.rate), draws),
    )


def loop_of(case):
    plant = series(
        hysteresis=p753.hysteresis(), dynamics=ARMA(case.plant["p"], case.plant["g"])
    )
    return Feedback(case.controller, plant, p753.actuator(), Sensor(NOISE_RMS))


@pytest.mark.parametrize("name", CASES)
def test_the_loop_equals_the_published_one(name):
    case = CASES[name]
    references, draws, samples = samples_of(name)
    for lane in range(2):
        expected = closed_loop(
            case.kind,
            references[lane],
            case.plant,
            case.gains,
            noise=NOISE_RMS * draws[lane],
            rate=case.rate,
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


# Bang-bang control does not rest: the sign of a rounding error is 1.
@pytest.mark.parametrize("name", [name for name in CASES if name != "bang-bang"])
def test_a_start_at_rest_stays_at_rest(name):
    samples = samples_of(name)[2]
    start = 200  # before rounding errors grow with unstable printed gains
    voltage = samples.voltage[2, 0]
    assert voltage > 20.0
    np.testing.assert_allclose(
        samples.displacement[2, :start], 5.0, rtol=0.0, atol=1e-8
    )
    np.testing.assert_allclose(samples.command[2, :start], voltage, rtol=0.0, atol=1e-6)


def test_bang_bang_starts_from_the_holding_voltage():
    controller = catalog.bang_bang()
    seen = Observation(*map(jnp.asarray, (5.0, 5.0, 5.0, 31.0)))
    state = controller.init(seen)
    for _ in range(20):  # at exactly s = 0 the switching term is 0
        state, voltage = controller.step(state, seen)
    np.testing.assert_allclose(voltage, 31.0, rtol=0.0, atol=1e-9)
    # The commands on both sides of the surface differ by the weighted 2 K.
    sides = [
        controller.step(
            controller.init(seen), seen._replace(measured=jnp.asarray(5.0 + tiny))
        )[1]
        for tiny in (-1e-12, 1e-12)
    ]
    np.testing.assert_allclose(sides[0] - sides[1], 2.0 * 0.5, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("level", [0.0, 5.0])
def test_gradients_of_bang_bang_are_finite_where_it_switches(level):
    arrays, static = eqx.partition(
        catalog.loop(catalog.bang_bang(), stage=p753.plant()), eqx.is_array
    )

    @jax.jit
    @jax.grad
    def gradient(arrays):
        loop = eqx.combine(arrays, static)
        inputs = loop_inputs(jnp.full(100, level), jnp.asarray(DRAWS[:100]))
        metric = Tracking(10)
        return simulate(loop, inputs, loop.init(0.0), metric=metric)[1].rms_error

    slopes = gradient(arrays)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slopes))
    assert np.any(jax.tree.leaves(slopes.controller)[0] != 0.0)


def test_both_inverses_minimise_their_cost():
    b0, error, control = jnp.asarray([0.02, 2.0, 0.3])
    for form in INVERSIONS.values():
        np.testing.assert_allclose(form(b0, error, 0.0 * b0), 50.0, rtol=1e-12)

    # the minimum of the parabola through three points, for a reference of 1 um
    def minimum(cost):
        u = np.array([0.0, 1.0, 2.0])
        square, slope, _ = np.polyfit(u, [cost(x) for x in u], 2)
        return -slope / (2.0 * square)

    printed = minimum(lambda u: 2.0 * (u - 50.0) ** 2 + 0.3 * u**2)
    tikhonov = minimum(lambda u: 2.0 * (0.02 * u - 1.0) ** 2 + 0.3 * u**2)
    np.testing.assert_allclose(INVERSIONS["printed"](b0, error, control), printed)
    np.testing.assert_allclose(INVERSIONS["tikhonov"](b0, error, control), tikhonov)


@pytest.mark.parametrize("rate", MODELS)
def test_the_printed_inverse_diverges_and_the_tikhonov_inverse_decays(rate):
    b0, b1, b2 = MODELS[rate][2:]
    weight = TRACKING[rate][3]
    moduli = {
        name: np.abs(np.roots([1.0, g * b1, g * b2])).max()
        for name, form in INVERSIONS.items()
        for g in [float(form(*map(jnp.asarray, (b0, 1.0, weight))))]
    }
    assert moduli["printed"] > 1.0
    assert moduli["tikhonov"] < 0.5


@pytest.mark.parametrize(
    "controller", [catalog.model_reference(), controller_of(TIKHONOV)]
)
def test_a_start_off_the_reference_moves_by_one_step_of_the_integral(controller):
    seen = Observation(*map(jnp.asarray, (1.0, 1.0, 0.5, 0.8)))
    _, command = controller.step(controller.init(seen), seen)
    sliding = -0.5 * (1.0 + sum(controller.surface))
    moved = -controller.law.integral * controller.law.dt * sliding
    assert command == pytest.approx(0.8 + float(moved), rel=1e-12)


PRINTED = catalog.model_reference()
SWITCHED = catalog.bang_bang()
LONGER = ARMA((0.5, 0.1, 0.1), (1.0,))


def changed(controller, **values):
    fields = {name: getattr(controller, name) for name in vars(controller)}
    return type(controller)(**(fields | values))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: changed(PRINTED, model=LONGER),
            "surface holds 1 weights; it must hold 2 for a model of order 3",
        ),
        (
            lambda: changed(PRINTED, model=ARMA((), (1.0,)), surface=()),
            "the model has no coefficient a_1; it must have one",
        ),
        (
            lambda: changed(PRINTED, inversion="exact"),
            r"inversion 'exact'; it must be one of \['printed', 'tikhonov'\]",
        ),
        (
            lambda: changed(PRINTED, model=ARMA((0.5, 0.1), (0.0, 1.0))),
            "b_0 of the model is 0",
        ),
        (lambda: changed(PRINTED, error_weight=0.0), "error_weight is 0; .* above 0"),
        (
            lambda: changed(PRINTED, control_weight=-1.0),
            "control_weight is -1",
        ),
        (lambda: changed(PRINTED, surface=(np.nan,)), "surface is nan"),
        (lambda: changed(PRINTED.law, integral=np.inf), "integral in .* is inf"),
        (lambda: changed(SWITCHED.law, gain=-1.0), "gain .* is -1; .* at least 0"),
        (
            lambda: changed(SWITCHED, model=ARMA((), (0.1,))),
            "the model has no coefficient a_1; it must have one",
        ),
        (
            lambda: changed(SWITCHED, control_weight=-1.0),
            "control_weight is -1",
        ),
        (
            lambda: changed(catalog.traditional(), inversion="none"),
            "inversion 'none'; it must be one of",
        ),
        (
            lambda: changed(catalog.continuous().law, proportional=np.nan),
            "proportional .* is nan; it must be finite",
        ),
        (
            lambda: catalog.model_reference(3_000),
            "rate in Hz is 3000; it must be one of 1000, 2000, 5000, 10000, 20000",
        ),
        (lambda: catalog.model_reference(table="4-2"), "table is 4-2; .* 4-3, 4-4"),
        (lambda: p753.sliding_mode("9-9"), "table is 9-9; .* one of 5-2, 5-4"),
        (lambda: p753.inversion("9-9"), "table is 9-9; .* one of 5-2, 5-4"),
        (lambda: p753.disturbance_observer("9-9"), "table is 9-9; .* 5-2, 5-4"),
        (lambda: catalog.traditional(5_000), "rate in Hz is 5000; .* 1000, 20000"),
        (lambda: catalog.continuous(1_000), "rate in Hz is 1000; .* 5000, 10000,"),
        (
            lambda: catalog.loop(PRINTED, 3_000),
            "rate in Hz is 3000; it must divide 20000",
        ),
        (
            lambda: catalog.loop(PRINTED, 0),
            "rate in Hz is 0; it must divide 20000",
        ),
    ],
)
def test_bad_parameters_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_bad_weights_of_the_traditional_design_are_refused():
    with pytest.raises(ValueError, match="error_weight is -1"):
        changed(catalog.traditional(), error_weight=-1.0)
