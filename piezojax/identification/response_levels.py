"""Change of the modes of a stage with the amplitude of its input."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel

from .estimators.modal_model import ModalFit, ModalValue, error_bound
from .residuals.bound import joined
from .response_model import ResponseModel

SAME_MODE = 0.1
"""Largest relative difference of the frequencies of one mode at two amplitudes."""

CERTAIN = 3.0
"""Least change, in standard errors, that counts as certain."""


class LevelValue(BaseModel):
    """A value at one level, and its standard error, in the parameter's own unit."""

    value: float
    standard_error: float


class LevelChange(BaseModel):
    """A parameter at every level, and its change from the first to the last.

    ``change_percent`` is relative to the first level; ``certain`` tells whether it is
    CERTAIN standard errors or more.
    """

    parameter: str
    unit: str
    levels: list[LevelValue]
    change_percent: float
    standard_error_percent: float
    certain: bool


class LevelsReport(BaseModel):
    """Modes at several amplitudes of the input, the content of ``amplitudes.json``.

    ``levels`` are the sources and ``amplitudes`` their rms amplitudes, None if they are
    not known; ``chosen`` is the index of the level whose model has the smallest worst
    error over all levels.
    """

    levels: list[str]
    amplitudes: list[float] | None
    input_unit: str
    chosen: int
    changes: list[LevelChange]
    notes: list[str]


@dataclass(frozen=True)
class ResponseLevels:
    """Models of one stage at several amplitudes, and the chosen one.

    ``chosen`` carries a bound on its error at all amplitudes.
    """

    models: tuple[ResponseModel, ...]
    chosen: ResponseModel
    report: LevelsReport


def compare_levels(models: Sequence[ResponseModel]) -> ResponseLevels:
    """Return the change of the modes over ``models``, from the first to the last.

    If all amplitudes are known, the models are sorted by amplitude first.
    Raises ValueError for fewer than two models, or models of different rate or unit.
    """
    kinds = {(one.about.rate_Hz, one.response.unit) for one in models}
    if len(models) < 2 or len(kinds) > 1:
        raise ValueError(
            "the responses at several amplitudes must be two or more of one unit and "
            f"rate; there are {len(models)}, in {sorted(kinds, key=str)}"
        )
    known = [one.response.amplitude for one in models]
    amplitudes = None
    if all(amplitude is not None for amplitude in known):
        models = sorted(models, key=lambda one: one.response.amplitude or 0.0)
        amplitudes = [one.response.amplitude or 0.0 for one in models]
    errors = [
        max(
            float(
                np.median(
                    np.abs(
                        other.response.values
                        / one.fit.response_at(other.response.frequency)
                        - 1.0
                    )
                )
            )
            for other in models
        )
        for one in models
    ]
    place = int(np.argmin(errors))
    best = models[place]
    dt = 1.0 / (best.about.rate_Hz or 1.0)
    bound = joined(
        [
            error_bound(best.fit, other.response, other.fit.deviation, dt)
            for other in models
        ]
    )
    about = best.about.model_copy(update={"error_bound": bound})
    chosen = ResponseModel(best.system, best.report, best.response, best.fit, about)
    changes, notes = _changes(models)
    report = LevelsReport(
        levels=[one.response.source for one in models],
        amplitudes=amplitudes,
        input_unit=best.response.unit.partition("/")[2].strip(),
        chosen=place,
        changes=changes,
        notes=notes,
    )
    return ResponseLevels(tuple(models), chosen, report)


def _changes(models: Sequence[ResponseModel]) -> tuple[list[LevelChange], list[str]]:
    fits = [one.fit for one in models]
    unit, first = models[0].response.unit, fits[0]
    changes = [_change("gain", unit, [fit.static_gain for fit in fits])]
    notes = []
    for mode in first.frequency:
        places = [_place(fit, mode.value) for fit in fits]
        name = f"mode at {mode.value:.4g} Hz"
        if None in places:
            notes.append(f"the {name} is not found at every amplitude")
            continue
        rows = [(fit, place) for fit, place in zip(fits, places, strict=True)]
        for what, its_unit, values in (
            ("frequency", "Hz", [fit.frequency[j or 0] for fit, j in rows]),
            ("damping", "1", [fit.damping[j or 0] for fit, j in rows]),
            ("gain", unit, [fit.gain[j or 0] for fit, j in rows]),
        ):
            if what != "gain" or len(first.gain) > 1:
                changes.append(_change(f"{what}, {name}", its_unit, values))
    extra = {len(fit.frequency) for fit in fits}
    if len(extra) > 1:
        counts = ", ".join(str(len(fit.frequency)) for fit in fits)
        notes.append(f"the number of modes found differs: {counts}")
    return changes, notes


def _place(fit: ModalFit, frequency: float) -> int | None:
    """Return the index of the mode of ``fit`` near ``frequency`` (Hz), or None."""
    distances = [abs(one.value / frequency - 1.0) for one in fit.frequency]
    place = int(np.argmin(distances))
    return place if distances[place] < SAME_MODE else None


def _change(parameter: str, unit: str, values: Sequence[ModalValue]) -> LevelChange:
    first, last = values[0], values[-1]
    change = last.value / first.value - 1.0
    error = math.hypot(
        last.error / first.value, first.error * last.value / first.value**2
    )
    return LevelChange(
        parameter=parameter,
        unit=unit,
        levels=[LevelValue(value=v, standard_error=e) for v, e in values],
        change_percent=100.0 * change,
        standard_error_percent=100.0 * error,
        certain=abs(change) > CERTAIN * error,
    )
