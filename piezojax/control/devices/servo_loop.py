"""Servo loop of a digital piezo controller: the order of blocks that devices share."""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ...core.arrays import Scalar, State, as_array, check_option
from ...core.feedback import Observation
from ...core.limited import Limited
from ...core.parameter import parameter, rounded_fields, sample_time
from ...core.system import Affine, Designed, Series, System

FIXED_DT = 5e-5
"""Sample time of devices with a fixed rate, s."""

NO_SLEW = 1e9
"""Slew rate (um/s) that no setpoint reaches."""

NO_END = 1e9
"""Limit (V) that no integral reaches."""

INTEGRATIONS = ("rectangular", "trapezoidal")
ANTI_WINDUPS = ("none", "hold")


class Device(Designed):
    """Digital controller of a vendor, with parameters as users type them in.

    Simulation uses the values as the device rounds them; gradients ignore the rounding,
    so that a device can be tuned.
    """

    dt: eqx.AbstractVar[float]

    def typed(self) -> "Device":
        """Return the device with its parameters rounded as they are typed in."""
        return rounded_fields(self)

    @property
    def cautions(self) -> tuple[str, ...]:
        """Problems to solve before the gains are typed in, each with a next step."""
        return ()

    def resolved(self) -> System:
        """Return the loop of the rounded parameters."""
        return self.typed().loop()

    @abc.abstractmethod
    def loop(self) -> System:
        """Return the loop of the parameters, without rounding them."""


class ServoLoopState(NamedTuple):
    """States of the filters, the integral (V), the last error (um), the last reference
    (um) and its velocity (um/s)."""

    setpoint: State
    position: State
    output: State
    integral: Scalar
    error: Scalar
    reference: Scalar
    velocity: Scalar


class ServoLoop(Limited):
    """PID with filters of setpoint, measurement and output, feedforward, saturation.

    In a sample, with reference r and measurement z::

        s = setpoint(r);  e = s - position(z)
        u = output(P e + I sum(e) dt + D (e - e1)/dt + Fx s + Fv dr/dt + Fa d2r/dt2)

    with the previous error e1; u is clipped to ``lower`` and ``upper``. ``integration``
    is "rectangular" (backward) or "trapezoidal". The integral includes the voltage at
    rest and stays between ``least_integral`` and ``most_integral``. ``anti_windup``
    "hold" is conditional integration: the integral holds its value while it would drive
    a saturated output further. With "none" it winds up. Each filter has unit DC gain.
    Input an Observation, output in V. Raises ValueError for an unknown option.
    """

    setpoint: System
    position: System
    output: System
    proportional: Scalar = parameter("V/um", "proportional gain P")
    integral: Scalar = parameter("V/(um s)", "integral gain I")
    derivative: Scalar = parameter("V s/um", "derivative gain D")
    lower: Scalar = parameter("V", "lower limit of the output")
    upper: Scalar = parameter("V", "upper limit of the output")
    dt: float = sample_time()
    position_feedforward: Scalar = parameter("V/um", "feedforward Fx", default=0.0)
    velocity_feedforward: Scalar = parameter("V s/um", "feedforward Fv", default=0.0)
    acceleration_feedforward: Scalar = parameter(
        "V s^2/um", "feedforward Fa", default=0.0
    )
    least_integral: Scalar = parameter(
        "V", "lower end of the integral", default=-NO_END
    )
    most_integral: Scalar = parameter("V", "upper end of the integral", default=NO_END)
    integration: str = eqx.field(static=True, default="rectangular")
    anti_windup: str = eqx.field(static=True, default="none")

    def __check_init__(self):
        check_option("integration", self.integration, INTEGRATIONS)
        check_option("anti_windup", self.anti_windup, ANTI_WINDUPS)

    @property
    def ends(self) -> tuple[Scalar, Scalar]:
        return self.lower, self.upper

    def init(self, input: Observation) -> ServoLoopState:
        reference = as_array(input.reference)
        setpoint = self.setpoint.init(reference)
        position = self.position.init(input.measured)
        wanted = self.setpoint.step(setpoint, reference)[1]
        error = wanted - self.position.step(position, input.measured)[1]
        direct = self.proportional * error + self.position_feedforward * wanted
        return ServoLoopState(
            setpoint,
            position,
            self.output.init(input.applied),
            input.applied - direct,
            error,
            reference,
            jnp.zeros_like(reference),
        )

    def step(
        self, state: ServoLoopState, input: Observation
    ) -> tuple[ServoLoopState, Scalar]:
        velocity = (input.reference - state.reference) / self.dt
        acceleration = (velocity - state.velocity) / self.dt
        setpoint, wanted = self.setpoint.step(state.setpoint, input.reference)
        position, found = self.position.step(state.position, input.measured)
        error = wanted - found
        mean = 0.5 * (error + state.error)
        area = self.dt * (mean if self.integration == "trapezoidal" else error)
        change = self.integral * area
        sum = (
            self.proportional * error
            + self.derivative * (error - state.error) / self.dt
            + self.position_feedforward * wanted
            + self.velocity_feedforward * velocity
            + self.acceleration_feedforward * acceleration
        )
        ends = self.least_integral, self.most_integral
        held = jnp.clip(state.integral + change, *ends)
        output, command = self.output.step(state.output, sum + held)
        kept = held - state.integral
        if self.anti_windup == "hold":
            outward = ((command > self.upper) & (change > 0.0)) | (
                (command < self.lower) & (change < 0.0)
            )
            kept = jnp.where(outward, 0.0, kept)
        return ServoLoopState(
            setpoint,
            position,
            output,
            state.integral + kept,
            error,
            as_array(input.reference),
            velocity,
        ), jnp.clip(command, self.lower, self.upper)


def in_series(*filters: System | None) -> System:
    """Return the filters that are not None in series, the identity if all are None."""
    parts = tuple(filter for filter in filters if filter is not None)
    return parts[0] if len(parts) == 1 else Series(parts) if parts else Affine()


def inverse_or_off(time: Scalar) -> Scalar:
    """Return 1 / ``time``, or 0 if ``time`` is 0, which switches the integral off."""
    runs = time > 0.0
    return jnp.where(runs, 1.0 / jnp.where(runs, time, 1.0), 0.0)


def require_rate(device: "Device") -> None:
    """Raise ValueError unless a device runs at its fixed rate of 20 kHz."""
    if abs(device.dt / FIXED_DT - 1.0) > 1e-9:
        raise ValueError(
            f"dt is {device.dt:g} s; {type(device).__name__} runs at 20 kHz, with dt = "
            f"{FIXED_DT:g} s: set 'rate' of the study to 20000"
        )
