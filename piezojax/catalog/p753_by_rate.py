"""The P-753 and one controller of each kind at any sampling rate of Table 4-1.

The gains are the printed ones where Y. Cao's thesis (2013) prints some. At other rates
they are ours: the printed gains of the nearest rate, scaled so that the response,
counted in samples, stays about the same. With q the new sample time over the printed
one, a gain on an error rate (um/s) is multiplied by q, one on its derivative by q^2 and
the slope m of a surface (1/s) by 1/q. Integral gains, weights, the alpha-beta filter
and cut-offs in rad/s are unchanged. The model is the row of Table 4-1 for the rate; for
``inversion`` and ``disturbance_observer`` at 20 kHz it is (5.33). Rates in Hz.

A controller raises ValueError, listing the known rates, for a rate without a model; a
plant raises it for a rate that does not divide 20 kHz.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ..control import (
    PID,
    AlphaBeta,
    BangBang,
    ContinuousSlidingMode,
    DisturbanceObserverControl,
    InversionControl,
    SlidingMode,
)
from ..core.system import Series, System, series
from ..dynamics import ARMA, scaled_to_dc
from ..hysteresis import InverseColemanHodgdon
from . import p753, p753_chapter4

ULTIMATE = {
    1_000: (7.354, 2.0e-3),
    2_000: (8.940, 1.0e-3),
    5_000: (21.428, 6.344e-4),
    10_000: (11.669, 5.437e-4),
    20_000: (8.616, 4.039e-4),
}
"""Ultimate gain (V/um) and period (s) by rate: proportional gain and period at which
the loop with the linear part of ``chapter4_plant``, K_e and its dynamics, starts to
oscillate. At 1 and 2 kHz the period is two samples."""

SCALING = {"proportional": 1, "derivative": 2, "surface": -1}
"""Exponent of q, the ratio of sample times, by which a gain is scaled; 0 for others."""

TO_SCALE = {
    "traditional": tuple(p753_chapter4.TRADITIONAL_GAINS),
    "continuous": (10_000, 20_000),
    "bang_bang": tuple(p753_chapter4.BANG_BANG_GAINS),
    "chapter 5": (int(p753.RATE),),
}
"""Rates of the printed gains that are scaled to other rates. The continuous gains of
5 kHz are left out: the integral one looks ten times too small (see
``reproduction.chapter4.cells``)."""


BANG_BANG_CONTROL_WEIGHT = {1_000: 50.0, 20_000: 20.0}
"""R of bang-bang switching with Q = 1 for ``chapter4_plant``: ours, not printed. With
the printed K and surface it is the smallest of 1, 2, 5, 10, 20, 50, ... for which the
voltage stays within its limits on sines of 5 um, and the best of that series."""


def plant(*, rate: int = 20_000) -> System:
    """Return the stage of chapter 5, V to um, its input held between samples."""
    return _resampled(p753.plant(), rate)


def chapter4_plant(*, rate: int = 20_000) -> System:
    """Return the stage of chapter 4, V to um, its input held between samples."""
    return _resampled(p753_chapter4.plant(), rate)


def _resampled(stage: Series, rate: int) -> Series:
    hysteresis, dynamics = stage.parts
    assert isinstance(dynamics, ARMA)
    # At a constant voltage the hysteresis is static; only the dynamics move.
    held = slower(dynamics, p753.samples_at(rate))
    return series(hysteresis=hysteresis, dynamics=held)


def slower(model: ARMA, samples: int) -> ARMA:
    """Return the second-order ``model`` at a rate ``samples`` times lower.

    The input is held for ``samples`` steps and the output taken at the last of them.
    """
    if samples == 1:
        return model
    a1, a2 = (float(a) for a in model.autoregressive)
    b0, b1, b2 = (float(b) for b in model.moving)
    step = np.array([[a1, 1.0], [a2, 0.0]])
    drive = np.array([b1 + a1 * b0, b2 + a2 * b0])
    power, total = np.eye(2), np.zeros((2, 2))
    for _ in range(samples - 1):
        power, total = step @ power, total + power
    output, through = power[0], total[0] @ drive + b0
    power, total = step @ power, total + power
    drive = total @ drive
    a1, a2 = np.trace(power), -np.linalg.det(power)
    first, second = output @ drive, output @ power @ drive
    return ARMA(
        (a1, a2),
        (through, first - a1 * through, second - a1 * first - a2 * through),
    )


def ziegler_nichols(rate: int = 20_000) -> PID:
    """Return a PI by the rule of Ziegler and Nichols (1942), um to V.

    P = 0.45 K_u and an integral time of T_u/1.2, from ``ULTIMATE``.
    """
    p753_chapter4.model(rate)
    gain, period = ULTIMATE[rate]
    proportional = 0.45 * gain
    return PID(
        proportional, 1.2 * proportional / period, 0.0, 1.0 / rate, 100.0, dt=1.0 / rate
    )


def traditional(rate: int = 20_000) -> SlidingMode:
    """Return the traditional PID-SMC (Table 4-2: 1 and 20 kHz), um to V."""
    model = p753_chapter4.model(rate)
    near = _start("traditional", p753_chapter4.TRADITIONAL_GAINS, rate)
    gains = _scaled(p753_chapter4.TRADITIONAL_GAINS[near], near / rate)
    return SlidingMode(
        **p753_chapter4.with_law(gains, rate), model=model, filter=_filter(near, rate)
    )


def continuous(rate: int = 20_000) -> ContinuousSlidingMode:
    """Return the continuous PID-SMC (section 4.5.4.3: 5, 10 and 20 kHz), um to V."""
    p753_chapter4.model(rate)  # raises ValueError for a rate without a model
    near = _start("continuous", p753_chapter4.CONTINUOUS_GAINS, rate)
    printed = p753_chapter4.CONTINUOUS_GAINS[near] | {"surface": p753.SURFACE}
    gains = _scaled(printed, near / rate)
    return ContinuousSlidingMode(
        **p753_chapter4.with_law(gains, rate), filter=_filter(near, rate)
    )


def bang_bang(rate: int = 20_000) -> SlidingMode:
    """Return the nominal DSMC with bang-bang switching (1 and 20 kHz), um to V.

    K is printed; R is found by trial. With R = 1 of ``p753_chapter4.bang_bang`` the
    stage of chapter 5 shows the printed step, but on the stage of chapter 4 the voltage
    hits its limits.
    """
    model = p753_chapter4.model(rate)
    near = _start("bang_bang", p753_chapter4.BANG_BANG_GAINS, rate)
    surface = p753_chapter4.TRADITIONAL_GAINS[near]["surface"]
    return SlidingMode(
        BangBang(p753_chapter4.BANG_BANG_GAINS[near]),
        **_scaled({"surface": surface}, near / rate),
        error_weight=p753_chapter4.ERROR_WEIGHT,
        control_weight=BANG_BANG_CONTROL_WEIGHT[near],
        model=model,
        filter=_filter(near, rate),
    )


def inversion(rate: int = 20_000) -> InversionControl:
    """Return the inversion-based PID-SMC (Table 5-2: 20 kHz), um to V."""
    return InversionControl(
        _behind_hysteresis("inversion", rate), InverseColemanHodgdon(p753.hysteresis())
    )


def disturbance_observer(rate: int = 20_000) -> DisturbanceObserverControl:
    """Return the DOB-based PID-SMC (Table 5-2: 20 kHz), um to V."""
    feedback = _behind_hysteresis("dob", rate)
    return DisturbanceObserverControl(
        feedback, feedback.model, gain=p753.GAIN, cutoff=p753.CUTOFF, dt=1.0 / rate
    )


def _behind_hysteresis(name: str, rate: int) -> SlidingMode:
    """Return chapter 5's PID-SMC, in um, for dynamics behind a hysteresis.

    At 20 kHz the model is (5.33), else the row of Table 4-1 scaled to unit DC gain.
    """
    model = p753_chapter4.model(rate)
    if rate == p753.RATE:
        model = ARMA(**p753.DYNAMICS_BEHIND_HYSTERESIS)
    else:
        model = scaled_to_dc(model, 1.0)
    near = _start("chapter 5", (), rate)
    printed = p753.GAINS["5-2"][name] | {"surface": p753.SURFACE}
    return SlidingMode(
        **p753_chapter4.with_law(_scaled(printed, near / rate), rate),
        error_weight=p753.ERROR_WEIGHT,
        control_weight=p753.CONTROL_WEIGHT,
        model=model,
        filter=_filter(near, rate),
    )


def _start(name: str, printed: Iterable[int], rate: int) -> int:
    """Return the printed rate whose gains are scaled to ``rate``."""
    if rate in printed:
        return rate
    return min(TO_SCALE[name], key=lambda known: abs(math.log(known / rate)))


def _filter(near: int, rate: int) -> AlphaBeta:
    printed = p753_chapter4.alpha_beta(near)
    return AlphaBeta(printed.alpha, printed.beta, 1.0 / rate)


def _scaled(gains: Mapping[str, float], ratio: float) -> dict[str, Any]:
    return {
        name: value * ratio ** SCALING.get(name, 0) for name, value in gains.items()
    }
