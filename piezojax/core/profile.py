"""Wall time of a command by stage: importing, tracing, compiling, drawing and so on."""

import builtins
import functools
import importlib
import os
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

IMPORT, DRAWING, RUNNING = "import", "drawing", "running and other"
TRACING, LOWERING, COMPILING = "tracing", "lowering", "compiling"
READING, COMPILING_C = "reading programs", "compiling C"

PROGRAMS: tuple[str, ...] = (TRACING, LOWERING, COMPILING, READING, COMPILING_C)
"""Stages of programs, which are counted."""

STAGES: tuple[str, ...] = (IMPORT, *PROGRAMS, DRAWING, RUNNING)
"""All stages; the last is the time that is left."""

# Of nested stages the inner one counts: a traced function imports, or starts the
# compilation of another one, and drawing computes what it shows.
_INNER_FIRST: tuple[str, ...] = (IMPORT, *reversed(PROGRAMS), DRAWING)

_EVENTS = {
    "/jax/core/compile/jaxpr_trace_duration": TRACING,
    "/jax/core/compile/jaxpr_to_mlir_module_duration": LOWERING,
    "/jax/core/compile/backend_compile_duration": COMPILING,
}
_RETRIEVED = "/jax/compilation_cache/cache_retrieval_time_sec"

_BRIEF = 1e-4  # s; a shorter import found its module loaded


class Interval(NamedTuple):
    """Time from ``begin`` to ``end`` (s) in a stage of the main or another thread."""

    stage: str
    main: bool
    begin: float
    end: float


class Profile(NamedTuple):
    """Time (s) of each of ``STAGES``, and number of programs of each of ``PROGRAMS``.

    The sum of the times is the time of the command.
    """

    seconds: dict[str, float]
    programs: dict[str, int]


_intervals: list[Interval] | None = None


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Count the time inside as the stage ``name`` of ``STAGES``, if it is measured."""
    begin = time.perf_counter()
    try:
        yield
    finally:
        _add(name, begin)


def _add(name: str, begin: float) -> None:
    if _intervals is not None:
        main = threading.current_thread() is threading.main_thread()
        _intervals.append(Interval(name, main, begin, time.perf_counter()))


def split(intervals: Iterable[Interval], begin: float, end: float) -> dict[str, float]:
    """Return the time (s) of each of ``STAGES`` between ``begin`` and ``end``.

    A moment counts once: for the innermost stage of the main thread or, if that is in
    none, of the other threads.
    """
    order = [(main, name) for main in (True, False) for name in _INNER_FIRST]
    edges: list[tuple[float, int, bool, str]] = [(end, 0, True, RUNNING)]
    for name, main, *ends in intervals:
        first, last = (min(max(each, begin), end) for each in ends)
        edges += [(first, 1, main, name), (last, -1, main, name)]
    seconds, active = dict.fromkeys(STAGES, 0.0), Counter()
    for now, change, *place in sorted(edges):
        counted = next((key for key in order if active[key]), (True, RUNNING))
        seconds[counted[1]] += now - begin
        active[tuple(place)] += change
        begin = now
    return seconds


@contextmanager
def profiled(report: Callable[[Profile], None]) -> Iterator[None]:
    """Measure the stages inside; call ``report`` at the end, also after an error.

    If the process is a command, the time since its start counts as import.
    """
    global _intervals
    intervals = _intervals = []
    begin = time.perf_counter() - _age()
    _add(IMPORT, begin)
    whole, named = builtins.__import__, importlib.import_module
    builtins.__import__, importlib.import_module = _timed(whole), _timed(named)
    try:
        from jax import monitoring

        listener = _listener()
        monitoring.register_event_duration_secs_listener(listener)
        try:
            yield
        finally:
            monitoring.unregister_event_duration_listener(listener)
    finally:
        builtins.__import__, importlib.import_module = whole, named
        _intervals = None
        seconds = split(intervals, begin, time.perf_counter())
        numbers = Counter(each.stage for each in intervals)
        report(Profile(seconds, {each: numbers[each] for each in PROGRAMS}))


def _timed(load: Callable) -> Callable:
    """Return ``load``, a function that imports, with its time counted."""

    @functools.wraps(load)
    def timed(*arguments, **named):
        begin = time.perf_counter()
        try:
            return load(*arguments, **named)
        finally:
            if time.perf_counter() - begin > _BRIEF:
                _add(IMPORT, begin)

    return timed


def _listener() -> Callable:
    """Return a listener for the durations that JAX reports, each at its end."""
    thread = threading.local()

    def listen(event: str, duration: float, **_) -> None:
        name = _EVENTS.get(event)
        if event == _RETRIEVED:  # followed by the event of a compilation
            thread.retrieved = True
        elif name == COMPILING and thread.__dict__.pop("retrieved", False):
            name = READING
        if name is not None:
            _add(name, time.perf_counter() - duration)

    return listen


def _age() -> float:
    """Return the time since this process started, s; 0 if it is not a command.

    Without ``/proc``, return its processor time, which excludes waiting.
    """
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    if spec is None or not spec.name.startswith("piezojax."):
        return 0.0
    try:
        stat = Path("/proc/self/stat").read_text(encoding="utf-8")
    except OSError:
        return time.process_time()
    # The name of the program, in brackets, may contain blanks.
    started = int(stat.rpartition(")")[2].split()[19]) / os.sysconf("SC_CLK_TCK")
    return time.clock_gettime(time.CLOCK_BOOTTIME) - started
