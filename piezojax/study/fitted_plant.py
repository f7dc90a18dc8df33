"""Plant of a study, fitted to the records or the response that the study names."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

from ..core.about import About
from ..core.arrays import as_array
from ..core.axes import Packed
from ..core.progress import Progress
from ..core.system import System, accepts, rest_output
from ..identification import (
    Fit,
    Record,
    identify,
    identify_all,
    read_record,
    validate,
)
from ..identification.records.formats import read_columns
from ..identification.records.recognise import recognised
from ..identification.records.response_file import read_response
from ..identification.response_model import ResponseModel, identify_response
from .origin import check_rate, in_study_units, response_in_study_units
from .plant_tables import ALL, RecordPlant, ResponsePlant
from .schema import Study
from .tables import validated


def fitted_plant(
    table: Mapping[str, Any], study: Study, folder: Path, progress: Progress
) -> tuple[Fit, About, Sequence[str]]:
    """Return the fit of the plant ``table``, its origin, and the notes of its check.

    The records lie in ``folder``. Raises ValueError, naming the key, for a record that
    cannot be read, has another rate or unit than the study, or cannot be fitted.
    """
    description = validated(RecordPlant, table, "plant")

    def read_as(path: Path, where: str, columns: dict[str, Any]) -> Record:
        record = read_record(folder / path, **columns)
        check_rate(1.0 / record.dt, study, where)
        return in_study_units(record, study, where)

    columns, notes = description.columns, []
    records = [read_as(path, "plant.record", columns) for path in description.record]
    others = []
    for path in description.check:
        own = _own_columns(folder / path, columns)
        others.append(read_as(path, "plant.check", own or columns))
        if own:
            taken = ", ".join(f"{role} {own[role]!r}" for role in _ROLES)
            notes.append(f"plant.check: {path.name} has other columns; taken: {taken}")
    train, validate_on, test = (
        None if span is None else slice(*span)
        for span in (description.train, description.validate_on, description.test)
    )
    if description.model == ALL:
        ranking = identify_all(
            records,
            hysteresis=description.among,
            train=train,
            validate=validate_on,
            test=test,
            options=description.options,
            progress=progress,
        )
        fit = ranking.best
    else:
        fit = identify(
            records,
            description.model,
            method=description.method,
            train=train,
            validate=validate_on,
            options=description.options,
            progress=progress,
        )
    if not others:
        return fit, fit.about, ()
    found = validate(fit.system, fit.about, others)
    return fit, found.about, [*notes, *found.report.notes]


_ROLES = "time", "input", "output"


def _own_columns(path: Path, columns: dict[str, Any]) -> dict[str, Any] | None:
    """Return the columns that are recognised in the file at ``path``.

    None if the file has all that are named in ``columns``.
    """
    named = [columns[role] for role in _ROLES if isinstance(columns[role], str)]
    if not named or set(named) <= set(read_columns(path)):
        return None
    return recognised(path, columns | dict.fromkeys(_ROLES))


def on_axes(system: System, study: Study) -> System:
    """Return ``system`` with one scalar per axis, if its signals are vectors.

    A fit to records of several channels has vectors.
    """
    if study.axes is None:
        return system
    zero = (as_array(0.0),) * study.axis_count
    vector = as_array(np.zeros(study.axis_count))
    if not accepts(system, vector):
        return system
    output = eqx.filter_eval_shape(rest_output, system, vector)
    if getattr(output, "shape", None) != vector.shape:
        return system
    wrapped = Packed(system)
    return wrapped if accepts(wrapped, zero) else system


def plant_of_response(
    table: Mapping[str, Any], study: Study, folder: Path
) -> ResponseModel:
    """Return the model of the frequency response of the plant ``table``, in um/V.

    Raises ValueError, starting with ``plant``, for a stage with several axes and a
    response that cannot be read, converted or fitted.
    """
    description = validated(ResponsePlant, table, "plant")
    if study.axes is not None:
        raise ValueError(
            f"plant.response: a response is for one axis; the study has "
            f"{study.axis_count}"
        )
    try:
        measured = read_response(folder / description.response, unit=description.unit)
        measured = response_in_study_units(measured)
        return identify_response(measured, study.rate, held=description.held)
    except ValueError as error:
        raise ValueError(f"plant.response: {error}") from None
