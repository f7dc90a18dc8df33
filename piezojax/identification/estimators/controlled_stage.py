"""Closed loop of a stage and its controller, driven by reference and dither."""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ...core.arrays import Scalar, State, as_array
from ...core.feedback import Observation
from ...core.rollout import simulate
from ...core.system import System, at_rest, resolve
from ..records.record import Record
from .approach import input_before


class ControlledState(NamedTuple):
    """States of both parts, the last output (um) and the last command (V)."""

    controller: State
    plant: State
    measured: Scalar
    command: Scalar


class ControlledStage(System):
    """Closed loop of ``plant`` and ``controller``, without noise or limits.

    Input [3]: r(k) and r(k+1) (um), and the dither at k (V), which is added to the
    command; output y(k+1) (um). The loop begins with the command ``voltage`` (V), and
    the plant at rest under it or under the input before the record.
    """

    plant: System
    controller: System
    voltage: Scalar = eqx.field(converter=as_array)

    def init(self, input: Float[Array, " 3"]) -> ControlledState:  # pyright: ignore
        before = input_before(self.plant, self.voltage)
        plant, measured = at_rest(self.plant, before)
        seen = Observation(input[0], input[0], measured, self.voltage)
        controller = resolve(self.controller).init(seen)
        return ControlledState(controller, plant, measured, self.voltage)

    def step(self, state: ControlledState, input: Float[Array, " 3"]):
        seen = Observation(input[0], input[1], state.measured, state.command)
        controller, command = self.controller.step(state.controller, seen)
        plant, output = self.plant.step(state.plant, command + input[2])
        return ControlledState(controller, plant, output, command), output


def loop_drive(record: Record) -> np.ndarray:
    """Return the input [samples, 3] of a ControlledStage from ``record``.

    A reference that is not recorded is taken as constant, at the first output.
    """
    reference, dither = record.reference, record.dither
    if reference is None:
        reference = np.full(record.samples, record.output[0])
    if dither is None:
        dither = np.zeros(record.samples)
    return np.stack([reference, np.r_[reference[1:], reference[-1]], dither], axis=1)


def replayed(controller: System, record: Record) -> np.ndarray:
    """Return the command of ``controller`` plus the dither [samples], for a record.

    The controller receives the recorded reference and output, and its own last command
    as the applied voltage.
    """
    drive = loop_drive(record)
    inputs = np.column_stack([drive, record.output])
    return np.asarray(_replayed(controller, as_array(inputs), record.input[0]))


@eqx.filter_jit
def _replayed(controller: System, inputs: Array, voltage) -> Array:
    first = Observation(inputs[0, 0], inputs[0, 0], inputs[0, 3], as_array(voltage))
    start = controller.init(first), as_array(voltage)
    return simulate(_Replay(controller), inputs, start)[1]


class _Replay(System):
    """The controller, fed with recorded signals and its own last command."""

    controller: System

    def init(self, input=0.0):
        raise NotImplementedError("a replay starts from the first recorded sample")

    def step(self, state, input):
        inner, command = state
        seen = Observation(input[0], input[1], input[3], command)
        inner, command = self.controller.step(inner, seen)
        return (inner, command), command + input[2]
