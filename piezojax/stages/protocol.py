"""Protocol of a stage with its controller, and the errors of a run."""

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from ..identification import Record

Gains = Mapping[str, float]
"""Parameters of a controller by path, such as ``feedback.law.integral``."""


class StageError(Exception):
    """A stage did not do what it was asked to do."""


class StoppedError(StageError):
    """A run was stopped, by the guard of the stage or by ``safe``.

    ``reason`` says why; ``reference``, ``measured`` (um) and ``voltage`` (V) are the
    samples until then.
    """

    def __init__(
        self,
        reason: str,
        reference: Float[np.ndarray, " samples"],
        measured: Float[np.ndarray, " samples"],
        voltage: Float[np.ndarray, " samples"],
    ):
        super().__init__(f"the run was stopped: {reason}")
        self.reason = reason
        self.reference, self.measured, self.voltage = reference, measured, voltage


class LostError(StageError):
    """The connection to a stage is lost; the stage has to make itself safe."""


@runtime_checkable
class Stage(Protocol):
    """A stage that runs a controller, with gains that can be set.

    The stage watches itself during a run: it has limits of its own, and moves to a safe
    voltage with safe gains if it is stopped or loses its connection. ``dt`` is its
    sample time in s.
    """

    dt: float

    def run(self, reference: Float[np.ndarray, " samples"], gains: Gains) -> Record:
        """Apply ``gains``, move to the start of ``reference`` (um), and follow it.

        The record holds the voltage, the reading and the reference. Raises
        StoppedError if the run is stopped, LostError without a connection, and
        ValueError for gains that the controller does not have.
        """
        ...

    def apply(self, gains: Gains) -> None:
        """Set ``gains`` and hold the position. Raises as ``run`` does."""
        ...

    def gains(self) -> dict[str, float]:
        """Return the gains that are set."""
        ...

    def safe(self) -> None:
        """Stop a run under way, set the safe gains and move to the safe voltage.

        May be called from another thread. Raises LostError without a connection.
        """
        ...


@runtime_checkable
class ConnectedStage(Stage, Protocol):
    """A stage at the end of a connection."""

    def close(self) -> None:
        """End the connection with a goodbye: the stage keeps its gains."""
        ...

    def abandon(self) -> None:
        """End the connection after a failure: the stage becomes safe."""
        ...
