"""Check of the references of a study against the stroke of its stage."""

import numpy as np

from ..analysis.stroke import stroke_of
from ..core.limited import Limited
from ..core.system import resolve
from ..study import Case
from .data import Data

SLACK = 0.02
"""Share of the stroke by which a reference may exceed it: the displacement at a voltage
limit varies slightly with noise, drift and history."""


def require_reach(case: Case, data: Data) -> None:
    """Raise ValueError if a reference leaves the stroke of the stage by over ``SLACK``.

    The stroke is that between the limits of the actuator, or those of a device that
    limits its own voltage further. The message names the reference, its range, the
    stroke and the remedy.
    """
    study, table = case.study, case.study.references
    lower, upper = map(study.by_axis, (study.actuator.lower, study.actuator.upper))
    controller, limiting = resolve(case.loop.controller), "actuator"
    if isinstance(controller, Limited):
        ends = [float(end) for end in controller.ends]
        if ends[0] > lower[0] or ends[1] < upper[0]:
            limiting = "controller"
        lower, upper = (max(lower[0], ends[0]),), (min(upper[0], ends[1]),)
    stage = case.loop.actuator >> case.loop.plant
    found = stroke_of(stage, lower, upper)
    names = study.axes.names if study.axes else ("",)
    units = study.axes.units if study.axes else ("um",)
    references = np.asarray(data.holdout.references)
    references = references.reshape(*references.shape[:2], -1)  # [runs, samples, axes]
    amplitudes, offsets = study.by_axis(table.amplitude), study.by_axis(table.offset)
    for axis, (name, unit) in enumerate(zip(names, units, strict=True)):
        lowest, highest = found.lowest[axis], found.highest[axis]
        slack = SLACK * (highest - lowest)
        bottoms, tops = (f(references[..., axis], axis=1) for f in (np.min, np.max))
        beyond = np.flatnonzero((bottoms < lowest - slack) | (tops > highest + slack))
        if not beyond.size:
            continue
        run = beyond[0]
        part = "tune" if run < len(table.tune) else "unseen"
        where = f"axis {name}" if name else "the stage"
        signal = (*table.tune, *table.unseen)[run]
        remedy = (
            f"change scale or offset under references.files.{signal}"
            if signal in table.files
            else f"reduce references.amplitude, now {amplitudes[axis]:g}, or "
            f"change references.offset, now {offsets[axis]:g}"
        )
        if case.plant_about.record is not None:
            remedy += ". The stroke is that of the model: if the stage has another, "
            remedy += (
                f"the columns of {case.plant_about.record} are in another unit, or the "
                "record is of another stage"
                if case.response is None
                else "the response was measured with small motions, whose gain is less "
                "than that of large ones: fit a slow record with these dynamics held"
            )
        raise ValueError(
            f"references.{part}: {signal} spans "
            f"{bottoms[run]:.4g} to {tops[run]:.4g} {unit}, beyond the stroke of "
            f"{where}, {lowest:.4g} to {highest:.4g} {unit} between the limits of the "
            f"{limiting}: {remedy}"
        )
