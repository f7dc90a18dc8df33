"""Guard: limits the command of a controller and overrides it after a fault."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Int

from ..core.arrays import Scalar, State, as_array, check_order
from ..core.feedback import Observation
from ..core.limited import Limited
from ..core.parameter import parameter, sample_time
from ..core.system import System

REASONS = (
    "",
    "the reading is not a number",
    "the reading does not follow the voltage: the sensor is stuck",
    "the command is not a number",
    "the tracking error is too large",
    "the voltage stays at a limit",
    "the voltage changes at the slew limit: it oscillates, or the reference jumps",
)
"""Reasons for which a Guard gives up, by number; 0 while it follows its controller."""

_NAN, _STUCK, _LOST, _FAR, _RAILED, _SLEWING = range(1, len(REASONS))


class GuardState(NamedTuple):
    """State of the controller, last signals, and counts of faulty samples.

    ``reason`` is the index of the reason in ``REASONS``. ``command`` (V) and
    ``measured`` (um) are the last ones. ``far``, ``railed`` and ``slewing`` count
    consecutive samples with too large an error, at a limit of the voltage, and at the
    slew limit; ``unseen`` is the travel of the voltage (V) since the reading last
    changed.
    """

    controller: State
    reason: Int[Array, ""]
    command: Scalar
    measured: Scalar
    far: Int[Array, ""]
    railed: Int[Array, ""]
    slewing: Int[Array, ""]
    unseen: Scalar


class Guard(Limited):
    """A ``controller`` with a limited command, which retreats at the first fault.

    The command stays between ``lower`` and ``upper`` and changes by at most ``slew``.
    The guard gives up in each of these cases:

    - the reading or the command of the controller is not finite;
    - the tracking error exceeds ``largest_error``, or the command of the controller is
      at a limit of the voltage or of the slew, for ``patience`` samples in a row;
    - the voltage travels more than ``unseen`` while the reading does not change at all.

    From then on the command moves to ``retreat`` at no more than ``slew``, until the
    guard is started again. The controller receives the last finite reading in place of
    one that is not; at the start, the reference. For one axis. The input is an
    Observation, the output the command.

    Raises ValueError unless ``lower`` is below ``upper`` and ``retreat`` between them.
    """

    controller: System
    lower: Scalar = parameter("V", "lower limit of the command")
    upper: Scalar = parameter("V", "upper limit of the command")
    slew: Scalar = parameter("V/s", "slew limit of the command", above=0.0, scale="log")
    largest_error: Scalar = parameter(
        "um", "tracking error at which the guard gives up", above=0.0, scale="log"
    )
    retreat: Scalar = parameter("V", "voltage after a fault")
    patience: int = parameter(
        "samples",
        "number of samples in a row with a fault",
        least=1.0,
        whole=True,
        static=True,
    )
    unseen: Scalar = parameter(
        "V", "travel of the voltage without a change of the reading", above=0.0
    )
    dt: float = sample_time()

    def __check_init__(self):
        check_order("lower", self.lower, "upper", self.upper)
        check_order("lower", self.lower, "retreat", self.retreat, equal=True)
        check_order("retreat", self.retreat, "upper", self.upper, equal=True)

    @property
    def ends(self) -> tuple[Scalar, Scalar]:
        return self.lower, self.upper

    def init(self, input: Observation) -> GuardState:
        none = jnp.zeros((), jnp.int32)
        measured = as_array(input.measured)
        # The controller never sees a reading that is not a number.
        reading = jnp.where(jnp.isfinite(measured), measured, input.reference)
        return GuardState(
            self.controller.init(input._replace(measured=reading)),
            none,
            as_array(input.applied),
            reading,
            none,
            none,
            none,
            jnp.zeros(()),
        )

    def step(self, state: GuardState, input: Observation) -> tuple[GuardState, Scalar]:
        measured = as_array(input.measured)
        seen = jnp.isfinite(measured)
        reading = jnp.where(seen, measured, state.measured)
        controller, wanted = self.controller.step(
            state.controller, input._replace(measured=reading)
        )
        known = jnp.isfinite(wanted)
        outside = (wanted <= self.lower) | (wanted >= self.upper)
        railed = jnp.where(outside, state.railed + 1, 0)
        beyond = jnp.abs(input.reference - reading) > self.largest_error
        far = jnp.where(beyond, state.far + 1, 0)
        most = self.slew * self.dt
        fast = jnp.abs(wanted - state.command) > most
        slewing = jnp.where(fast, state.slewing + 1, 0)
        faults = (
            (_SLEWING, slewing >= self.patience),
            (_RAILED, railed >= self.patience),
            (_FAR, far >= self.patience),
            (_LOST, ~known),
            (_STUCK, state.unseen > self.unseen),
            (_NAN, ~seen),
        )
        found = jnp.zeros_like(state.reason)
        for number, fault in faults:
            found = jnp.where(fault, number, found)
        reason = jnp.where(state.reason > 0, state.reason, found)
        target = jnp.where(reason > 0, self.retreat, wanted)
        limited = state.command + jnp.clip(target - state.command, -most, most)
        command = jnp.clip(limited, self.lower, self.upper)
        travel = state.unseen + jnp.abs(command - state.command)
        unseen = jnp.where(reading == state.measured, travel, 0.0)
        return (
            GuardState(
                controller, reason, command, reading, far, railed, slewing, unseen
            ),
            command,
        )
