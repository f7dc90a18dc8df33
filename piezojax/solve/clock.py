"""Wall time of a piece of work, and the part of it spent compiling."""

import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import jax

_FEWER_PASSES = {"xla_backend_optimization_level": 1}
"""Options of the compiler on a CPU. They save a sixth to a fifth of its time, and the
programs of a search run as fast. (A loop of few states alone is up to a quarter
slower.)"""


def compiled(program: Any, *arguments: Any) -> Callable:
    """Compile ``program`` for ``arguments``, for a search.

    ``program`` is a function after ``jax.jit`` or ``eqx.filter_jit``. A function
    defined at module level is compiled once for each structure and shapes of arguments.
    """
    full = jax.default_backend() != "cpu" or jax.config.read(
        "jax_disable_most_optimizations"
    )
    options = None if full else _FEWER_PASSES
    return program.lower(*arguments).compile(compiler_options=options)


class Clock:
    """Wall time since construction; ``compile_s`` (s) is the part spent compiling."""

    def __init__(self):
        self._began = time.perf_counter()
        self._cpu = time.process_time()
        self.compile_s = 0.0

    def compiled(self, program: Any, *arguments: Any) -> Callable:
        """Return ``compiled(program, *arguments)``; add the time to ``compile_s``."""
        start = time.perf_counter()
        executable = compiled(program, *arguments)
        self.compile_s += time.perf_counter() - start
        return executable

    def wait_for(self, program: Future) -> None:
        """Wait for a program compiled by another thread; add to ``compile_s``."""
        start = time.perf_counter()
        program.result()
        self.compile_s += time.perf_counter() - start

    def cpu_s(self) -> float:
        """Return the processor time (s) of all threads since the start."""
        return time.process_time() - self._cpu

    def wall_s(self) -> float:
        """Return the wall time (s) since the start."""
        return time.perf_counter() - self._began
