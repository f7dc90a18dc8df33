"""How a search went: what it had found, when, and after how many evaluations."""

from collections.abc import Callable
from dataclasses import dataclass, field

import jax

from .clock import Clock


@dataclass
class Course:
    """The best loss after each batch of evaluations of one search.

    ``times_s`` are seconds since the search began, waiting for the compiler included;
    ``compile_s`` is how much of each went into that, ``cpu_s`` the processor's seconds
    till then, of all threads: what a busy machine does not lengthen. ``evaluations``
    counts simulations of all references, those that carry derivatives too.
    """

    clock: Clock = field(default_factory=Clock)
    times_s: list[float] = field(default_factory=list)
    compile_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)
    evaluations: list[int] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)

    def add(self, evaluations: int, loss: float) -> None:
        """Note ``evaluations`` more, the best of which has ``loss``."""
        before = self.evaluations[-1] if self.evaluations else 0
        self.times_s.append(self.clock.wall_s())
        self.compile_s.append(self.clock.compile_s)
        self.cpu_s.append(self.clock.cpu_s())
        self.evaluations.append(before + evaluations)
        self.losses.append(min(loss, self.loss))

    @property
    def loss(self) -> float:
        """The best loss so far."""
        return self.losses[-1] if self.losses else float("inf")

    def reached(self, loss: float) -> int | None:
        """Return the index of the first entry no worse than ``loss``; None if none."""
        return next((i for i, best in enumerate(self.losses) if best <= loss), None)


def batch_loss(objective, units: jax.Array, clock: Clock) -> Callable:
    """Return the losses of points in [0, 1]^n, compiled for so many at once."""
    program = clock.compiled(
        lambda objective, units: jax.vmap(lambda unit: objective.loss(unit))(units),
        objective,
        units,
    )
    return lambda units: program(objective, units)
