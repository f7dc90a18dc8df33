"""Tables 5-3 and 5-5: three PID-based sliding mode controllers on ten references."""

import equinox as eqx
import jax

from ..catalog import p753
from ..core.feedback import loop_inputs
from ..core.metrics import Tracking
from ..core.rollout import simulate
from ..core.system import System
from ..signals import waveforms as signals
from .cell import Cell, printed, window

COLUMNS = {
    "pid_smc": p753.sliding_mode,
    "inversion": p753.inversion,
    "dob": p753.disturbance_observer,
}
"""Controllers of the columns, by their names in ``data/ch5.csv``."""

TABLES = {"5-3": "5-2", "5-5": "5-4"}
"""Table of the gains of each result table."""


@eqx.filter_jit
def _rms_error(controller: System, reference: jax.Array) -> jax.Array:
    loop = p753.loop(controller, noise_rms=0.0)
    metric = Tracking(start=reference.size // 2)
    inputs = loop_inputs(reference)
    return simulate(loop, inputs, loop.init(0.0), metric=metric)[1].rms_error


def cells(table: str) -> list[Cell]:
    """Return the 30 cells of ``table`` ("5-3" or "5-5"), simulated.

    One reading of the thesis applies to all cells; nothing is tuned. The gains are
    those printed. The stage has unit DC gain behind its hysteresis and no sensor noise,
    and starts from rest at zero. A cell is the RMS error of the true displacement over
    the second of two windows (see ``window``).
    """
    paper = printed("ch5", table)
    simulated = []
    for name in signals.THESIS:
        reference = signals.signal(
            name, signals.time_grid(2.0 * window(name), p753.RATE)
        )
        for column, make in COLUMNS.items():
            error = float(_rms_error(make(TABLES[table]), reference))
            simulated.append(paper[name, column].simulated(error))
    return simulated
