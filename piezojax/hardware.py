"""What lies between a controller and its stage: limits, converters, the sensor."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from .core.arrays import Scalar, ScalarLike, State, as_array, check, check_order
from .core.system import System, holding_input, rest_output


class Saturation(System):
    """Clips its input to ``[lower, upper]``, V."""

    lower: Scalar = eqx.field(converter=as_array)
    upper: Scalar = eqx.field(converter=as_array)

    def __check_init__(self):
        check_order("lower limit", self.lower, "upper limit", self.upper)

    def init(self, input: ScalarLike = 0.0) -> State:
        return ()

    def step(self, state: State, input: ScalarLike) -> tuple[State, Scalar]:
        return state, jnp.clip(input, self.lower, self.upper)


class SlewLimit(System):
    """Limits how fast its output follows its input.

    ``rate`` in V/s, ``dt`` in s. Raises ValueError unless both are positive.
    """

    rate: Scalar = eqx.field(converter=as_array)
    dt: float = eqx.field(static=True)

    def __check_init__(self):
        check("slew rate in V/s", self.rate, above=0.0)
        check("sample time in s", self.dt, above=0.0)

    def init(self, input: ScalarLike = 0.0) -> State:
        return as_array(input)

    def step(self, state: State, input: ScalarLike) -> tuple[State, Scalar]:
        most = self.rate * self.dt
        output = state + jnp.clip(input - state, -most, most)
        return output, output


class Quantiser(System):
    """Rounds its input to whole multiples of ``resolution`` (a DAC or ADC step).

    Its gradient is that of the identity, so that a loop with converters can still be
    tuned; the value is the rounded one.
    """

    resolution: Scalar = eqx.field(converter=as_array)

    def __check_init__(self):
        check("resolution", self.resolution, above=0.0)

    def init(self, input: ScalarLike = 0.0) -> State:
        return ()

    def step(self, state: State, input: ScalarLike) -> tuple[State, Scalar]:
        input = as_array(input)
        rounded = self.resolution * jnp.round(input / self.resolution)
        return state, input + jax.lax.stop_gradient(rounded - input)


class Sensor(System):
    """Adds noise to the displacement.

    Input ``(displacement, draw)`` in um and unit variance; output the measurement in
    um: displacement + ``noise_rms`` * draw. Follow it with a Quantiser for a converter.
    """

    noise_rms: Scalar = eqx.field(converter=as_array)

    def __check_init__(self):
        check("sensor noise in um rms", self.noise_rms, least=0.0)

    def init(self, input: Any = (0.0, 0.0)) -> State:
        return ()

    def step(self, state: State, input: Any) -> tuple[State, Scalar]:
        displacement, draw = input
        return state, displacement + self.noise_rms * draw


class ChargeDriveState(NamedTuple):
    """Last command, load voltage and charge over C_L, all in V; the load's state."""

    command: Scalar
    voltage: Scalar
    charge: Scalar
    load: State


class ChargeDrive(System):
    """A grounded-load charge amplifier: an actuator from a command v to a voltage.

    What the amplifier's network C_s, R_s takes up, the load C_L, R_L takes too:

    ``C_s dv/dt + v / R_s = dq/dt + u / R_L``

    with q the load's own charge and u the voltage across it. On a linear load u = q/C_L
    this is (2.12) with its leakage, ``q / v = C_s (s + 1/(C_s R_s)) / (s +
    1/(C_L R_L))``: charge is followed above 1 / (C_L R_L), voltage below.

    ``gain`` C_s / C_L without unit; ``source_time`` C_s R_s and ``load_time`` C_L R_L
    in s; ``load``, a System from q / C_L in V to u in V. A linear load is ``Affine()``.
    In a piezo the hysteresis lies between voltage and charge, and the displacement goes
    with the charge: ``Affine(K) >> InverseColemanHodgdon(model)``, K in um/V, is the
    load of a stage with that hysteresis, the inverse standing for the material and not
    for a compensation. ``dt`` in s; the leakage is summed by Euler's rule, whose error
    is of the order dt / load_time.

    As the actuator of a loop its static gain, gain * load_time / source_time, should be
    1, or the start is a jump. Limits of the command are a ``Saturation`` before it.
    Raises ValueError unless gain, both times and ``dt`` are positive.
    """

    gain: Scalar = eqx.field(converter=as_array)
    source_time: Scalar = eqx.field(converter=as_array)
    load_time: Scalar = eqx.field(converter=as_array)
    load: System
    dt: float = eqx.field(static=True)

    def __check_init__(self):
        check("gain C_s / C_L", self.gain, above=0.0)
        check("source time in s", self.source_time, above=0.0)
        check("load time in s", self.load_time, above=0.0)
        check("sample time in s", self.dt, above=0.0)

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
