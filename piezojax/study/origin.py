"""Units and sampling rate of the records and files that a study names."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from ..core.about import About
from ..core.conversion import factor
from ..identification import Record
from ..identification.records.response_file import FrequencyResponse
from .schema import Study


def in_study_units(record: Record, study: Study, where: str) -> Record:
    """Return ``record`` in V and the units of the axes; ``where`` is its key.

    Raises ValueError for a unit that cannot be converted.
    """
    units = study.axes.units if study.axes else ("um",)
    try:
        return record.in_units(("V",) * len(units), units)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def response_in_study_units(response: FrequencyResponse) -> FrequencyResponse:
    """Return ``response`` in um/V.

    Raises ValueError for a unit that is not a length over a voltage.
    """
    output, _, input = (part.strip() for part in response.unit.partition("/"))
    factors = factor(output, "um"), factor(input, "V")
    if None in factors:
        raise ValueError(
            f"its unit is {response.unit!r}; it must be a length over a voltage, such "
            "as um/V or nm/mV"
        )
    ratio = (factors[0] or 1.0) / (factors[1] or 1.0)
    return dataclasses.replace(response, values=ratio * response.values, unit="um/V")


def check_origin(about: About, study: Study, where: str) -> None:
    """Raise ValueError unless the file at the key ``where`` fits ``study``.

    Units and a sampling rate that ``about`` does not state are not checked.
    """
    for channel, wanted in _channels(study).items():
        unit = about.units.get(channel, wanted)
        if unit != wanted:
            raise ValueError(
                f"{where}: its {channel} is in {unit}, and the study needs {wanted}: "
                f"{_REMEDIES[where]}"
            )
    if about.rate_Hz is not None:
        check_rate(about.rate_Hz, study, where)


def check_rate(rate: float, study: Study, where: str) -> None:
    """Raise ValueError unless ``rate`` (Hz) at the key ``where`` is the study's."""
    if not np.isclose(rate, study.rate, rtol=1e-6, atol=0.0):
        raise ValueError(
            f"rate is {study.rate:g} Hz, but {where} was made for {rate:g} Hz"
        )


_REMEDIES = {
    "plant.file": "name its record in [plant], so that its units are converted, or "
    "fit it again in V and um",
    "controller.file": "tune it again in a study with these units",
}


def _channels(study: Study) -> Mapping[str, str]:
    """Return the units of ``study`` by the names of channels in the files."""
    if study.axes is None:
        return {"input": "V", "output": "um", "measured": "um", "command": "V"}
    outputs = {f"output {i}": unit for i, unit in enumerate(study.axes.units)}
    return outputs | dict(zip(study.axes.names, study.axes.units, strict=True))
