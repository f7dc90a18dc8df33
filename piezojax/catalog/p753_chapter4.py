"""The P-753 with the controllers of chapter 4 at sampling rates from 1 to 20 kHz.

Every number carries its table or section in Y. Cao's thesis (2013); the models are
``p753.DYNAMICS_BY_RATE`` (Table 4-1). Rates in Hz.
"""

from collections.abc import Mapping
from typing import Any

from ..control import (
    AlphaBeta,
    Anticipation,
    BangBang,
    ContinuousSlidingMode,
    ModelReferenceSlidingMode,
    Observer,
    SlidingMode,
    SwitchingPID,
)
from ..core.arrays import ScalarLike
from ..core.feedback import Feedback
from ..core.system import Series, System, series
from ..dynamics import ARMA, Oversampled, SecondOrderLag, scaled_to_dc
from ..hardware import Sensor
from . import p753

TRADITIONAL_GAINS = {
    1_000: {
        "proportional": 0.6,
        "integral": 240.0,
        "derivative": 5e-4,
        "surface": 1_000.0,
        "error_weight": 1.0,
        "control_weight": 100.0,
    },
    20_000: {
        "proportional": 0.001,
        "integral": 10.0,
        "derivative": 1e-6,
        "surface": 18_000.0,
        "error_weight": 1.0,
        "control_weight": 400.0,
    },
}
"""Table 4-2, tuned for a step. The gains used for Tables 4-5, 4-6 are not printed."""

MODEL_REFERENCE_GAINS = {
    "4-3": {
        1_000: {
            "proportional": 4.2,
            "integral": 1_150.0,
            "derivative": 0.001,
            "control_weight": 0.5,
        },
        20_000: {
            "proportional": 10.0,
            "integral": 25_000.0,
            "derivative": 2e-5,
            "control_weight": 0.001,
        },
    },
    "4-4": {
        1_000: {
            "proportional": 9.6,
            "integral": 1_500.0,
            "derivative": 0.001,
            "control_weight": 0.05,
        },
        2_000: {
            "proportional": 4.0,
            "integral": 1_000.0,
            "derivative": 2e-5,
            "control_weight": 0.001,
        },
        5_000: {
            "proportional": 2.0,
            "integral": 1_500.0,
            "derivative": 2e-5,
            "control_weight": 0.001,
        },
        10_000: {
            "proportional": 1.5,
            "integral": 3_500.0,
            "derivative": 2e-5,
            "control_weight": 0.001,
        },
        20_000: {
            "proportional": 1.0,
            "integral": 12_000.0,
            "derivative": 2e-5,
            "control_weight": 0.001,
        },
    },
}
"""Tables 4-3 (steps) and 4-4 (tracking); m and Q are equal in all rows."""

SURFACE = (0.99,)
"""m in S = [m, 1], Tables 4-3 and 4-4."""

ERROR_WEIGHT = 1.0
"""Q, Tables 4-3 and 4-4."""

REFERENCE_MODELS = {
    "4-3": {"frequency": 1_000.0, "damping": 0.7},
    "4-4": {"frequency": 3_000.0, "damping": 0.25},
}
"""Reference model (4.47) of each table, frequency in rad/s: sections 4.5.4.2 and
4.5.4.3."""

CONTINUOUS_GAINS = {
    5_000: {"proportional": 1e-4, "integral": 0.03, "derivative": 1e-7},
    10_000: {"proportional": 0.002, "integral": 0.6, "derivative": 1e-7},
    20_000: {"proportional": 0.001, "integral": 1.0, "derivative": 1e-7},
}
"""Section 4.5.4.3, by Ziegler and Nichols; the surface is ``p753.SURFACE``."""

BANG_BANG_GAINS = {1_000: 3.0, 20_000: 1.0}
"""K in V, section 4.5.4.1."""

BANG_BANG_CONTROL_WEIGHT = 1.0
"""R of the nominal DSMC with Q = 1: ours, not printed. With R = 400 (Table 4-2), K = 1
is too small to move the stage; for R of about 1 and below, the voltage limits determine
the response."""

FILTERS = {1_000: (0.3, 0.001), 20_000: (0.1, 1e-4)}
"""Alpha and beta, section 4.5.4.1; the other rates are not printed."""

UNPRINTED_FILTER = (0.1, 1e-4)
"""Alpha and beta of the other rates: those of 20 kHz, an assumption."""


def with_law(gains: Mapping[str, float], rate: int) -> dict[str, Any]:
    """Return ``gains`` with P, I and D collected in a ``SwitchingPID`` at ``rate``."""
    names = ("proportional", "integral", "derivative")
    law = SwitchingPID(*(gains[name] for name in names), dt=1.0 / rate)
    return {"law": law} | {k: v for k, v in gains.items() if k not in names}


def alpha_beta(rate: int = 20_000) -> AlphaBeta:
    """Return the printed filter at ``rate``, or that of 20 kHz if none is printed."""
    return AlphaBeta(*FILTERS.get(rate, UNPRINTED_FILTER), 1.0 / rate)


def unfiltered(rate: int = 20_000) -> AlphaBeta:
    """Return a filter whose position is the measured displacement."""
    return AlphaBeta(1.0, 0.0, 1.0 / rate)


def model(rate: int = 20_000) -> ARMA:
    """Return the row of Table 4-1 for ``rate``, V to um."""
    return ARMA(**p753.printed("rate in Hz", p753.DYNAMICS_BY_RATE, rate))


def model_reference(
    rate: int = 20_000, table: str = "4-4", filter: Observer | None = None
) -> ModelReferenceSlidingMode:
    """Return the model-reference PID-SMC of ``table`` "4-3" or "4-4", um to V.

    ``filter`` replaces the printed one. Raises ValueError for a rate or a table that is
    not printed.
    """
    gains = p753.printed("table", MODEL_REFERENCE_GAINS, table)
    return ModelReferenceSlidingMode(
        **with_law(p753.printed("rate in Hz", gains, rate), rate),
        surface=SURFACE,
        error_weight=ERROR_WEIGHT,
        model=model(rate),
        reference_model=SecondOrderLag(**REFERENCE_MODELS[table], dt=1.0 / rate),
        filter=alpha_beta(rate) if filter is None else filter,
    )


def anticipating_model_reference(rate: int = 20_000) -> Anticipation:
    """Return ``model_reference`` of Table 4-4 in an Anticipation of lead 0 (ours)."""
    return Anticipation(model_reference(rate), (0.0,))


def traditional(rate: int = 20_000) -> SlidingMode:
    """Return the traditional PID-SMC of Table 4-2 (1 or 20 kHz), um to V."""
    return SlidingMode(
        **with_law(p753.printed("rate in Hz", TRADITIONAL_GAINS, rate), rate),
        model=model(rate),
        filter=alpha_beta(rate),
    )


def bang_bang(rate: int = 20_000) -> SlidingMode:
    """Return the nominal DSMC with bang-bang switching (1 or 20 kHz), um to V."""
    return SlidingMode(
        BangBang(p753.printed("rate in Hz", BANG_BANG_GAINS, rate)),
        surface=TRADITIONAL_GAINS[rate]["surface"],
        error_weight=ERROR_WEIGHT,
        control_weight=BANG_BANG_CONTROL_WEIGHT,
        model=model(rate),
        filter=alpha_beta(rate),
    )


def continuous(rate: int = 20_000) -> ContinuousSlidingMode:
    """Return the continuous PID-SMC (5, 10 or 20 kHz), um to V."""
    return ContinuousSlidingMode(
        **with_law(p753.printed("rate in Hz", CONTINUOUS_GAINS, rate), rate),
        surface=p753.SURFACE,
        filter=alpha_beta(rate),
    )


def plant() -> Series:
    """Return the stage at 20 kHz, V to um, with the dynamics of Table 3-2.

    The hysteresis is that of chapter 5. The dynamics have the denominator and the y_2
    numerator of Table 3-2, scaled to unit DC gain. The slowest pole is faster than that
    of ``p753.plant``, with which the gains of Table 4-4 and the printed filter give an
    unstable loop.
    """
    printed = p753.ARMA_HYSTERESIS["3-2"]
    dynamics = ARMA(printed["autoregressive"], printed["moving_2"])
    return series(hysteresis=p753.hysteresis(), dynamics=scaled_to_dc(dynamics, 1.0))


def loop(
    controller: System,
    rate: int = 20_000,
    stage: System | None = None,
    noise_rms: ScalarLike = p753.NOISE_RMS,
) -> Feedback:
    """Return ``controller``, running at ``rate``, around a stage simulated at 20 kHz.

    ``stage`` (V to um) is ``plant`` if left out. Raises ValueError for a rate that does
    not divide 20 kHz.
    """
    stage = plant() if stage is None else stage
    return Feedback(
        controller,
        Oversampled(stage, p753.samples_at(rate)),
        p753.actuator(),
        Sensor(noise_rms),
    )
