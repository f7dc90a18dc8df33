"""Files of measured frequency responses: a table, or a MATLAB file."""

import io
import json
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ...core.files import write_bytes, write_text
from .columns import decoded
from .response import FrequencyResponse

PROPERTIES = "Properties"
"""Variable of a MATLAB file with the properties of a response."""


class _Stated(BaseModel):
    """Properties of a response in a file of piezojax, as JSON.

    They are the first line of a table, or the text ``Properties`` of a MATLAB file.
    """

    model_config = ConfigDict(extra="forbid")

    freedom: float | None = Field(default=None, gt=0.0)
    realisations: int = Field(default=1, ge=1)
    amplitude: float | None = Field(default=None, ge=0.0)
    resolution: float = Field(default=0.0, ge=0.0)
    held: float | None = Field(default=None, gt=0.0)

    @classmethod
    def of(cls, response: FrequencyResponse) -> str:
        """Return the properties of ``response`` as JSON."""
        known = {name: getattr(response, name) for name in cls.model_fields}
        if not np.isfinite(response.freedom):
            del known["freedom"]
        return json.dumps(cls(**known).model_dump(exclude_none=True))


def stated_in(path: Path) -> dict[str, object]:
    """Return the properties in a table or MATLAB file of piezojax.

    Raises ValueError, naming the property, for one that is not understood.
    """
    match path.suffix.lower():
        case ".csv":
            text = decoded(path.read_bytes()).partition("\n")[0].removeprefix("# ")
        case ".mat":
            text = _text_in(path)
        case _:
            text = ""
    if not text.startswith("{"):
        return {}
    try:
        stated = _Stated.model_validate_json(text)
    except ValidationError as error:
        problem = error.errors()[0]
        key = ".".join(map(str, problem["loc"])) or "first line"
        raise ValueError(f"{path}: {key}: {problem['msg']}") from None
    return stated.model_dump(exclude_none=True)


def _text_in(path: Path) -> str:
    """Return the text ``Properties`` of a MATLAB file, "" if it has none."""
    from scipy.io import loadmat
    from scipy.io.matlab import matfile_version

    if matfile_version(path)[0] == 2:  # version 7.3, which piezojax does not write
        return ""
    found = np.ravel(loadmat(path, variable_names=[PROPERTIES]).get(PROPERTIES, ""))
    return str(found[0]) if found.size == 1 else ""


def save_response(response: FrequencyResponse, path: str | Path) -> None:
    """Write ``response`` to ``path``, a table (.csv) or a MATLAB file (.mat).

    ``read_response`` reads both. The table has the complex values, magnitude and phase,
    and the standard deviations of the error, of the noise and of the nonlinear
    distortion, as far as they are known; its first line holds the other properties. The
    MATLAB file has the variables ``ResponseData`` [1, 1, lines], ``Frequency`` and
    ``FrequencyUnit``, for ``frd(ResponseData, Frequency, 'FrequencyUnit', 'Hz')``, the
    ``ResponseUnit``, the columns ``deviation``, ``noise_deviation`` and ``coherence``
    as far as they are known, and the other ``Properties`` as JSON. Raises ValueError
    for another suffix.
    """
    path = Path(path)
    match path.suffix.lower():
        case ".csv":
            write_text(path, _as_table(response))
        case ".mat":
            write_bytes(path, _as_mat(response))
        case _:
            raise ValueError(f"{path}: the name must end in .csv or .mat")


def _as_table(response: FrequencyResponse) -> str:
    values, unit = response.values, response.unit
    columns = {
        "frequency_Hz": response.frequency,
        f"real [{unit}]": np.real(values),
        f"imag [{unit}]": np.imag(values),
        f"magnitude [{unit}]": np.abs(values),
        "phase_deg": np.degrees(np.unwrap(np.angle(values))),
    }
    if response.variance is not None:
        columns[f"deviation [{unit}]"] = np.sqrt(response.variance)
    if response.noise is not None:
        columns[f"noise_deviation [{unit}]"] = np.sqrt(response.noise)
    if response.distortion is not None:
        deviation = np.sqrt(response.distortion.clip(0.0))
        columns[f"distortion_deviation [{unit}]"] = deviation
    if response.coherence is not None:
        columns["coherence"] = response.coherence
    text = io.StringIO()
    text.write(f"# {_Stated.of(response)}\n")
    head, table = ",".join(columns), np.column_stack([*columns.values()])
    np.savetxt(text, table, "%.10g", ",", header=head, comments="")
    return text.getvalue()


def _as_mat(response: FrequencyResponse) -> bytes:
    from scipy.io import savemat

    found = {
        "ResponseData": response.values[None, None],
        "Frequency": response.frequency[:, None],
        "FrequencyUnit": "Hz",
        "ResponseUnit": response.unit,
        PROPERTIES: _Stated.of(response),
    }
    if response.variance is not None:
        found["deviation"] = np.sqrt(response.variance)[:, None]
    if response.noise is not None:
        found["noise_deviation"] = np.sqrt(response.noise)[:, None]
    if response.coherence is not None:
        found["coherence"] = response.coherence[:, None]
    content = io.BytesIO()
    savemat(content, found)
    return content.getvalue()
