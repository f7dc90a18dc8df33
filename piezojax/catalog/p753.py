"""The P-753 actuator (Physik Instrumente, 15 um) and its printed controllers.

Every number carries its equation or table in Y. Cao's thesis (2013). Dynamics and gains
hold at 20 kHz unless another rate is stated. Functions with an argument ``table`` raise
ValueError for a table that is not printed.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..control import (
    PID,
    AdaptiveInverse,
    AlphaBeta,
    Anticipation,
    DisturbanceObserverControl,
    InversionControl,
    KalmanFilter,
    Observer,
    SlidingMode,
    SwitchingPID,
    first_order_weight,
    mixed_sensitivity,
)
from ..control.kalman import model_kalman
from ..core.arrays import ScalarLike
from ..core.feedback import Feedback
from ..core.system import Series, System, series
from ..dynamics import ARMA, scaled_to_dc
from ..hardware import Saturation, Sensor
from ..hysteresis import ColemanHodgdon, InverseColemanHodgdon

RATE = 20_000.0
"""Sampling rate of chapters 3 and 5, Hz."""

DT = 1.0 / RATE
VOLTAGE_LIMITS = (-20.0, 120.0)
"""Range of the drive in V: data of the manufacturer, not in the thesis."""

NOISE_RMS = 0.012
"""Sensor noise, um: section 5.5.6 gives 10 to 15 nm rms."""

HYSTERESIS_CHAPTER_5 = {"a": 0.0077, "b": 0.1167, "c": -0.0487}
"""Section 5.5.6.1, from a 70 V, 1 Hz sine: um/V^2, um/V, 1/V."""

HYSTERESIS_CHAPTER_3 = {"a": 0.0064, "b": 0.1144, "c": -0.0305}
"""Section 3.5.5.1, with c after its line search."""

INITIAL_C_CHAPTER_3 = -0.0378
"""Section 3.5.5.1: c of the first 1 Hz fit, before the line search."""

GAIN = 0.1347
"""K_e in um/V, section 5.5.6.1: the linear part of the hysteresis."""

DYNAMICS_BEHIND_HYSTERESIS = {
    "autoregressive": (1.6035, -0.61995),
    "moving": (0.0050811, -0.0036354, 0.010553),
}
"""(5.33): from hysteresis output to displacement; DC gain 0.729 as printed."""

DYNAMICS_FROM_VOLTAGE = {
    "autoregressive": (1.6076, -0.61956),
    "moving": (0.00071058, -0.00047055, 0.0012609),
}
"""(5.34): from voltage to displacement, um/V, hysteresis ignored."""

ARMA_HYSTERESIS = {
    # b' multiplies y_1 (a = 1, b = 0), b'' multiplies y_2 (a = 0, b = 1), (3.32).
    "3-1": {
        "autoregressive": (0.0725, 0.7577),
        "c": -0.0305,
        "error_um": 0.0451,
        "moving_1": (-0.0703, 0.1448, -0.0732),
        "moving_2": (-1.4122, 2.9350, -1.5032),
    },
    "3-2": {
        "autoregressive": (1.6531, -0.6758),
        "c": -0.0305,
        "error_um": 0.0309,
        "moving_1": (-0.002759, 0.006409, -0.003526),
        "moving_2": (-0.07323, 0.1736, -0.09756),
    },
    "3-3": {
        "autoregressive": (0.0592, 0.7413),
        "c": -0.029,
        "error_um": 0.1323,
        "moving_1": (-0.0763, 0.1539, -0.0766),
        "moving_2": (-2.4981, 5.0563, -2.5343),
    },
    "3-4": {
        "autoregressive": (1.6522, -0.6751),
        "c": -0.029,
        "error_um": 0.0309,
        "moving_1": (-0.0027, 0.0063, -0.0035),
        "moving_2": (-0.0748, 0.1766, -0.099),
    },
}
"""Tables 3-1 (trapezoid, least squares), 3-2 (trapezoid, online), 3-3 (quadratic, least
squares), 3-4 (quadratic, online). The column heads of 3-3 and 3-4 are corrected."""

DYNAMICS_BY_RATE = {
    1_000: {
        "autoregressive": (0.3212, 0.01025),
        "moving": (0.003889, 0.1189, -0.01765),
    },
    2_000: {
        "autoregressive": (0.0712, 0.12058),
        "moving": (0.002944, 0.10592, 0.01797),
    },
    5_000: {
        "autoregressive": (0.7567, -0.16145),
        "moving": (0.003463, 0.01386, 0.00447),
    },
    10_000: {
        "autoregressive": (1.0589, -0.15055),
        "moving": (0.002018, 0.00075, 0.01001),
    },
    20_000: {
        "autoregressive": (1.6092, -0.6248),
        "moving": (0.000778, -0.00041, 0.00134),
    },
}
"""Table 4-1, from voltage to displacement, by sampling rate in Hz. The DC gain of the
row at 5 kHz is 0.054, that of the others 0.11 to 0.16."""

GAINS = {
    "5-2": {
        name: {"proportional": 0.01, "integral": 30.0, "derivative": 1e-6}
        for name in ("pid", "inversion", "dob")
    },
    "5-4": {
        "pid": {"proportional": 0.01, "integral": 60.0, "derivative": 1e-6},
        "inversion": {"proportional": 0.001, "integral": 10.0, "derivative": 1e-6},
        "dob": {"proportional": 0.05, "integral": 12.0, "derivative": 1e-6},
    },
}
"""Tables 5-2 (equal for all three) and 5-4 (adjusted for each); ``pid`` is the
nominal PID-based SMC, as in the columns of Tables 5-3 and 5-5."""

SURFACE = 18_000.0
"""m in S = [m, 1], 1/s, section 5.5.6.2."""

ERROR_WEIGHT, CONTROL_WEIGHT = 1.0, 100.0
"""Q and R, Tables 5-2 and 5-4."""

ALPHA, BETA = 0.1, 1e-4
"""Alpha-beta filter at 20 kHz, section 5.5.6.2."""

CUTOFF = 500.0
"""Q-filter cut-off, rad/s, section 5.5.6.2."""

PROCESS_RMS, DRIFT_RMS = 1e-3, 1e-4
"""Noise of a Kalman filter in um per sample: ours, a start for tuning."""

SENSITIVITY_WEIGHT = {"low": 1e3, "crossover": 3000.0, "high": 0.5}
EFFORT_WEIGHT = 0.1
"""Weights of the H-infinity design, the crossover in rad/s: ours."""


def printed(name: str, values: Mapping[Any, Any], key: Any) -> Any:
    """Return ``values[key]``; raise ValueError, listing the keys, if it is missing."""
    if key not in values:
        raise ValueError(
            f"{name} is {key}; it must be one of {', '.join(map(str, values))}"
        )
    return values[key]


def samples_at(rate: int) -> int:
    """Return the number of 20 kHz samples in one sample at ``rate`` (Hz).

    Raises ValueError for a rate that does not divide 20 kHz.
    """
    if rate <= 0 or RATE % rate:
        raise ValueError(f"rate in Hz is {rate:g}; it must divide {RATE:g}")
    return int(RATE // rate)


def hysteresis(scheme: str = "trapezoid") -> ColemanHodgdon:
    """Return the chapter 5 hysteresis, V to um."""
    return ColemanHodgdon(**HYSTERESIS_CHAPTER_5, scheme=scheme)


def plant(scheme: str = "trapezoid") -> Series:
    """Return the stage, V to um: hysteresis, then (5.33) scaled to unit DC gain.

    The hysteresis was fitted from voltage to displacement at 1 Hz, so the dynamics
    behind it must have unit gain at 1 Hz. With (5.33) as printed the 1 Hz cells of
    Table 5-3 are off by the missing 27 %.
    """
    dynamics = scaled_to_dc(ARMA(**DYNAMICS_BEHIND_HYSTERESIS), 1.0)
    return series(hysteresis=hysteresis(scheme), dynamics=dynamics)


def kalman(model: ARMA) -> KalmanFilter:
    """Return a Kalman filter (ours) on ``model`` with the printed sensor noise."""
    return model_kalman(model, NOISE_RMS, PROCESS_RMS, DRIFT_RMS, DT)


def _gains(table: str, controller: str) -> dict[str, float]:
    return printed("table", GAINS, table)[controller]


def _sliding_mode(
    model: ARMA, gains: dict[str, float], observer: Observer | None = None
) -> SlidingMode:
    return SlidingMode(
        SwitchingPID(**gains, dt=DT),
        surface=SURFACE,
        error_weight=ERROR_WEIGHT,
        control_weight=CONTROL_WEIGHT,
        model=model,
        filter=AlphaBeta(ALPHA, BETA, DT) if observer is None else observer,
    )


def sliding_mode(table: str = "5-2") -> SlidingMode:
    """Return the nominal PID-based SMC with the printed gains, um to V."""
    return _sliding_mode(ARMA(**DYNAMICS_FROM_VOLTAGE), _gains(table, "pid"))


def inversion(table: str = "5-2") -> InversionControl:
    """Return the inversion-based PID-SMC with the printed gains, um to V."""
    model = ARMA(**DYNAMICS_BEHIND_HYSTERESIS)
    return InversionControl(
        _sliding_mode(model, _gains(table, "inversion")),
        InverseColemanHodgdon(hysteresis()),
    )


def disturbance_observer(
    table: str = "5-2", coefficients: str = "corrected"
) -> DisturbanceObserverControl:
    """Return the DOB-based PID-SMC with the printed gains, um to V."""
    model = ARMA(**DYNAMICS_BEHIND_HYSTERESIS)
    return DisturbanceObserverControl(
        _sliding_mode(model, _gains(table, "dob")),
        model,
        gain=GAIN,
        cutoff=CUTOFF,
        dt=DT,
        coefficients=coefficients,
    )


def anticipating_disturbance_observer(table: str = "5-2") -> Anticipation:
    """Return ``disturbance_observer`` in an Anticipation of lead 0 (ours)."""
    return Anticipation(disturbance_observer(table), (0.0,))


ADAPTIVE_INVERSE = {
    "thresholds": (0.2, 0.5, 1.0, 2.0, 4.0),
    "cutoff": 3000.0,
    "equation_error": 3.0,
    "memory": 1.0,
}
"""Ours: um, rad/s, V, s. The stops suit motions of a few um."""


def lags() -> tuple[float, float]:
    """Return the two time constants of (5.33), s, the slow one first."""
    poles = np.real(ARMA(**DYNAMICS_BEHIND_HYSTERESIS).poles())
    slow, fast = sorted(-DT / np.log(poles), reverse=True)
    return float(slow), float(fast)


def adaptive_disturbance_observer(table: str = "5-2") -> AdaptiveInverse:
    """Return ``disturbance_observer`` in an AdaptiveInverse (ours)."""
    return with_adaptive_inverse(disturbance_observer(table))


def with_adaptive_inverse(controller: System) -> AdaptiveInverse:
    """Return ``controller`` in an AdaptiveInverse (ours), um to V.

    At its initial share of 0 it equals ``controller``. The initial weights and the lead
    follow from the printed gain and poles, the weights of the stops from a typical
    hysteresis.
    """
    slow, fast = lags()
    gains = (1.0 / GAIN, (slow + fast) / GAIN, slow * fast / GAIN)
    stops = len(ADAPTIVE_INVERSE["thresholds"])
    return AdaptiveInverse(
        controller,
        weights=(*gains, *(0.1 * gains[0],) * stops),
        deviations=(*(0.5 * gain for gain in gains), *(0.3 * gains[0],) * stops),
        **ADAPTIVE_INVERSE,
        dt=DT,
        lead=slow + fast,
        share=0.0,
    )


def pid() -> PID:
    """Return a PID baseline (ours; the thesis prints none), um to V.

    The integral gain of 3000 V/(um s) puts the crossover near 400 rad/s.
    """
    return PID(0.5, 3000.0, 0.0, 1e-4, 100.0, dt=DT)


def kalman_sliding_mode(table: str = "5-2") -> SlidingMode:
    """Return ``sliding_mode`` with a Kalman filter (ours) as observer."""
    model = ARMA(**DYNAMICS_FROM_VOLTAGE)
    return _sliding_mode(model, _gains(table, "pid"), kalman(model))


def kalman_disturbance_observer(table: str = "5-2") -> DisturbanceObserverControl:
    """Return ``disturbance_observer`` with a Kalman filter (ours) as observer.

    The filter receives the Observation of the inner controller: its applied input is
    K_e times the sum of voltage and estimated disturbance.
    """
    model = ARMA(**DYNAMICS_BEHIND_HYSTERESIS)
    return DisturbanceObserverControl(
        _sliding_mode(model, _gains(table, "dob"), kalman(model)),
        model,
        gain=GAIN,
        cutoff=CUTOFF,
        dt=DT,
    )


def mixed_sensitivity_inversion() -> InversionControl:
    """Return an H-infinity controller (ours) for (5.33), with inverse hysteresis."""
    error, effort = SENSITIVITY_WEIGHT, EFFORT_WEIGHT
    design = mixed_sensitivity(
        scaled_to_dc(ARMA(**DYNAMICS_BEHIND_HYSTERESIS), 1.0),
        first_order_weight(**error, dt=DT),
        effort,
        dt=DT,
    )
    return InversionControl(design.controller, InverseColemanHodgdon(hysteresis()))


def actuator() -> Saturation:
    """Return the Saturation at the voltage limits of the drive."""
    return Saturation(*VOLTAGE_LIMITS)


def loop(controller: System, noise_rms: ScalarLike = NOISE_RMS) -> Feedback:
    """Return ``controller`` around the P-753 with its drive and noisy sensor."""
    return Feedback(controller, plant(), actuator(), Sensor(noise_rms))
