"""The P-753 with the control schemes surveyed in sections 2.5 and 2.6 of the thesis.

The thesis prints no gains for them. All numbers here are ours: initial values for
tuning at 20 kHz, which track SIN10 of 5 um with the printed noise. Models, filter and
surface are the printed ones of ``p753``.
"""

import math

from ..control import (
    PID,
    AlphaBeta,
    Anticipation,
    BoundaryLayer,
    FeedforwardFeedback,
    FilteredCommand,
    InverseFeedforward,
    InverseGain,
    LearningControl,
    LearningLaw,
    PhaseCompensator,
    PlacedPID,
    RepetitiveControl,
    SlidingMode,
    SuperTwisting,
    SwitchingLaw,
    WeightedMixedSensitivity,
    zero_phase_inverse,
)
from ..control.output_tracking import drive
from ..core.arrays import as_array
from ..core.system import Affine, Series, System, series
from ..dynamics import (
    ARMA,
    Biquad,
    FirstOrderLag,
    Notch,
    SecondOrderLowPass,
    scaled_to_dc,
)
from ..hardware import ChargeDrive
from ..hysteresis import InverseColemanHodgdon
from . import p753, p753_stage

BOUNDARY_LAYER = {"gain": 1e4, "width": 4e4}
"""K in V and the layer in um/s. K is large because Q/(Q + R) passes 1 % of v."""

SUPER_TWISTING = {"root_gain": 10.0, "sign_gain": 1e6, "layer": 1e4}
"""Gains in V/(um/s)^(1/2) and V/s; layer in um/s."""

NOTCH = 0.5, 0.1
"""Damping and depth of a notch at the nominal mode of the stage."""

LOW_PASS = 3000.0, 0.7
"""Frequency in Hz and damping of a second-order low-pass: ours."""

ELECTRONICS_DELAY = 1.2e-4
"""Delay in s of amplifier, sensor and filters of tuning/p753_electronics.toml."""

H_INFINITY_BOUND = 3.0
"""Bound of the weighted responses: ours."""

REPETITIVE = {"gain": 0.7, "lead": 40, "advance": 8}
"""Learning gain; lead and advance in samples. Q is a first-order lag whose time
constant is ``advance`` samples."""

LEARNING = {"gain": 0.7, "lead": 40, "smoothing": (0.25,)}
"""LearningLaw for the reference of a loop, lead in samples."""

POLES = (0.9992, 0.0, 0.0)
"""Poles of the sliding variable that give about the printed I = 60 (Table 5-4), and
P = D = 0."""

PHASER = {"share": 0.1, "threshold": 10.0}
"""Weight of the stop operator, and the voltage (V) at which it saturates."""

CHARGE_TIME = 1.0
"""R C of amplifier and load in s: the charge is controlled above 0.16 Hz."""


def _switched(law: SwitchingLaw) -> SlidingMode:
    return SlidingMode(
        law=law,
        surface=p753.SURFACE,
        error_weight=p753.ERROR_WEIGHT,
        control_weight=p753.CONTROL_WEIGHT,
        model=ARMA(**p753.DYNAMICS_FROM_VOLTAGE),
        filter=AlphaBeta(p753.ALPHA, p753.BETA, p753.DT),
    )


def _inverse() -> InverseColemanHodgdon:
    return InverseColemanHodgdon(p753.hysteresis())


def pole_placement() -> SlidingMode:
    """Return sliding mode control with a PID by (4.18), um to V; poles ours."""
    model = ARMA(**p753.DYNAMICS_FROM_VOLTAGE)
    b0, *later = model.moving
    # Q/(Q+R) acts on v, and the later terms of the inversion feed back.
    share = b0 / (b0 * (1.0 + p753.CONTROL_WEIGHT / p753.ERROR_WEIGHT) + sum(later))
    moved = share * drive(model, as_array(p753.SURFACE), p753.DT)
    return _switched(PlacedPID(POLES, moved, p753.DT))


def boundary_layer() -> SlidingMode:
    """Return sliding mode control with a boundary layer, um to V; gains ours."""
    return _switched(BoundaryLayer(**BOUNDARY_LAYER))


def super_twisting() -> SlidingMode:
    """Return super-twisting sliding mode control, um to V; gains ours."""
    return _switched(SuperTwisting(**SUPER_TWISTING, dt=p753.DT))


def phase_compensator() -> PhaseCompensator:
    """Return ``p753.pid`` with a phaser behind it, um to V; the phaser is ours."""
    return PhaseCompensator(p753.pid(), **PHASER)


def inverse_feedforward() -> InverseFeedforward:
    """Return the inverse of the printed hysteresis, open loop, um to V."""
    return InverseFeedforward(_inverse())


def feedforward_pid() -> FeedforwardFeedback:
    """Return the inverse of the printed hysteresis beside ``p753.pid``, um to V."""
    return FeedforwardFeedback(_inverse(), p753.pid())


def simc_pi() -> PID:
    """Return a PI by the SIMC rule of Skogestad (2003) for (5.33), um to V.

    Half of the smaller time constant counts as a delay and half as a lag; the loop and
    the hold delay by one and a half samples, electronics by ELECTRONICS_DELAY. With a
    closed-loop time constant equal to the delay, P = lag / (2 gain delay), and the
    integral time is the lesser of the lag and eight delays.
    """
    slow, fast = p753.lags()
    lag = slow + 0.5 * fast
    delay = 0.5 * fast + 1.5 * p753.DT + ELECTRONICS_DELAY
    gain = lag / (2.0 * p753.GAIN * delay)
    time = min(lag, 8.0 * delay)
    return PID(gain, gain / time, 0.0, p753.DT, 1.0 / time, dt=p753.DT)


def notch_pi() -> FilteredCommand:
    """Return ``simc_pi`` with a notch at the nominal mode of the stage, um to V."""
    notch = Notch(p753_stage.MODE_FREQUENCY, *NOTCH, p753.DT)
    return FilteredCommand(simc_pi(), notch)


def static_feedforward(feedback: System) -> FeedforwardFeedback:
    """Return ``feedback`` with the reference divided by K_e fed forward, um to V."""
    return FeedforwardFeedback(InverseGain(Affine(p753.GAIN)), feedback)


def feedforward_simc_pi() -> FeedforwardFeedback:
    """Return ``simc_pi`` with a static feedforward, um to V."""
    return static_feedforward(simc_pi())


def feedforward_notch_pi() -> FeedforwardFeedback:
    """Return ``notch_pi`` with a static feedforward, um to V."""
    return static_feedforward(notch_pi())


def feedforward_h_infinity() -> FeedforwardFeedback:
    """Return H-infinity control of (5.33) with an inverse feedforward, um to V; ours.

    The weights are those of ``p753.mixed_sensitivity_inversion``, for a command in V
    instead of um. A low-pass filters the command. The feedforward is the inverse of
    (5.33) without its zeros, behind a low-pass.
    """
    control = WeightedMixedSensitivity(
        scaled_to_dc(ARMA(**p753.DYNAMICS_BEHIND_HYSTERESIS), p753.GAIN),
        **p753.SENSITIVITY_WEIGHT,
        effort_weight=p753.GAIN * p753.EFFORT_WEIGHT,
        bound=H_INFINITY_BOUND,
        dt=p753.DT,
    )
    feedback = FilteredCommand(control, SecondOrderLowPass(*LOW_PASS, p753.DT))
    slow, fast = p753.lags()
    mean = math.sqrt(slow * fast)
    inverse = Biquad(
        0.5 / (math.pi * mean), 0.5 * (slow + fast) / mean, *LOW_PASS, p753.DT
    )
    static = InverseGain(Affine(p753.GAIN))
    return FeedforwardFeedback(series(dynamics=inverse, gain=static), feedback)


def adaptive_pi() -> Anticipation:
    """Return ``simc_pi`` in an AdaptiveInverse, um to V.

    The inverse leads the stage by the lag of the sensor; a negative lead of the
    Anticipation, 0 before tuning, compensates for it.
    """
    return Anticipation(p753.with_adaptive_inverse(simc_pi()), (0.0,))


def preview_feedforward_pid() -> FeedforwardFeedback:
    """Return an inverse of (5.33) and its hysteresis beside ``p753.pid``, um to V.

    Both zeros of (5.33) lie outside the unit circle: the inverse has zero phase and
    looks two samples further than r(k+1).
    """
    model = scaled_to_dc(ARMA(**p753.DYNAMICS_BEHIND_HYSTERESIS), 1.0)
    inverse = series(
        dynamics=zero_phase_inverse(model).extrapolated(), hysteresis=_inverse()
    )
    return FeedforwardFeedback(inverse, p753.pid())


def repetitive(period: int = 2_000) -> RepetitiveControl:
    """Return repetitive control around ``p753.pid``, um to V; gains ours.

    ``period`` of the reference in samples at 20 kHz: 2000 for SIN10 and other
    references with a period of 100 ms.
    """
    lag = FirstOrderLag(REPETITIVE["advance"] * p753.DT, p753.DT)
    return RepetitiveControl(p753.pid(), lag, **REPETITIVE, period=period)


def learning_control(period: int = 2_000) -> LearningControl:
    """Return iterative learning around ``p753.pid``, um to V; gains ours.

    ``period`` as for ``repetitive``.
    """
    return LearningControl(p753.pid(), period=period, **LEARNING)


def learning() -> LearningLaw:
    """Return a learning law for the reference of a ``p753.pid`` loop; gains ours."""
    return LearningLaw(**LEARNING)


def charge_drive() -> ChargeDrive:
    """Return a charge amplifier on the stage's own hysteresis, V to V; times ours."""
    load = Affine(p753.GAIN) >> _inverse()
    return ChargeDrive(load, 1.0, CHARGE_TIME, CHARGE_TIME, p753.DT)


def charge_driven_stage() -> Series:
    """Return ``p753.plant`` behind ``charge_drive``, from the command in V to um.

    The voltage of the stage may exceed the limits of the command.
    """
    stage = p753.plant()
    return series(
        drive=charge_drive(), **dict(zip(stage.names, stage.parts, strict=True))
    )
