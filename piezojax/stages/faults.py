"""Faults of an emulated stage: a sensor that fails, a plant that changes."""

from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.arrays import Scalar, State, as_array
from ..core.system import System

SENSOR_FAULTS = ("dropout", "stuck")
"""Faults of the sensor: a reading that is not a number, or the last reading again."""


class Fault(NamedTuple):
    """Fault in a run.

    "dropout" and "stuck" are faults of the sensor from sample ``begin`` on, for
    ``samples``. "plant" replaces the plant for good by ``plant``, which has the same
    structure, at the start of the block of samples that contains ``begin``.
    """

    kind: Literal["dropout", "stuck", "plant"]
    begin: int
    samples: int = 1
    plant: System | None = None


class FailingSensor(System):
    """A ``sensor`` with the faults that its input prescribes.

    The input is ``(displacement, (draw, fault))``, with the noise ``draw`` of unit
    variance. ``fault`` is 0 without a fault, 1 for a reading that is not a number, and
    2 for the last reading again. The input ``(displacement, draw)`` has no fault.
    """

    sensor: System

    def init(self, input: Any) -> State:
        displacement, (draw, _) = _split(input)
        quiet = displacement, draw
        state = self.sensor.init(quiet)
        return state, self.sensor.step(state, quiet)[1]

    def step(self, state: State, input: Any) -> tuple[State, Scalar]:
        displacement, (draw, fault) = _split(input)
        inner, last = state
        inner, reading = self.sensor.step(inner, (displacement, draw))
        reading = jnp.where(fault == 2.0, last, reading)
        return (inner, reading), jnp.where(fault == 1.0, jnp.nan, reading)


def _split(input: Any) -> tuple[Any, tuple[Any, Any]]:
    displacement, noise = input
    return displacement, noise if isinstance(noise, tuple) else (noise, as_array(0.0))


def sensor_faults(faults: tuple[Fault, ...], samples: int) -> Float[np.ndarray, " n"]:
    """Return the number of the fault at each of ``samples``, as in FailingSensor."""
    found = np.zeros(samples)
    for fault in faults:
        if fault.kind in SENSOR_FAULTS:
            code = 1.0 + SENSOR_FAULTS.index(fault.kind)
            found[fault.begin : fault.begin + fault.samples] = code
    return found
