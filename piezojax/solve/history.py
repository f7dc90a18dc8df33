"""Search history: best loss against time and evaluations."""

from collections.abc import Callable
from dataclasses import dataclass, field

import jax

from .clock import Clock


@dataclass
class History:
    """Best loss after each batch of evaluations of one search.

    ``times_s`` are seconds since the start of the search, including compilation;
    ``compile_s`` is the part spent compiling. ``cpu_s`` is the processor time of all
    threads, which does not depend on other work on the machine. ``evaluations`` counts
    all evaluations of the loss, with or without derivatives.
    """

    clock: Clock = field(default_factory=Clock)
    times_s: list[float] = field(default_factory=list)
    compile_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)
    evaluations: list[int] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)

    def add(self, evaluations: int, loss: float) -> None:
        """Append a batch of ``evaluations``, the best of which has ``loss``."""
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
        """Return the index of the first entry with at most ``loss``, or None."""
        return next((i for i, best in enumerate(self.losses) if best <= loss), None)


def batch_loss(problem, units: jax.Array, clock: Clock) -> Callable:
    """Return a function from points of the unit box to their losses.

    It is compiled for as many points as ``units`` has.
    """
    program = clock.compiled(_losses, problem, units)
    return lambda units: program(problem, units)


@jax.jit
def _losses(problem, units: jax.Array) -> jax.Array:
    return jax.vmap(lambda unit: problem.loss(unit))(units)
