"""Check of the references of a study against the stroke of its stage."""

import numpy as np

from ..analysis.stroke import stroke_of
from ..study import Case
from .data import Data

SLACK = 0.02
"""Share of the stroke by which a reference may exceed it: the displacement at a voltage
limit varies slightly with noise, drift and history."""


def require_reach(case: Case, data: Data) -> None:
    """Raise ValueError if a reference leaves the stroke of the stage by over ``SLACK``.

    The message names the reference, its range, the stroke and the remedy.
    """
    study = case.study
    table, limits = study.references, study.actuator
    stage = case.loop.actuator >> case.loop.plant
    found = stroke_of(stage, study.by_axis(limits.lower), study.by_axis(limits.upper))
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
            f"actuator: {remedy}"
        )
