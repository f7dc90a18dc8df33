"""Model structures that can be fitted, with starts and bounds taken from the record."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .._types import as_array
from ..dynamics import FirstOrderLag
from ..hysteresis import ColemanHodgdon
from ..space import Space, space_of
from ..system import Affine, Series, series
from .record import Record

REST_INPUT = "hysteresis.rest_input"
"""Path of the input in force before the record: every structure here has it."""


class Structure(NamedTuple):
    """A model to fit: its System, the box of its parameters, starts in the box."""

    system: Series
    space: Space
    starts: np.ndarray


def coleman_hodgdon(record: Record) -> Structure:
    """Return Coleman-Hodgdon hysteresis, a first-order lag and an offset.

    The lag holds what trails the hysteresis (amplifier, sensor filter); at a single
    frequency it is told apart from the hysteresis only by the shape of the loop. The
    rest point before the first sample is fitted too, so a record that begins with a
    step of the voltage, or on its initial loading curve, is described from its start.
    """
    x, y, dt = record.input, record.output, record.dt
    width = float(np.ptp(x))
    slope = record.span / width
    centre = float(np.mean(y) - slope * np.mean(x))
    system = series(
        hysteresis=ColemanHodgdon(
            a=slope / width,
            b=0.7 * slope,
            c=-1.0 / width,
            rest_input=x[0],
            rest_output=y[0] - centre,
        ),
        lag=FirstOrderLag(dt, dt),
        calibration=Affine(1.0, centre),
    )
    reach = 2.0 * record.span
    rest = y[0] - centre
    space = space_of(
        {
            "hysteresis.a": (0.0, 20.0 * slope / width, "linear"),
            "hysteresis.b": (0.0, 3.0 * slope, "linear"),
            "hysteresis.c": (-20.0 / width, -0.01 / width, "linear"),
            REST_INPUT: (x.min() - 0.5 * width, x.max() + 0.5 * width, "linear"),
            "hysteresis.rest_output": (rest - reach, rest + reach, "linear"),
            "lag.time_constant": (0.05 * dt, 50.0 * dt, "log"),
            "calibration.offset": (centre - reach, centre + reach, "linear"),
        }
    )
    names = list(space.paths)
    middle = np.asarray(space.from_unit(space.start(system)))
    starts = []
    for steepness in (0.3, 1.0, 3.0, 8.0):
        for before in (x[0], x.min()):
            values = middle.copy()
            # Keep the slope -a/c of the loop's axis while its decay c changes.
            values[names.index("hysteresis.c")] = -steepness / width
            values[names.index("hysteresis.a")] = steepness * slope / width
            values[names.index(REST_INPUT)] = before
            starts.append(np.asarray(space.to_unit(as_array(values))))
    return Structure(system, space, np.stack(starts))


MODELS: dict[str, Callable[[Record], Structure]] = {
    "coleman_hodgdon": coleman_hodgdon,
}
"""Model structures by the name the command line and a study use."""
