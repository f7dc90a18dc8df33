"""A charge amplifier in place of a voltage amplifier (section 2.5.1)."""

from typing import NamedTuple

import equinox as eqx

from ._types import Scalar, ScalarLike, State, as_array, check
from .system import System, holding_input, rest_output


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
