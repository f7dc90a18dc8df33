"""Wall time of a piece of work, and the part of it spent compiling."""

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
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


class _Compiling:
    """Time during which programs compile, on one thread or on several."""

    def __init__(self):
        self._lock, self._active = threading.Lock(), 0
        self._total = self._since = 0.0

    @contextmanager
    def counted(self) -> Iterator[None]:
        """Count the time inside, once if other threads count it too."""
        with self._lock:
            if not self._active:
                self._since = time.perf_counter()
            self._active += 1
        try:
            yield
        finally:
            with self._lock:
                self._active -= 1
                if not self._active:
                    self._total += time.perf_counter() - self._since

    def seconds(self) -> float:
        """Return the time (s) counted so far."""
        with self._lock:
            more = time.perf_counter() - self._since if self._active else 0.0
            return self._total + more


_compiling = _Compiling()


class Clock:
    """Wall time since construction, and the part of it in which programs compiled.

    Those of all clocks count: one thread evaluates while another one searches.
    """

    def __init__(self):
        self._began = time.perf_counter()
        self._cpu = time.process_time()
        self._compiled = _compiling.seconds()

    def compiled(self, program: Any, *arguments: Any) -> Callable:
        """Return ``compiled(program, *arguments)``; the time counts as compiling."""
        with _compiling.counted():
            return compiled(program, *arguments)

    def wait_for(self, program: Future) -> None:
        """Wait for a program that compiles; the time counts as compiling."""
        with _compiling.counted():
            program.result()

    @property
    def compile_s(self) -> float:
        """Wall time (s) since the start in which at least one program compiled."""
        return _compiling.seconds() - self._compiled

    def cpu_s(self) -> float:
        """Return the processor time (s) of all threads since the start."""
        return time.process_time() - self._cpu

    def wall_s(self) -> float:
        """Return the wall time (s) since the start."""
        return time.perf_counter() - self._began
