"""PID of PyRPL on the Red Pitaya."""

import dataclasses
import math

import jax
import jax.numpy as jnp

from ...core.arrays import Scalar, as_array, check, check_option, check_order
from ...core.parameter import parameter, rounded_fields, sample_time
from ...dynamics.filters import LowPass
from .servo_loop import Device, ServoLoop, in_series

CLOCK = 8e-9
"""Period of the gate array, s."""

STEP_P = 2.0**-12
STEP_I = 1.0 / (2.0**32 * 2.0 * math.pi * CLOCK)
"""Steps of the gains in their registers."""

MOST_P, MOST_I = 2.0**11, STEP_I * 2.0**23
"""Largest gains of the registers, 24 bits with a sign."""

INTEGRAL = 4.0
"""Largest magnitude in the register of the integral, V."""

FILTERS = ("filter_1", "filter_2", "filter_3", "filter_4")


def _gain(unit: str, meaning: str, step: float, most: float):
    return parameter(unit, meaning, least=-most, most=most, step=step)


def _cutoff(number: int):
    return parameter(
        "Hz",
        f"cut-off of input filter {number}",
        above=0.0,
        below_nyquist=True,
        switched=True,
        scale="log",
        typical=(10.0, 1e6),
        default=1e4,
    )


class PyRPL(Device):
    """PID module of PyRPL, with the numbers of ``pid0``: p, i, input filters, limits.

    The output is ``p e + 2 pi i int e dt`` of the error e, the filtered input less the
    set point: a loop that raises the output when the reading is too low has negative
    gains. ``i`` is the frequency at which the integral has the gain 1. Gains are
    rounded as in the registers. The first ``filters`` of four low-passes of order 1 are
    on, at the cut-offs of the module: 125 MHz / 2 pi divided by a power of two, below
    half the sampling rate. The integral stays between -4 and 4 V, the output between
    ``min_voltage`` and ``max_voltage``. The derivative is disabled in the gate array.

    The gate array runs at 125 MHz; here the module is sampled at ``dt``, and its delay,
    about 0.3 us with the converters, belongs in ``computation`` of the study.
    ``sensor_gain`` and ``amplifier_gain`` are the gains between the device and the
    stage, and ``offset`` is the voltage of the piezo at an output of 0 V. Source:
    PyRPL's PID module. Input an Observation, output in V. Raises ValueError for a value
    out of range.
    """

    p: Scalar = _gain("V/V", "proportional gain", STEP_P, MOST_P)
    i: Scalar = _gain("Hz", "unity-gain frequency of the integral", STEP_I, MOST_I)
    sensor_gain: Scalar = parameter("V/um", "gain of the sensor", kw_only=True)
    amplifier_gain: Scalar = parameter(
        "V/V", "gain of the amplifier", above=0.0, kw_only=True
    )
    offset: Scalar = parameter("V", "piezo voltage for an output of 0", default=0.0)
    filter_1: Scalar = _cutoff(1)
    filter_2: Scalar = _cutoff(2)
    filter_3: Scalar = _cutoff(3)
    filter_4: Scalar = _cutoff(4)
    min_voltage: Scalar = parameter(
        "V", "lower limit of the output", least=-1.0, most=1.0, default=-1.0
    )
    max_voltage: Scalar = parameter(
        "V", "upper limit of the output", least=-1.0, most=1.0, default=1.0
    )
    dt: float = sample_time(kw_only=True)
    filters: int = parameter(
        "1",
        "number of input filters that are on",
        whole=True,
        static=True,
        default=0,
    )

    def __check_init__(self):
        check_order("min_voltage", self.min_voltage, "max_voltage", self.max_voltage)
        check_option("filters", self.filters, range(len(FILTERS) + 1))
        for name in FILTERS[: self.filters]:
            check(name, getattr(self, name), below=0.5 / self.dt)

    def typed(self) -> "PyRPL":
        """Return the module with the gains and cut-offs that its registers hold.

        The cut-off of a filter that is on stays below half the sampling rate.
        """
        cutoffs = {
            name: _available(
                getattr(self, name), 0.5 / self.dt if on < self.filters else math.inf
            )
            for on, name in enumerate(FILTERS)
        }
        return dataclasses.replace(rounded_fields(self), **cutoffs)

    def loop(self) -> ServoLoop:
        """Return the loop of the parameters, without rounding them."""
        gain = -self.sensor_gain * self.amplifier_gain
        ends = (self.min_voltage, self.max_voltage, -INTEGRAL, INTEGRAL)
        lower, upper, least, most = (
            self.offset + self.amplifier_gain * end for end in ends
        )
        return ServoLoop(
            in_series(),
            in_series(
                *(
                    LowPass(getattr(self, name), self.dt)
                    for name in FILTERS[: self.filters]
                )
            ),
            in_series(),
            gain * self.p,
            gain * 2.0 * jnp.pi * self.i,
            as_array(0.0),
            lower,
            upper,
            self.dt,
            least_integral=least,
            most_integral=most,
        )


def _available(cutoff: Scalar, below: float) -> Scalar:
    """Return the nearest cut-off of the module that lies ``below`` a frequency in Hz.

    Its gradient is that of ``cutoff``.
    """
    highest = 1.0 / (2.0 * math.pi * CLOCK)
    most = jnp.minimum(jnp.ceil(jnp.log2(below / highest)) - 1.0, 0.0)
    octaves = jnp.minimum(jnp.round(jnp.log2(cutoff / highest)), most)
    nearest = highest * 2.0**octaves
    return cutoff + jax.lax.stop_gradient(nearest - cutoff)
