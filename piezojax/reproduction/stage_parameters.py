"""What is fitted: what may differ from print, and the stage and sensor it makes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..catalog import p753
from ..core.space import Transform
from ..core.system import Series, series
from ..dynamics import ARMA, FirstOrderLag, FractionalDelay, scaled_to_dc
from ..hardware import Sensor
from ..hysteresis import ColemanHodgdon

LONGEST_DELAY = 4
"""Samples that the delay line of the stage holds."""


@dataclass(frozen=True)
class Quantity:
    """A property of the stage: where its fit starts, its range and its unit."""

    start: float
    lower: float
    upper: float
    unit: str
    scale: Transform = "log"


def _within(value: float, ratio: float, unit: str) -> Quantity:
    return Quantity(value, value / ratio, value * ratio, unit)


def quantities(dynamics: ARMA) -> dict[str, Quantity]:
    """Return what is fitted, starting from the printed ``dynamics``.

    ``gain`` is the DC gain behind the hysteresis. The b of the hysteresis is not among
    them: gain, a and c already reach every curve that it could. ``noise`` is what the
    sensor adds, rms: the loop turns it into displacement.
    """
    slow, fast = sorted(-p753.RATE * np.log(np.abs(dynamics.poles())))
    return {
        "slow_pole": _within(float(slow), 3.0, "rad/s"),
        "fast_pole": _within(float(fast), 4.0, "rad/s"),
        "gain": _within(1.0, 2.0, "1"),
        "hysteresis_a": _within(p753.HYSTERESIS_CHAPTER_5["a"], 3.0, "um/V^2"),
        "hysteresis_c": _within(-p753.HYSTERESIS_CHAPTER_5["c"], 3.0, "-1/V"),
        "delay": Quantity(1e-5, 0.0, 1.5e-4, "s", "linear"),
        "sensor_lag": Quantity(1e-5, 1e-7, 3e-4, "s", "linear"),
        "noise": Quantity(p753.NOISE_RMS, 0.0, 0.03, "um", "linear"),
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
    """Return the sensor, um to um: noise, then a lag."""
    return series(
        noise=Sensor(values["noise"]),
        lag=FirstOrderLag(values["sensor_lag"], p753.DT),
    )
