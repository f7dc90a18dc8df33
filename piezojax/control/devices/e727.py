"""Closed loop of the PI E-727."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

from ...core.arrays import Scalar, check_option, check_order
from ...core.parameter import parameter, sample_time
from ...dynamics.filters import LowPass, Notch
from ...hardware import SlewLimit
from .servo_loop import (
    FIXED_DT,
    NO_SLEW,
    Device,
    ServoLoop,
    in_series,
    inverse_or_off,
    require_rate,
)

UNKNOWN = "unknown"
STRUCTURES = (UNKNOWN, "series", "parallel")
NOTCH_METHODS = {0: "bilinear", 1: "hold"}
"""Discretisation of a notch by the value of parameter 0x08000600."""

HIGHEST = 9e3
"""Highest frequency of the notches and of the measurement's filter, Hz."""

MOST_REJECTION = 0.98
"""Largest rejection of a notch that is on."""


def _frequency(meaning: str):
    return parameter(
        "Hz",
        meaning,
        above=0.0,
        most=HIGHEST,
        scale="log",
        typical=(10.0, HIGHEST),
        default=1e3,
    )


def _rejection(number: int):
    return parameter(
        "1",
        f"rejection of notch {number}; 1 is off",
        least=0.0,
        most=1.0,
        typical=(0.0, 1.0),
        default=1.0,
    )


def _bandwidth(number: int):
    return parameter(
        "1",
        f"bandwidth of notch {number}",
        least=0.1,
        scale="log",
        typical=(0.1, 10.0),
        default=1.0,
    )


class E727(Device):
    """PID and two notches of the E-727 at 20 kHz, with the parameters of the device.

    ``proportional`` (0x07000300) is dimensionless, ``integral_time`` (0x07000301) and
    ``derivative_time`` (0x07000302) are in s; an integral time of 0 switches the
    integral off. ``scale`` is in V per um of error for P = 1, and has to be measured.
    The notches (0x08000100 to 0x08000301) follow the PID; the filter of the measurement
    (0x05000000) is a Butterworth low-pass of order 2 if ``filter_type`` is 1. The slew
    rate (0x07000200) limits the setpoint.

    Options that the manual does not specify: ``structure`` is "series", in which P
    multiplies all terms, or "parallel"; "unknown" is simulated as "series", with a
    caution. ``anti_windup`` is "none" or "hold". A notch is
    ``(s^2 + 2 r k w s + w^2) / (s^2 + 2 k w s + w^2)`` with rejection r and bandwidth
    k; with k = 1 both interpretations of the manual agree. The device accepts r up to
    0.98, and 1; values between them are rounded. ``notch_method``
    (0x08000600) is 0, bilinear, or 1, zero-order hold; method 2 of the device is not
    modelled.

    Input an Observation, output in V. Raises ValueError for a value out of range.
    """

    proportional: Scalar = parameter(
        "1", "proportional gain P", above=0.0, scale="log", typical=(1e-4, 10.0)
    )
    integral_time: Scalar = parameter(
        "s", "integral time; 0 is off", least=0.0, scale="log", typical=(1e-5, 1.0)
    )
    derivative_time: Scalar = parameter(
        "s",
        "derivative time",
        least=0.0,
        scale="log",
        typical=(1e-7, 1e-2),
        default=0.0,
    )
    scale: Scalar = parameter(
        "V/um", "command for P = 1 and an error of 1 um", kw_only=True
    )
    lower: Scalar = parameter("V", "minimum voltage", kw_only=True)
    upper: Scalar = parameter("V", "maximum voltage", kw_only=True)
    notch_frequency_1: Scalar = _frequency("frequency of notch 1")
    notch_rejection_1: Scalar = _rejection(1)
    notch_bandwidth_1: Scalar = _bandwidth(1)
    notch_frequency_2: Scalar = _frequency("frequency of notch 2")
    notch_rejection_2: Scalar = _rejection(2)
    notch_bandwidth_2: Scalar = _bandwidth(2)
    filter_frequency: Scalar = _frequency("cut-off of the measurement's filter")
    slew_rate: Scalar = parameter(
        "um/s", "slew rate of the setpoint", above=0.0, scale="log", default=NO_SLEW
    )
    dt: float = sample_time(default=FIXED_DT)
    notch_method: int = parameter(
        "1", "discretisation of the notches", whole=True, static=True, default=0
    )
    filter_type: int = parameter(
        "1", "filter of the measurement", whole=True, static=True, default=0
    )
    structure: str = eqx.field(static=True, default=UNKNOWN)
    anti_windup: str = eqx.field(static=True, default="none")

    def __check_init__(self):
        require_rate(self)
        check_order("lower", self.lower, "upper", self.upper)
        check_option("structure", self.structure, STRUCTURES)
        check_option("notch_method", self.notch_method, NOTCH_METHODS)
        check_option("filter_type", self.filter_type, (0, 1))

    def typed(self) -> "E727":
        """Return the device with the rejections that it accepts."""
        return dataclasses.replace(
            self,
            notch_rejection_1=_accepted(self.notch_rejection_1),
            notch_rejection_2=_accepted(self.notch_rejection_2),
        )

    @property
    def cautions(self) -> tuple[str, ...]:
        """Caution that the structure is assumed, if it is."""
        if self.structure != UNKNOWN or float(self.proportional) == 1.0:
            return ()
        return (
            "the structure of the PID of the E-727 is assumed, P multiplies all terms: "
            "on the device integral and derivative may act "
            f"{1.0 / float(self.proportional):.3g} times as strongly as simulated; "
            "measure it (python -m piezojax.identify RECORD --controller e727) and set "
            "controller.structure",
        )

    def loop(self) -> ServoLoop:
        """Return the loop of the parameters, without rounding them."""
        gain = self.scale * self.proportional
        outer = self.scale if self.structure == "parallel" else gain
        notches = (
            (self.notch_frequency_1, self.notch_bandwidth_1, self.notch_rejection_1),
            (self.notch_frequency_2, self.notch_bandwidth_2, self.notch_rejection_2),
        )
        method = NOTCH_METHODS[self.notch_method]
        low_pass = LowPass(self.filter_frequency, self.dt, 2)
        return ServoLoop(
            SlewLimit(self.slew_rate, self.dt),
            low_pass if self.filter_type else in_series(),
            in_series(*(Notch(*notch, self.dt, method) for notch in notches)),
            gain,
            outer * inverse_or_off(self.integral_time),
            outer * self.derivative_time,
            self.lower,
            self.upper,
            self.dt,
            anti_windup=self.anti_windup,
        )


def _accepted(rejection: Scalar) -> Scalar:
    """Return the nearest accepted rejection; its gradient is that of ``rejection``."""
    middle = 0.5 * (MOST_REJECTION + 1.0)
    limited = jnp.minimum(rejection, MOST_REJECTION)
    nearest = jnp.where(rejection > middle, 1.0, limited)
    zero = rejection - jax.lax.stop_gradient(rejection)
    return jax.lax.stop_gradient(nearest) + zero
