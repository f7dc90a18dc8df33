"""Phase compensation of hysteresis: a positive phase ahead of the stage (2.13)."""

from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp

from ..core.arrays import Scalar, State, as_array
from ..core.feedback import Observation
from ..core.parameter import PartUnits, parameter
from ..core.system import System


class PhaseCompensatorState(NamedTuple):
    """State of the controller, and the phaser's last input and its stop, V."""

    controller: State
    input: Scalar
    stop: Scalar


class PhaseCompensator(System):
    """``controller`` with a nonlinear phaser behind it: u = v + share stop(v).

    Section 2.5.2 regards a hysteresis as a transfer function whose magnitude and phase
    depend on frequency and amplitude (2.13), and balances its lag by a phaser with a
    positive phase ahead of the stage. It does not specify the phaser. Here the phaser
    adds a stop operator, which follows the input and saturates at ``threshold``. Its
    phase is a lead that is the same at every frequency and falls with the amplitude.
    The gain lies between 1 and 1 + ``share``. Sums of stops are the inverse of a
    Prandtl-Ishlinskii model (``PrandtlIshlinskii.inverse``).

    ``controller`` sees the v that gives the applied voltage, so its limits and
    anti-windup stay correct. The stop starts at 0. Input an Observation, output in V.
    """

    part_units: ClassVar[PartUnits] = {"controller": {"u": "V"}}

    controller: System
    share: Scalar = parameter(
        "1", "weight of the stop operator", least=0.0, typical=(0.0, 0.5)
    )
    threshold: Scalar = parameter(
        "V",
        "voltage at which the stop saturates",
        above=0.0,
        scale="log",
        typical=(0.1, 1e2),
    )

    def _stop(self, state: PhaseCompensatorState, input: Scalar) -> Scalar:
        moved = state.stop + input - state.input
        return jnp.clip(moved, -self.threshold, self.threshold)

    def _applied(
        self, state: PhaseCompensatorState, voltage: Scalar
    ) -> PhaseCompensatorState:
        """Return the state in which the phaser has given ``voltage``."""
        free = voltage - self.share * (state.stop - state.input)
        inside = free / (1.0 + self.share)
        stop = self._stop(state, inside)
        return state._replace(input=voltage - self.share * stop, stop=stop)

    def init(self, input: Observation) -> PhaseCompensatorState:
        voltage = as_array(input.applied)
        controller = self.controller.init(input)
        return PhaseCompensatorState(controller, voltage, jnp.zeros_like(voltage))

    def step(
        self, state: PhaseCompensatorState, input: Observation
    ) -> tuple[PhaseCompensatorState, Any]:
        state = self._applied(state, input.applied)
        observation = input._replace(applied=state.input)
        controller, wanted = self.controller.step(state.controller, observation)
        voltage = wanted + self.share * self._stop(state, wanted)
        return state._replace(controller=controller), voltage
