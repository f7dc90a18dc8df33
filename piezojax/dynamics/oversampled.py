"""System that runs at a multiple of the sample rate of its input."""

from typing import Any

from ..core.arrays import State
from ..core.parameter import parameter
from ..core.system import System


class Oversampled(System):
    """``system`` stepped ``samples`` times for each input; the output is the last one.

    It models a stage behind a converter that holds the voltage of a slower loop. Raises
    ValueError unless ``samples`` is a whole number from 1 to 64.
    """

    system: System
    samples: int = parameter(
        "1", "samples held", least=1.0, most=64.0, whole=True, static=True
    )

    def init(self, input: Any = 0.0) -> State:
        return self.system.init(input)

    def step(self, state: State, input: Any) -> tuple[State, Any]:
        state, output = self.system.step(state, input)
        for _ in range(self.samples - 1):
            state, output = self.system.step(state, input)
        return state, output
