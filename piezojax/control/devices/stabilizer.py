"""One channel of the Stabilizer with the dual-iir firmware."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from ...core.arrays import Scalar, ScalarLike, as_array, check_order
from ...core.feedback import Observation
from ...core.limited import Limited
from ...core.parameter import parameter, sample_time
from .servo_loop import Device

PERIOD = 1.28e-6
"""Sample time of the firmware as it is delivered, s: 128 ticks of 10 ns."""

CODES = 3200.0
"""Codes of the converters per V: 16 bit from -10.24 to 10.24 V."""

NO_LIMIT = 1e30
"""Gain limit that never acts."""


def _limit(of: str):
    return parameter(
        "V/V", f"limit of the {of} gain", above=0.0, scale="log", default=NO_LIMIT
    )


class Stabilizer(Device):
    """Biquad of a channel of the Stabilizer, from the gains of its ``Pid``.

    ``p``, ``i`` and ``d`` are the numbers under ``repr/Pid/gain`` (V/V times a power of
    s), ``limit_i`` and ``limit_d`` those under ``repr/Pid/limit``; the sign of ``p`` is
    that of all of them. The ``order`` of the ``Pid`` is "I". A feedback that raises
    the output when the reading is too low has a negative ``p``. ``minimum`` and
    ``maximum`` limit the output; the biquad continues from the limited output, so that
    its integral does not wind up. Coefficients and the running sum are rounded to
    single precision, in codes of the converters, as the firmware does: at 781 kHz a
    small integral gain loses small errors. The study sets the converters themselves.

    ``sensor_gain`` and ``amplifier_gain`` are the gains between the device and the
    stage, and ``offset`` is the voltage of the piezo at an output of 0 V. Source:
    firmware stabilizer with idsp 0.21. Input an Observation, output in V. Raises
    ValueError for a value out of range.
    """

    p: Scalar = parameter("V/V", "proportional gain", scale="log")
    i: Scalar = parameter("V/(V s)", "integral gain", least=0.0, scale="log")
    sensor_gain: Scalar = parameter("V/um", "gain of the sensor", kw_only=True)
    amplifier_gain: Scalar = parameter(
        "V/V", "gain of the amplifier", above=0.0, kw_only=True
    )
    d: Scalar = parameter(
        "V s/V", "derivative gain", least=0.0, scale="log", default=0.0
    )
    limit_i: Scalar = _limit("integral")
    limit_d: Scalar = _limit("derivative")
    offset: Scalar = parameter("V", "piezo voltage for an output of 0", default=0.0)
    minimum: Scalar = parameter("V", "lower limit of the output", default=-10.0)
    maximum: Scalar = parameter("V", "upper limit of the output", default=10.0)
    dt: float = sample_time(default=PERIOD)

    def __check_init__(self):
        check_order("minimum", self.minimum, "maximum", self.maximum)

    def loop(self) -> "ClampedBiquad":
        """Return the biquad of the gains."""
        sign = jnp.where(self.p < 0.0, -1.0, 1.0)
        # The firmware computes in single precision, the derivative gain first.
        tick = _single(self.dt)
        power = _single(1.0 / tick)
        gd = _single(_single(sign * self.d) * power)
        power = _single(power * tick)
        gp = _single(_single(self.p) * power)
        gi = _single(_single(sign * self.i) * _single(power * tick))
        li = _single(gi / _single(sign * self.limit_i))
        ld = _single(gd / _single(sign * self.limit_d))
        scale = _single(1.0 / _single(_single(li + 1.0) + ld))
        gi, gp, gd = (_single(gain * scale) for gain in (gi, gp, gd))
        lp, ld = _single(scale), _single(ld * scale)
        forward = (
            _single(_single(gi + gp) + gd),
            _single(_single(-gp - gd) - gd),
            gd,
        )
        back = _single(_single(lp + ld) + ld), -ld
        return ClampedBiquad(
            forward,
            back,
            CODES * self.sensor_gain,
            self.amplifier_gain / CODES,
            self.offset,
            _single(CODES * self.minimum),
            _single(CODES * self.maximum),
            self.dt,
        )


class BiquadState(NamedTuple):
    """The last two inputs and outputs, in codes."""

    inputs: tuple[Scalar, Scalar]
    outputs: tuple[Scalar, Scalar]


class ClampedBiquad(Limited):
    """``y = clip(b0 x + b1 x1 + b2 x2 + a1 y1 + a2 y2 + u)``, in single precision.

    x is the measurement and u the offset of the set point, in codes of the converters;
    ``forward`` holds b, ``back`` a. ``codes`` is in codes per um, ``volts`` in V of the
    piezo per code. Input an Observation, output in V.
    """

    forward: tuple[Scalar, Scalar, Scalar]
    back: tuple[Scalar, Scalar]
    codes: Scalar
    volts: Scalar
    offset: Scalar
    lower: Scalar
    upper: Scalar
    dt: float = sample_time()

    @property
    def ends(self) -> tuple[Scalar, Scalar]:
        ends = [self.offset + self.volts * end for end in (self.lower, self.upper)]
        return jnp.minimum(*ends), jnp.maximum(*ends)

    def init(self, input: Observation) -> BiquadState:
        x = _single(self.codes * input.measured)
        y = _single((input.applied - self.offset) / self.volts)
        return BiquadState((x, x), (y, y))

    def step(
        self, state: BiquadState, input: Observation
    ) -> tuple[BiquadState, Scalar]:
        x = _single(self.codes * as_array(input.measured))
        setpoint = _single(self.codes * as_array(input.reference))
        b, a, (x1, x2), (y1, y2) = self.forward, self.back, *state
        total = _single(b[0] * x)
        for coefficient, value in ((b[1], x1), (b[2], x2), (a[0], y1), (a[1], y2)):
            total = _single(total + _single(coefficient * value))
        shift = _single(-setpoint * _single(_single(b[0] + b[1]) + b[2]))
        y = jnp.clip(_single(total + shift), self.lower, self.upper)
        return BiquadState((x, x1), (y, y1)), self.offset + self.volts * y


def _single(value: ScalarLike) -> Scalar:
    """Return ``value`` rounded to single precision."""
    return jax.lax.reduce_precision(as_array(value), 8, 23)
