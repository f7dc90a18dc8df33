"""Generic digital servo: PID, notches, low-pass, slew-rate limit and saturation."""

import equinox as eqx
import jax.numpy as jnp

from ...core.arrays import Scalar, check, check_option, check_order
from ...core.parameter import parameter, sample_time
from ...dynamics.filters import LowPass, Notch
from ...hardware import SlewLimit
from .servo_loop import (
    NO_SLEW,
    Device,
    ServoLoop,
    in_series,
    inverse_or_off,
)

FORMS = ("parallel", "standard")


def _frequency(meaning: str):
    return parameter(
        "Hz",
        meaning,
        above=0.0,
        below_nyquist=True,
        switched=True,
        scale="log",
        typical=(10.0, 1e5),
        default=1e3,
    )


def _width(number: int):
    return parameter(
        "Hz",
        f"-3 dB width of notch {number}",
        above=0.0,
        scale="log",
        typical=(1.0, 1e4),
        default=500.0,
    )


def _depth(number: int):
    return parameter(
        "1",
        f"gain at the centre of notch {number}; 1 is off",
        least=0.0,
        most=1.0,
        typical=(0.0, 1.0),
        default=1.0,
    )


class Servo(Device):
    """Feedforward, PID, two notches, a low-pass, slew-rate limit and saturation.

    With the ``form`` "parallel" the PID is P e + I int e dt + D de/dt, with
    ``integral`` in V/(um s) and ``derivative`` in V s/um. With "standard" it is
    P (e + int e dt / Ti + Td de/dt), where ``integral`` and ``derivative`` hold the
    times Ti and Td in s; a study must then give the bounds of ``integral``. In both
    forms an ``integral`` of 0 switches the integral off. ``feedforward`` multiplies the
    setpoint behind its slew limit. ``low_pass_order`` is 0 for no low-pass, 1 or 2.
    ``anti_windup`` is "none" or "hold". Input an Observation, output in V. Raises
    ValueError for a value out of range.
    """

    proportional: Scalar = parameter(
        "V/um", "proportional gain P", scale="log", typical=(1e-3, 1e2)
    )
    integral: Scalar = parameter(
        "V/(um s)",
        "integral gain I; in the form standard the time Ti, in s",
        least=0.0,
        scale="log",
        typical=(1e-1, 1e5),
    )
    derivative: Scalar = parameter(
        "V s/um",
        "derivative gain D; in the form standard the time Td, in s",
        scale="log",
        typical=(1e-8, 1e-1),
        default=0.0,
    )
    feedforward: Scalar = parameter("V/um", "feedforward gain", default=0.0)
    notch_frequency_1: Scalar = _frequency("frequency of notch 1")
    notch_width_1: Scalar = _width(1)
    notch_depth_1: Scalar = _depth(1)
    notch_frequency_2: Scalar = _frequency("frequency of notch 2")
    notch_width_2: Scalar = _width(2)
    notch_depth_2: Scalar = _depth(2)
    low_pass: Scalar = _frequency("cut-off of the low-pass")
    slew_rate: Scalar = parameter(
        "um/s", "slew rate of the setpoint", above=0.0, scale="log", default=NO_SLEW
    )
    lower: Scalar = parameter("V", "minimum voltage", kw_only=True)
    upper: Scalar = parameter("V", "maximum voltage", kw_only=True)
    dt: float = sample_time(kw_only=True)
    low_pass_order: int = parameter(
        "1", "order of the low-pass", whole=True, static=True, default=0
    )
    form: str = eqx.field(static=True, default="parallel")
    anti_windup: str = eqx.field(static=True, default="none")

    def __check_init__(self):
        check_order("lower", self.lower, "upper", self.upper)
        check_option("form", self.form, FORMS)
        check_option("low_pass_order", self.low_pass_order, (0, 1, 2))
        for name, used in (
            ("notch_frequency_1", self.notch_depth_1),
            ("notch_frequency_2", self.notch_depth_2),
            ("low_pass", 0.0 if self.low_pass_order else 1.0),
        ):
            below = jnp.where(used < 1.0, getattr(self, name), 0.0)
            check(name, below, below=0.5 / self.dt)

    def loop(self) -> ServoLoop:
        """Return the loop of the parameters, without rounding them."""
        integral, derivative = self.integral, self.derivative
        if self.form == "standard":
            integral = self.proportional * inverse_or_off(integral)
            derivative = self.proportional * derivative
        notches = (
            (self.notch_frequency_1, self.notch_width_1, self.notch_depth_1),
            (self.notch_frequency_2, self.notch_width_2, self.notch_depth_2),
        )
        order = self.low_pass_order
        return ServoLoop(
            SlewLimit(self.slew_rate, self.dt),
            in_series(),
            in_series(
                *(self._notch(*notch) for notch in notches),
                LowPass(self.low_pass, self.dt, order) if order else None,
            ),
            self.proportional,
            integral,
            derivative,
            self.lower,
            self.upper,
            self.dt,
            self.feedforward,
            anti_windup=self.anti_windup,
        )

    def _notch(self, frequency: Scalar, width: Scalar, depth: Scalar) -> Notch:
        # A notch that is off passes its input at any frequency. At one above half the
        # rate its poles, which the output hides, could be unstable.
        valid = jnp.minimum(frequency, 0.25 / self.dt)
        frequency = jnp.where(depth < 1.0, frequency, valid)
        return Notch(frequency, 0.5 * width / frequency, depth, self.dt)
