"""What is judged: each reference, on a stage with several axes each axis under it."""

from typing import NamedTuple

from ..study import Study


class Trace(NamedTuple):
    """Axis ``axis`` while reference ``run`` is followed.

    ``driven`` axes should move, the others should rest: their error is coupling.
    ``name`` is the reference's, with the axis in brackets unless it alone is driven.
    """

    run: int
    axis: int
    driven: bool
    name: str
    unit: str


def traces_of(study: Study) -> tuple[Trace, ...]:
    """Return the traces of a study, those of the tuning references first."""
    runs = (*study.references.tune, *study.references.unseen)
    if study.axes is None:
        return tuple(Trace(i, 0, True, name, "um") for i, name in enumerate(runs))
    found = []
    for i, run in enumerate(runs):
        driven = study.driven(run)
        for axis, (name, unit) in enumerate(
            zip(study.axes.names, study.axes.units, strict=True)
        ):
            alone = list(driven) == [name]
            shown = run if alone else f"{run} ({name})"
            found.append(Trace(i, axis, name in driven, shown, unit))
    return tuple(found)
