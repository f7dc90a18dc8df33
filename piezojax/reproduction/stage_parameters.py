"""Fitted properties of the P-753 stage, and the stage and sensor with given values."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..catalog import p753
from ..core.space import Range
from ..core.system import Series, series
from ..dynamics import ARMA, FirstOrderLag, FractionalDelay, scaled_to_dc
from ..hardware import Sensor
from ..hysteresis import ColemanHodgdon

LONGEST_DELAY = 4
"""Longest delay of the stage, samples."""


def within(value: float, ratio: float, unit: str) -> Range:
    """Return the range of factors 1/``ratio`` to ``ratio`` around a start value."""
    return Range(value / ratio, value * ratio, "log", value, unit)


def quantities(dynamics: ARMA) -> dict[str, Range]:
    """Return the ranges of the fitted properties, starting from printed ``dynamics``.

    ``gain`` is the DC gain behind the hysteresis. The b of the hysteresis is not
    fitted, because gain, a and c already reach every curve that it could. ``noise`` is
    the rms noise of the sensor, which the loop turns into displacement.
    """
    slow, fast = sorted(-p753.RATE * np.log(np.abs(dynamics.poles())))
    return {
        "slow_pole": within(float(slow), 3.0, "rad/s"),
        "fast_pole": within(float(fast), 4.0, "rad/s"),
        "gain": within(1.0, 2.0, "1"),
        "hysteresis_a": within(p753.HYSTERESIS_CHAPTER_5["a"], 3.0, "um/V^2"),
        "hysteresis_c": within(-p753.HYSTERESIS_CHAPTER_5["c"], 3.0, "-1/V"),
        "delay": Range(0.0, 1.5e-4, start=1e-5, unit="s"),
        "sensor_lag": Range(1e-7, 3e-4, start=1e-5, unit="s"),
        "noise": Range(0.0, 0.03, start=p753.NOISE_RMS, unit="um"),
    }


def stage_of(values: Mapping[str, Any], numerator: Sequence[float]) -> Series:
    """Return the stage, V to um: delay, hysteresis, two poles and ``numerator``."""
    slow, fast = (
        jnp.exp(-p753.DT * values[name]) for name in ("slow_pole", "fast_pole")
    )
    dynamics = ARMA((slow + fast, -slow * fast), tuple(numerator))
    return series(
        delay=FractionalDelay(values["delay"], p753.DT, LONGEST_DELAY),
        hysteresis=ColemanHodgdon(
            values["hysteresis_a"],
            p753.HYSTERESIS_CHAPTER_5["b"],
            -values["hysteresis_c"],
        ),
        dynamics=scaled_to_dc(dynamics, values["gain"]),
    )


def sensor_of(values: Mapping[str, Any]) -> Series:
    """Return the sensor, um to um: noise, then lag."""
    return series(
        noise=Sensor(values["noise"]),
        lag=FirstOrderLag(values["sensor_lag"], p753.DT),
    )
