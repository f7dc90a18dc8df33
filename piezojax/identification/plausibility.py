"""Checks that the columns of a record are the input and output of a piezo stage."""

from collections.abc import Iterator

import numpy as np

from .estimators.loop_response import joint_response
from .estimators.projection import excited_part
from .estimators.resonances import samples_early
from .estimators.welch import spectral_response
from .records.record import Record, rises_evenly

FOLLOWS = 0.5
"""Least share of the output's power that the input explains."""

CLEAR = 0.9
"""Least coherence of a line whose phase is used."""

AHEAD = 0.02
"""Least lead of the output (rad, mean weighted by power) that raises a warning."""

GAIN = (1e-3, 100.0)
"""Usual gains of piezo stages, um/V."""

MOST = {"V": 1500.0, "um": 5000.0}
"""Largest usual range of a piezo stage's input and output."""

IN_UM = {"nm": 1e-3, "um": 1.0, "mm": 1e3, "m": 1e6}


def plausibility_warnings(record: Record) -> list[str]:
    """Return warnings about columns and units that are probably wrong.

    Records of several inputs or outputs are checked for a time axis only.
    """
    clocks = [*_clocks(record)]
    if clocks or not record.single:
        return clocks
    return [*_relation(record), *_units(record)]


def early_warnings(record: Record, train: slice) -> list[str]:
    """Return a warning if the output answers the input sooner than in a loop.

    Only a record of one input and one output in an open loop is checked. ``train`` are
    the samples of the fit.
    """
    if record.closed_loop or not record.single:
        return []
    seen = record.until(train.stop)
    early = samples_early(seen.input, seen.output, record.dt)
    if not early:
        return []
    return [
        f"the output answers the input {early:.2g} samples sooner than a loop can read "
        "it: it was saved too early, or the input too late, so the loop has more delay "
        "than the model; in each row save the output that is read when the input of "
        "this row is put out"
    ]


def assumed_units(record: Record) -> list[str]:
    """Return a note for each column whose unit is not stated anywhere."""
    units = dict(zip(record.input_names, record.input_units, strict=False))
    units |= dict(zip(record.output_names, record.output_units, strict=False))
    bare = list(record.assumed)
    if record.clock:
        units[record.clock] = "s"
        bare.append(record.clock)
    return [
        f"the unit of column {name!r} is not stated; {units[name]} is assumed: name "
        f"the column with its unit, as {name}_{units[name]}"
        for name in bare
    ]


def _clocks(record: Record) -> Iterator[str]:
    for side, columns in (("input", record.inputs), ("output", record.outputs)):
        for column in columns.T:
            if rises_evenly(column):
                yield (
                    f"the {side} column looks like a time axis: it rises steadily from "
                    f"{column[0]:.4g} to {column[-1]:.4g}; name the column of the "
                    f"{side} (--{side})"
                )


def _relation(record: Record) -> Iterator[str]:
    # In a closed loop only the response to its excitation is that of the stage.
    moved = excited_part(record)
    try:
        found = spectral_response(moved.input, moved.output, record.dt)
    except ValueError:
        return
    explained = found.power * np.abs(found.response) ** 2
    total = explained / np.maximum(found.coherence, np.finfo(float).tiny)
    share = float(np.sum(explained) / max(np.sum(total), np.finfo(float).tiny))
    correlation = float(np.corrcoef(moved.input, moved.output)[0, 1])
    if share < FOLLOWS:
        yield (
            f"the output does not follow the input: it explains {100.0 * share:.0f} % "
            f"of the output's power (correlation {correlation:.2f}); is a column "
            "wrong? Name them with --input and --output"
        )
        return
    if record.excitation.size:
        found = joint_response(
            record.input, record.output, record.excitation, record.dt
        )
        explained = found.power * np.abs(found.response) ** 2
    clear = (found.coherence > CLEAR) & (found.power > 1e-2 * found.power.max())
    if not clear.any():
        return
    response, power = found.response[clear], explained[clear]
    sign = np.sign(response[0].real)
    # Beyond 90 degrees a lag cannot be distinguished from a lead.
    slow = np.logical_and.accumulate(sign * np.real(response) > 0.0)
    response, power = response[slow], power[slow]
    if sign < 0.0 and correlation < 0.0:
        yield (
            f"input and output move in opposite directions (correlation "
            f"{correlation:.2f}): check the sign of the sensor and the columns; a "
            "controller of the usual sign is unstable on this model"
        )
    lead = np.sum(power * np.sin(np.angle(sign * response))) / np.sum(power)
    if lead > AHEAD:
        yield (
            f"the output runs ahead of the input by {np.degrees(np.arcsin(lead)):.1f} "
            "degrees, but a stage can only lag: are the columns swapped? Name them "
            "with --input and --output"
        )


def _units(record: Record) -> Iterator[str]:
    if record.input_unit != "V" or record.output_unit not in IN_UM:
        return
    moved = record.span * IN_UM[record.output_unit]
    drive = float(np.ptp(record.input))
    for name, range_, unit in (("input", drive, "V"), ("output", moved, "um")):
        if range_ > MOST[unit]:
            yield (
                f"the {name} spans {range_:.4g} {unit}, more than any piezo stage: "
                "check the unit of its column"
            )
            return
    if not GAIN[0] < moved / drive < GAIN[1]:
        yield (
            f"the output moves {moved / drive:.3g} um/V; piezo stages move {GAIN[0]:g} "
            f"to {GAIN[1]:g} um/V: check the units of the columns"
        )
