"""Operating points around which loops are linearised."""

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from ...core.arrays import Signal, as_signal
from ...core.feedback import Feedback, LoopState
from ...dynamics.linearise import sample_time

BRANCHES = {"ascending": 1.0, "descending": -1.0}
"""Sign of the next change of the plant's input, by the name of the branch."""


@dataclass(frozen=True)
class OperatingPoint:
    """Operating point of a loop, and the branch of a hysteresis on which it moves.

    - ``reference``: um; with several axes a vector or a tuple, in the units of the
      axes;
    - ``branch``: "ascending" or "descending", the side on which the slope of a
      hysteresis is taken (see ``broken_loop``);
    - ``state``: state of the loop, such as the last one of a simulation; by default
      the loop rests at the reference, on the virgin curve of a hysteresis;
    - ``dt``: sample time in s; by default that of the loop.

    Raises ValueError for an unknown branch.
    """

    reference: Any = 0.0
    branch: str = "ascending"
    state: LoopState | None = None
    dt: float | None = None

    def __post_init__(self):
        if self.branch not in BRANCHES:
            raise ValueError(
                f"branch {self.branch!r}; it must be one of {list(BRANCHES)}"
            )

    @classmethod
    def at(cls, place: Any) -> "OperatingPoint":
        """Return ``place`` if it is an OperatingPoint, else one at this reference."""
        return place if isinstance(place, OperatingPoint) else cls(place)

    @property
    def signal(self) -> Signal:
        """The reference as an array, or as a tuple of arrays with several axes."""
        return as_signal(self.reference)

    @property
    def side(self) -> float:
        """+1 on the ascending branch, -1 on the descending one."""
        return BRANCHES[self.branch]

    def sample_time(self, loop: Feedback) -> float:
        """Return ``dt`` (s) if it is given, else the sample time of ``loop``.

        Raises ValueError as ``loop_sample_time`` does.
        """
        return loop_sample_time(loop) if self.dt is None else self.dt

    def check(self, start: LoopState) -> None:
        """Raise ValueError unless ``start`` is finite and rests at the reference.

        A state given by the user is not checked.
        """
        if self.state is not None:
            return
        wanted, reached, held = (
            np.ravel(np.asarray(jax.tree.leaves(signal), float))
            for signal in (self.signal, start.displacement, start.voltage)
        )
        far = np.abs(reached - wanted) > 1e-6 * (1.0 + np.abs(wanted))
        wrong = far | ~np.isfinite(reached) | ~np.isfinite(held)
        if not wrong.any():
            return
        shown = [
            ", ".join(f"{number:{form}}" for number in values)
            for values, form in ((wanted, "g"), (reached, ".6g"), (held, ".6g"))
        ]
        raise ValueError(
            f"the loop cannot rest at {shown[0]} um: within the actuator's limits "
            f"the stage rests at {shown[1]} um under {shown[2]} V; "
            "choose another reference"
        )


def loop_sample_time(loop: Feedback) -> float:
    """Return the controller's sample time (s), or that of the rest of the loop.

    The controller's comes first because a plant may run faster inside
    (``Oversampled``). Raises ValueError if no part has a sample time, or if several
    differ.
    """
    try:
        return sample_time(loop.controller)
    except ValueError:
        return sample_time(loop)
