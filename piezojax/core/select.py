"""Selection of one input from a tuple, for systems with a single input."""

from typing import Any

import equinox as eqx

from .arrays import State
from .system import System


class Select(System):
    """Selection of one element of a tuple: ``output = input[index]``.

    For a voltage and a temperature: ``(Select(0) >> stage) + (Select(1) >> drift)``.
    Raises ValueError for a negative or fractional ``index``.
    """

    index: int = eqx.field(static=True)

    def __check_init__(self):
        if not isinstance(self.index, int) or self.index < 0:
            raise ValueError(
                f"index is {self.index!r}; it must be whole and at least 0"
            )

    def init(self, input: Any = ()) -> State:
        return ()

    def step(self, state: State, input: Any) -> tuple[State, Any]:
        return state, input[self.index]
