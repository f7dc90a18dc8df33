"""Runs of a System with a metric, which an engine computes for many lanes at once."""

import os
from collections.abc import Callable
from typing import Any, get_args

import jax

from ..core.arrays import State
from ..core.rollout import SEGMENT, Metric
from ..core.system import System
from .forward import Engine, lanes
from .metered_run import separated
from .native_library import compiler
from .reverse import reversible

VARIABLE = "PIEZOJAX_ENGINE"
"""Environment variable that names the engine to use."""

reverse_mode = jax.make_user_context(default_value=False)
"""Context ``with reverse_mode(True):`` for runs differentiated in reverse mode.

In this context the engine ``native`` stores the carries that its reverse pass needs,
and has no derivatives in forward mode. Other engines use the loop of ``simulate``."""


def default_engine() -> Engine:
    """Return the engine of ``VARIABLE``, by default the fastest of this machine.

    Raises ValueError for an unknown engine.
    """
    if name := os.environ.get(VARIABLE):
        for engine in get_args(Engine):
            if name == engine:
                return engine
        known = ", ".join(get_args(Engine))
        raise ValueError(f"{VARIABLE} is {name!r}; it must be one of {known}")
    backend = jax.default_backend()
    if backend == "cpu" and compiler():
        return "native"
    return "gpu" if backend == "gpu" else "loop"


def metered(
    system: System,
    inputs: Any,
    state: State,
    metric: Metric | None = None,
    *,
    log: Callable[[Any], Any] | None = None,
    every: int = 1,
    engine: Engine | None = None,
) -> tuple[Any, Any]:
    """Return the result of ``metric`` over a run, and a log of the outputs.

    The run is that of ``simulate`` with the same arguments. The log holds ``log`` of
    the last output of each whole block of ``every`` samples, stacked in time. Without
    ``metric`` or ``log``, None is returned in its place.

    Under ``jax.vmap``, all lanes run in one kernel of ``engine``, by default
    ``default_engine()``. The engine ``native`` also has a kernel for derivatives, in
    reverse mode only inside the context ``reverse_mode``. The following run in the loop
    of ``simulate`` instead, with the same result:

    - a step without a scalar form (see ``trace``), with a loop inside that has no fixed
      number of repetitions, with too many operations, or with an operation that the
      engine lacks;
    - second derivatives, and derivatives with respect to inputs;
    - in reverse mode, a log with ``every`` above 1;
    - on a GPU, a log, derivatives, and inputs that differ between lanes.

    Raises ValueError as ``simulate`` does.
    """
    engine = engine or default_engine()
    if reverse_mode.value and engine != "native":
        engine = "loop"
    operands, run = separated(system, inputs, state, metric, log, every)
    if engine == "loop":
        return run.unpacked(*run.plain(SEGMENT, *operands))
    if reverse_mode.value:
        found: Any = reversible(run, operands)
    else:
        found = lanes(operands, run, engine)
    return run.unpacked(*found)


def run_outputs(system: System, inputs: Any, state: State) -> Any:
    """Return the outputs of a run, stacked in time, as ``simulate`` does."""
    return metered(system, inputs, state, log=lambda output: output)[1]
