"""Kalman filters against closed forms and a plain matrix recursion."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import signals
from oracles.control import Kalman
from oracles.loop import closed_loop
from oracles.published import plant_t2, smc_gains
from scipy import linalg

from piezojax import (
    simulate,
)
from piezojax.catalog import p753, p753_chapter4
from piezojax.control import (
    AlphaBeta,
    KalmanFilter,
)
from piezojax.control.kalman import kinematic_kalman, model_kalman, steady_gain
from piezojax.core.feedback import LoopInput, Observation
from piezojax.dynamics import (
    ARMA,
)
from piezojax.study import read, shipped

DT = p753.DT
SAMPLES = 20_000  # 1 s
DRAWS = np.random.default_rng(31).normal(size=(3, SAMPLES))
MODEL_A, MODEL_B = (1.6076, -0.61956), (0.00071058, -0.00047055, 0.0012609)  # (5.34)
STAGE = ARMA(MODEL_A, MODEL_B)
MODELS = {
    "first order": ((0.97,), (0.004,)),
    "second order": (MODEL_A, MODEL_B),
    "third order": ((1.2, -0.3, 0.02), (0.006, 0.002)),
}


def at_rest(measured=0.0, applied=0.0):
    return Observation(*map(jnp.asarray, (measured, measured, measured, applied)))


@jax.jit
def observed(observer, measured, applied):
    zero = jnp.zeros(len(measured))
    seen = Observation(zero, zero, measured, applied)
    return simulate(observer, seen, observer.init(at_rest()))[1]


def alpha_beta_of(index):
    """Return Kalata's gains for the tracking index acceleration dt^2 / noise."""
    r = (4.0 + index - np.sqrt(8.0 * index + index**2)) / 4.0
    alpha = 1.0 - r**2
    return alpha, 2.0 * (2.0 - alpha) - 4.0 * np.sqrt(1.0 - alpha)


@pytest.mark.parametrize("index", [1e-4, 0.01, 0.3, 5.0])
def test_the_kinematic_filter_equals_the_alpha_beta_filter_of_kalata(index):
    alpha, beta = alpha_beta_of(index)
    kalman = kinematic_kalman(0.012, index * 0.012 / DT**2, DT)
    np.testing.assert_allclose(kalman.gain, (alpha, alpha - beta, 0.0), rtol=1e-8)

    measured = jnp.asarray(0.012 * DRAWS[0] + np.cumsum(1e-3 * DRAWS[1]))
    found = observed(kalman, measured, jnp.asarray(DRAWS[2]))  # no voltage
    same = eqx.tree_at(lambda k: k.gain[:2], kalman, (alpha, alpha - beta))
    expected = observed(AlphaBeta(alpha, beta, DT), measured, jnp.zeros(SAMPLES))
    np.testing.assert_allclose(found.position, expected.position, rtol=0.0, atol=1e-6)
    found = observed(same, measured, jnp.zeros(SAMPLES))
    np.testing.assert_allclose(found.position, expected.position, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(
        DT * found.velocity, DT * expected.velocity, rtol=0.0, atol=1e-9
    )


def covariances(a, n, noise, process, drift, samples):
    """Return gain and covariance by the Riccati recursion from a wide prior."""
    A = np.zeros((n + 1, n + 1))
    A[0, : len(a)] = a
    A[0, n] = A[n, n] = 1.0
    A[1:n, : n - 1] = np.eye(n - 1)
    Q = np.diag([process**2, *[0.0] * (n - 1), drift**2])
    c = np.eye(n + 1)[0]
    P = np.eye(n + 1)
    for _ in range(samples):
        P = A @ P @ A.T + Q
        gain = P @ c / (c @ P @ c + noise**2)
        keep = np.eye(n + 1) - np.outer(gain, c)
        P = keep @ P @ keep.T + noise**2 * np.outer(gain, gain)
    return gain, P


@pytest.mark.parametrize("name", MODELS)
def test_the_gain_is_the_limit_of_the_recursion(name):
    a, b = MODELS[name]
    kalman = model_kalman(ARMA(a, b), 0.012, 1e-3, 1e-3, DT)
    expected, _ = covariances(a, max(len(a), 2), 0.012, 1e-3, 1e-3, 2_000)
    np.testing.assert_allclose(kalman.gain, expected, rtol=1e-8)


@pytest.mark.parametrize("name", MODELS)
def test_the_estimate_equals_that_of_the_matrix_filter(name):
    a, b = MODELS[name]
    kalman = model_kalman(ARMA(a, b), 0.012, 1e-3, 1e-4, DT)
    applied, measured = 10.0 * np.sin(np.arange(SAMPLES) / 100), DRAWS[0]
    oracle = Kalman(a, b, np.array(kalman.gain), DT)
    expected = []
    for z, u in zip(measured, applied, strict=True):
        oracle.applied(u)
        expected.append(oracle.step(z))
    expected = np.array(expected)
    found = observed(kalman, jnp.asarray(measured), jnp.asarray(applied))
    np.testing.assert_allclose(found.position, expected[:, 0], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(
        DT * found.velocity, DT * expected[:, 1], rtol=0.0, atol=1e-9
    )


def test_the_error_equals_the_prediction_and_is_below_the_kinematic_filter():
    noise, process, drift = 0.012, 1e-3, 1e-4
    voltage = 20.0 * np.sin(np.arange(SAMPLES) * 0.3)  # fast: needs the model
    y, d, truth = [0.0, 0.0], 0.0, []
    u = np.concatenate([[0.0, 0.0], voltage])
    for k in range(SAMPLES):
        forced = sum(b * u[k + 2 - i] for i, b in enumerate(MODEL_B))
        pushed = MODEL_A[0] * y[0] + MODEL_A[1] * y[1]
        y = [pushed + forced + d + process * DRAWS[1, k], y[0]]
        d += drift * DRAWS[2, k]
        truth.append(y[0])
    truth = np.array(truth)
    measured = jnp.asarray(truth + noise * DRAWS[0])

    def error(observer):
        found = observed(observer, measured, jnp.asarray(voltage))
        return np.std((found.position - truth)[SAMPLES // 4 :])

    kalman = model_kalman(STAGE, noise, process, drift, DT)
    gain, P = covariances(MODEL_A, 2, noise, process, drift, 6_000)
    np.testing.assert_allclose(kalman.gain, gain, rtol=1e-4)
    found = error(kalman)
    np.testing.assert_allclose(found, np.sqrt(P[0, 0]), rtol=0.03)
    kinematic = [kinematic_kalman(noise, a, DT) for a in 10.0 ** np.arange(3, 9)]
    assert found < 0.6 * min(error(observer) for observer in kinematic)


@pytest.mark.parametrize(
    "observer",
    [
        AlphaBeta(0.1, 1e-4, DT),
        kinematic_kalman(0.012, 1e5, DT),
        p753.kalman(STAGE),
        KalmanFilter(STAGE, (0.0, 0.0, 0.0), DT),
    ],
    ids=["alpha-beta", "kinematic", "model", "model alone"],
)
def test_an_observer_at_rest_stays_at_rest(observer):
    seen = at_rest(5.0, 31.0)
    state = observer.init(seen)
    for _ in range(3):
        state, motion = observer.step(state, seen)
        np.testing.assert_allclose(motion.position, 5.0, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(DT * motion.velocity, 0.0, rtol=0.0, atol=1e-12)


GAIN = tuple(map(float, p753.kalman(STAGE).gain))


def test_the_gain_solves_the_algebraic_riccati_equation():
    A = np.array([[*MODEL_A, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    Q = np.diag([1e-6, 0.0, 1e-6])
    P = linalg.solve_discrete_are(A.T, np.eye(3)[:, :1], Q, [[0.012**2]])
    expected = P[:, 0] / (P[0, 0] + 0.012**2)
    np.testing.assert_allclose(steady_gain(A, Q, 0.012), expected, rtol=1e-7)


def with_kalman(controller):
    kalman = KalmanFilter(controller.model, GAIN, DT)
    return eqx.tree_at(lambda c: c.filter, controller, kalman)


def oracle_gains(kind, base):
    return {**base, "kalman": GAIN}, kind


LOOPS = {
    "sliding mode": (
        with_kalman(p753.sliding_mode()),
        *oracle_gains("smc", smc_gains("smc", "5-3")),
    ),
    "observer": (
        eqx.tree_at(
            lambda c: c.feedback,
            p753.disturbance_observer(),
            with_kalman(p753.disturbance_observer().feedback),
        ),
        *oracle_gains("dob", smc_gains("dob", "5-3")),
    ),
    "model reference": (
        with_kalman(p753_chapter4.model_reference()),
        *oracle_gains(
            "model reference",
            {
                **dict(zip("PIDR", (1.0, 12_000.0, 2e-5, 0.001), strict=True)),
                **{"m": (0.99,), "Q": 1.0, "frequency": 3_000.0, "damping": 0.25},
                "model_a": (1.6092, -0.6248),
                "model_b": (0.000778, -0.00041, 0.00134),
            },
        ),
    ),
}


@jax.jit
def run(loop, reference):
    inputs = LoopInput(reference[1:], DRAWS[0])
    return simulate(loop, inputs, loop.init(0.0))[1]


@pytest.mark.parametrize("name", LOOPS)
def test_controllers_accept_it_as_their_filter(name):
    controller, gains, kind = LOOPS[name]
    reference = signals.ten_references()["PWSW30"]
    found = run(p753.loop(controller), reference)
    expected = closed_loop(
        kind, reference, plant_t2("trapezoid"), gains, noise=0.012 * DRAWS[0]
    )
    assert np.abs(expected["displacement"]).max() < 25.0
    for column, values in expected.items():
        np.testing.assert_allclose(
            getattr(found, column), values, rtol=0.0, atol=1e-9, err_msg=column
        )


@pytest.mark.parametrize(
    "name", ["observer_alpha_beta", "observer_kalman", "observer_kalman_dob"]
)
def test_the_studies_differ_in_the_observer_only(name):
    case, other = read(shipped(name)), read(shipped("p753_dob"))
    for table in ("plant", "actuator", "sensor", "references", "objective"):
        assert getattr(case.study, table) == getattr(other.study, table)
    assert case.study.optimiser == other.study.optimiser
    observers = {path for path in case.space.paths if ".filter." in path}
    assert len(observers) == (2 if name == "observer_alpha_beta" else 3)
    rest = {path.split(".")[-1] for path in set(case.space.paths) - observers}
    own = {"proportional", "integral", "derivative", "surface", "control_weight"}
    assert rest == (own | {"cutoff"} if name.endswith("dob") else own)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: KalmanFilter(STAGE, (0.1, 0.1), DT),
            "gain holds 2 numbers; it must hold 3 for this model, the last for the dr",
        ),
        (
            lambda: KalmanFilter(ARMA((), (1.0,)), (0.1, 0.1, 0.1), DT),
            "the model has no coefficient a_1; it must have one",
        ),
        (lambda: KalmanFilter(STAGE, (np.nan, 0.1, 0.1), DT), "gain is nan"),
        (lambda: KalmanFilter(STAGE, GAIN, 0.0), "dt in s is 0; .* above 0"),
        (lambda: model_kalman(STAGE, 0.0, 1.0, 1.0, DT), "noise_rms in um is 0"),
        (lambda: model_kalman(STAGE, 1.0, -1.0, 1.0, DT), "process_rms in um is -1"),
        (lambda: model_kalman(STAGE, 1.0, 1.0, 0.0, DT), "drift_rms in um is 0"),
        (lambda: kinematic_kalman(0.0, 1.0, DT), "noise_rms in um is 0"),
        (lambda: kinematic_kalman(1.0, 0.0, DT), "acceleration_rms in um/s.2 is 0"),
        (lambda: kinematic_kalman(1.0, 1.0, 0.0), "sample time in s is 0"),
        (
            lambda: steady_gain(np.eye(2), np.zeros((2, 2)), 1.0),
            "the filter has no steady state",
        ),
    ],
)
def test_bad_parameters_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
