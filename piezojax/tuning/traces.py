"""Traces of a study: pairs of a reference and an axis, with one error each."""

from typing import NamedTuple

from ..study import Study


class Trace(NamedTuple):
    """Trace of axis number ``axis`` under reference number ``run``.

    ``driven`` axes should move; the others should rest, and their error is coupling.
    ``name`` is that of the reference, followed by the axis in brackets unless that axis
    alone is driven. ``unit`` is that of the axis.
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
