"""Hardware between a controller and its stage: limits, converters, sensor, drive."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from .core.arrays import Scalar, ScalarLike, State, as_array, check_order
from .core.feedback import holding_input
from .core.parameter import parameter, sample_time
from .core.system import System, rest_output


class Saturation(System):
    """Saturation of a signal to ``[lower, upper]``.

    Raises ValueError unless ``lower`` is below ``upper``.
    """

    lower: Scalar = parameter("V", "lower limit of the voltage")
    upper: Scalar = parameter("V", "upper limit of the voltage")

    def __check_init__(self):
        check_order("lower", self.lower, "upper", self.upper)

    def init(self, input: ScalarLike = 0.0) -> State:
        return ()

    def step(self, state: State, input: ScalarLike) -> tuple[State, Scalar]:
        return state, jnp.clip(input, self.lower, self.upper)


class SlewLimit(System):
    """Limit on the rate at which the output follows the input."""

    rate: Scalar = parameter("V/s", "slew rate", above=0.0, scale="log")
    dt: float = sample_time()

    def init(self, input: ScalarLike = 0.0) -> State:
        return as_array(input)

    def step(self, state: State, input: ScalarLike) -> tuple[State, Scalar]:
        most = self.rate * self.dt
        output = state + jnp.clip(input - state, -most, most)
        return output, output


class Quantiser(System):
    """Rounding to whole multiples of ``resolution``, the step of a DAC or ADC.

    The gradient is that of the identity, so that a loop with converters can be tuned.
    """

    resolution: Scalar = parameter(
        "[input]", "step of the converter", above=0.0, scale="log"
    )

    def init(self, input: ScalarLike = 0.0) -> State:
        return ()

    def step(self, state: State, input: ScalarLike) -> tuple[State, Scalar]:
        input = as_array(input)
        rounded = self.resolution * jnp.round(input / self.resolution)
        return state, input + jax.lax.stop_gradient(rounded - input)


class Sensor(System):
    """Sensor that adds noise to the displacement.

    The input is ``(displacement, draw)``, in um and a random draw of unit variance. The
    output is the measurement ``displacement + noise_rms * draw`` in um. A Quantiser
    after it models the converter.
    """

    noise_rms: Scalar = parameter("um", "rms noise of the sensor", least=0.0)

    def init(self, input: Any = (0.0, 0.0)) -> State:
        return ()

    def step(self, state: State, input: Any) -> tuple[State, Scalar]:
        displacement, draw = input
        return state, displacement + self.noise_rms * draw


class SensorResponse(System):
    """Dynamics of a sensor, which act on the displacement and not on the noise draw.

    Input and output are ``(displacement, draw)``, the input of the Sensor behind it.
    ``dynamics`` maps um to um, such as a low-pass or a delay.
    """

    dynamics: System

    def init(self, input: Any = (0.0, 0.0)) -> State:
        return self.dynamics.init(input[0])

    def step(self, state: State, input: Any) -> tuple[State, tuple[Any, Any]]:
        displacement, draw = input
        state, displacement = self.dynamics.step(state, displacement)
        return state, (displacement, draw)


class ChargeDriveState(NamedTuple):
    """Last command, load voltage and q / C_L, all in V; state of the load."""

    command: Scalar
    voltage: Scalar
    charge: Scalar
    load: State


class ChargeDrive(System):
    """Charge amplifier with grounded load, from a command v to a voltage u.

    The network C_s, R_s of the amplifier and the load C_L, R_L carry the same current:

    ``C_s dv/dt + v / R_s = dq/dt + u / R_L``

    where q is the charge of the load and u its voltage. For a linear load u = q/C_L
    this is (2.12) with leakage, ``q / v = C_s (s + 1/(C_s R_s)) / (s + 1/(C_L R_L))``:
    at frequencies above 1 / (C_L R_L) the charge follows the command, and below it the
    voltage does.

    ``load`` is a System from q / C_L in V to u in V; a linear load is ``Affine()``. In
    a piezo the hysteresis lies between voltage and charge, and the displacement is
    proportional to the charge: ``Affine(K) >> InverseColemanHodgdon(model)``, K in
    um/V, is the load of a stage with that hysteresis. Here the inverse describes the
    material, not a compensation. The leakage is integrated by Euler's rule, with an
    error of order dt / load_time.

    In a loop the static gain, gain * load_time / source_time, should be 1; otherwise
    the loop starts with a jump. Put a ``Saturation`` before it to limit the command.
    """

    load: System
    gain: Scalar = parameter("1", "capacitance ratio C_s / C_L", above=0.0, scale="log")
    source_time: Scalar = parameter(
        "s", "time constant C_s R_s of the source", above=0.0, scale="log"
    )
    load_time: Scalar = parameter(
        "s", "time constant C_L R_L of the load", above=0.0, scale="log"
    )
    dt: float = sample_time()

    def init(self, input: ScalarLike = 0.0) -> ChargeDriveState:
        command = as_array(input)
        wanted = self.gain * self.load_time / self.source_time * command
        charge = holding_input(self.load, wanted)
        voltage = rest_output(self.load, charge)
        return ChargeDriveState(command, voltage, charge, self.load.init(charge))

    def step(
        self, state: ChargeDriveState, input: ScalarLike
    ) -> tuple[ChargeDriveState, Scalar]:
        command = as_array(input)
        leakage = (
            self.gain * state.command / self.source_time
            - state.voltage / self.load_time
        )
        charge = (
            state.charge + self.gain * (command - state.command) + self.dt * leakage
        )
        load, voltage = self.load.step(state.load, charge)
        return ChargeDriveState(command, voltage, charge, load), voltage
