"""Steady-state Kalman filter: an Observer from input and measurement."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import linalg

from ..core.arrays import Scalar, ScalarLike, as_array, as_scalars, check
from ..core.feedback import Observation
from ..core.parameter import parameter, sample_time
from ..dynamics.arma import ARMA
from .observer import Motion, Observer

DOUBLINGS = 40
"""Doublings of the Riccati recursion: 2^40 steps."""


class KalmanState(NamedTuple):
    """Estimates given z(k): y(k), y(k-1), ... and the drift, in um; past inputs.

    ``inputs`` holds u(k-1), u(k-2), ..., in the unit of the model's input.
    """

    positions: tuple[Scalar, ...]
    drift: Scalar
    inputs: tuple[Scalar, ...]


class KalmanFilter(Observer):
    """Steady-state Kalman filter on ``model``.

    The model (a_1, ..., a_n | b_0, ...) is
    ``y(k+1) = a_1 y(k) + a_2 y(k-1) + ... + b_0 u(k) + b_1 u(k-1) + ... + d(k)``, where
    u is the applied input and the drift d in um represents unmodelled effects:
    hysteresis, creep, an error of the DC gain. ``gain`` holds the gains of y(k),
    y(k-1), ..., one for each a_i and at least two, and then that of d. The velocity of
    the Motion is (y(k) - y(k-1)) / dt of the estimates, as in the second-order models
    of chapter 4. With a gain of zero the model runs in open loop.

    Raises ValueError for a model without a_1 or a gain of another length.
    """

    model: ARMA
    gain: tuple[Scalar, ...] = parameter(
        "1",
        "share of the innovation that corrects each estimate, the drift last",
        typical=(-0.5, 0.99),
        converter=as_scalars,
    )
    dt: float = sample_time()

    def __check_init__(self):
        if not self.model.autoregressive:
            raise ValueError("the model has no coefficient a_1; it must have one")
        needed = position_count(self.model) + 1
        if len(self.gain) != needed:
            raise ValueError(
                f"gain holds {len(self.gain)} numbers; it must hold {needed} for this "
                "model, the last for the drift"
            )

    def init(self, input: Observation) -> KalmanState:
        measured, applied = as_array(input.measured), as_array(input.applied)
        moved = sum(self.model.autoregressive) * measured
        forced = sum(self.model.moving) * applied
        return KalmanState(
            positions=(measured,) * position_count(self.model),
            drift=measured - moved - forced,
            inputs=(applied,) * (len(self.model.moving) - 1),
        )

    def step(
        self, state: KalmanState, input: Observation
    ) -> tuple[KalmanState, Motion]:
        inputs = (as_array(input.applied), *state.inputs)
        predicted = state.drift
        for a, position in zip(
            self.model.autoregressive, state.positions, strict=False
        ):
            predicted = predicted + a * position
        for b, past in zip(self.model.moving, inputs, strict=True):
            predicted = predicted + b * past
        innovation = input.measured - predicted

        *gains, drift_gain = self.gain
        before = (predicted, *state.positions[:-1])
        newest, older, *rest = (
            position + gain * innovation
            for position, gain in zip(before, gains, strict=True)
        )
        state = KalmanState(
            (newest, older, *rest),
            state.drift + drift_gain * innovation,
            inputs[: len(state.inputs)],
        )
        return state, Motion(newest, (newest - older) / self.dt)


def position_count(model: ARMA) -> int:
    """Return the number of estimated positions: one for each a_i, at least 2."""
    return max(len(model.autoregressive), 2)


def steady_gain(
    A: Float[np.ndarray, "n n"], Q: Float[np.ndarray, "n n"], noise_rms: float
) -> Float[np.ndarray, " n"]:
    """Return the steady-state gain for x(k+1) = A x(k) + w, z = x_1 + v, cov w = ``Q``.

    It corrects the estimate at k by the measurement at k. ``noise_rms`` is the rms
    value of v, in the unit of z. Raises ValueError without a steady state: for a
    marginally stable mode that is not observable or has no process noise.
    """
    # Each pass doubles the number of steps of the Riccati recursion. It adds positive
    # terms only, so it stays accurate for small noise, where the eigenvalues of a Schur
    # method's pencil lie next to the unit circle.
    eye, output_row = np.eye(len(A)), np.eye(len(A))[0]
    F, G, P = A.T, np.outer(output_row, output_row), Q / noise_rms**2
    for _ in range(DOUBLINGS):
        both = linalg.solve(eye + G @ P, np.hstack([F, G @ F.T]))
        forward, across = both[:, : len(A)], both[:, len(A) :]
        F, G, P = F @ forward, G + F @ across, P + F.T @ P @ forward
    gain = P[:, 0] / (P[0, 0] + 1.0)
    poles = np.linalg.eigvals(A - np.outer(A @ gain, output_row))
    if not np.abs(poles).max() < 1.0 - 1e-9:
        raise ValueError(
            "the filter has no steady state; every mode of the model at the edge of "
            "stability needs process noise above 0"
        )
    return gain


def model_kalman(
    model: ARMA,
    noise_rms: ScalarLike,
    process_rms: ScalarLike,
    drift_rms: ScalarLike,
    dt: float,
) -> KalmanFilter:
    """Return the Kalman filter on ``model`` for given sensor and process noise.

    All in um: ``noise_rms`` of the sensor, ``process_rms`` of the random motion per
    sample, ``drift_rms`` of the change of the drift per sample. Raises ValueError for
    a negative ``process_rms`` and for another value that is not above 0.
    """
    check("noise_rms in um", noise_rms, above=0.0)
    check("process_rms in um", process_rms, least=0.0)
    check("drift_rms in um", drift_rms, above=0.0)
    n = position_count(model)
    A = np.zeros((n + 1, n + 1))
    A[0, : len(model.autoregressive)] = [float(a) for a in model.autoregressive]
    A[0, n] = A[n, n] = 1.0
    A[1:n, : n - 1] = np.eye(n - 1)
    Q = np.zeros_like(A)
    Q[0, 0], Q[n, n] = float(process_rms) ** 2, float(drift_rms) ** 2
    return KalmanFilter(model, tuple(steady_gain(A, Q, float(noise_rms))), dt)


def kinematic_kalman(
    noise_rms: ScalarLike, acceleration_rms: ScalarLike, dt: float
) -> KalmanFilter:
    """Return the Kalman filter for constant velocity, without a model of the stage.

    ``noise_rms`` of the sensor in um; ``acceleration_rms`` in um/s^2 of a random
    acceleration, constant within a sample and independent between samples. It is an
    alpha-beta filter: the gains are alpha and alpha - beta, functions of
    ``acceleration_rms dt^2 / noise_rms`` alone (Kalata, 1984). Raises ValueError for
    values that are not above 0.
    """
    check("noise_rms in um", noise_rms, above=0.0)
    check("acceleration_rms in um/s^2", acceleration_rms, above=0.0)
    check("sample time in s", dt, above=0.0)
    # The state y(k-1) is y(k) - dt dy/dt: an acceleration moves y(k) and y(k-1) by
    # equal amounts in opposite directions.
    push = 0.5 * float(acceleration_rms) * dt**2 * np.array([1.0, -1.0])
    model = ARMA((2.0, -1.0), (0.0,))
    A = np.array([[2.0, -1.0], [1.0, 0.0]])
    gain = steady_gain(A, np.outer(push, push), float(noise_rms))
    return KalmanFilter(model, (*gain, 0.0), dt)
