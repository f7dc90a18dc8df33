"""Files of measured frequency responses: a table, or a MATLAB file."""

import io
import json
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ...core.files import write_bytes, write_text
from .columns import decoded
from .response import FrequencyResponse


class _Stated(BaseModel):
    """Properties of a response in the first line of a file of piezojax."""

    model_config = ConfigDict(extra="forbid")

    freedom: float | None = Field(default=None, gt=0.0)
    realisations: int = Field(default=1, ge=1)
    amplitude: float | None = Field(default=None, ge=0.0)
    resolution: float = Field(default=0.0, ge=0.0)
    held: float | None = Field(default=None, gt=0.0)


def stated_in(path: Path) -> dict[str, object]:
    """Return the properties in the first line of a text file of piezojax.

    Raises ValueError, naming the property, for one that is not understood.
    """
    if path.suffix.lower() != ".csv":
        return {}
    first = decoded(path.read_bytes()).partition("\n")[0]
    if not first.startswith("# {"):
        return {}
    try:
        stated = _Stated.model_validate_json(first[2:])
    except ValidationError as error:
        problem = error.errors()[0]
        key = ".".join(map(str, problem["loc"])) or "first line"
        raise ValueError(f"{path}: {key}: {problem['msg']}") from None
    return stated.model_dump(exclude_none=True)


def save_response(response: FrequencyResponse, path: str | Path) -> None:
    """Write ``response`` to ``path``, a table (.csv) or a MATLAB file (.mat).

    ``read_response`` reads both. The table has the complex values, magnitude and phase,
    and the standard deviations of the error, of the noise and of the nonlinear
    distortion, as far as they are known; its first line holds the other properties. The
    MATLAB file has the variables ``ResponseData`` [1, 1, lines], ``Frequency`` and
    ``FrequencyUnit``, for ``frd(ResponseData, Frequency, 'FrequencyUnit', 'Hz')``, and
    ``deviation``. Raises ValueError for another suffix.
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
    freedom = response.freedom if np.isfinite(response.freedom) else None
    stated = _Stated(
        freedom=freedom,
        realisations=response.realisations,
        amplitude=response.amplitude,
        resolution=response.resolution,
        held=response.held,
    )
    text = io.StringIO()
    text.write(f"# {json.dumps(stated.model_dump(exclude_none=True))}\n")
    head, table = ",".join(columns), np.column_stack([*columns.values()])
    np.savetxt(text, table, "%.10g", ",", header=head, comments="")
    return text.getvalue()


def _as_mat(response: FrequencyResponse) -> bytes:
    from scipy.io import savemat

    found = {
        "ResponseData": response.values[None, None],
        "Frequency": response.frequency[:, None],
        "FrequencyUnit": "Hz",
    }
    if response.variance is not None:
        found["deviation"] = np.sqrt(response.variance)[:, None]
    content = io.BytesIO()
    savemat(content, found)
    return content.getvalue()
