"""Tables of a study that name files with signals."""

import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from ..signals import waveforms
from .tables import ByAxis, Finite, NotNegative, Positive, Table

NAME = re.compile(r"[A-Za-z_][\w-]*")
"""Pattern of the name of a trajectory; files are named after it."""

ColumnKey = str | Annotated[int, Field(ge=0, strict=True)]


class SignalFile(Table):
    """Columns of a file in one of the formats of records.

    ``column`` is a name or a number from zero; it may be left out if the file has one
    column besides ``time``. On a stage with several axes, ``axes`` gives the column of
    each axis instead. The sample time comes from the column ``time``, from ``rate``
    (Hz) or from the file. ``unit`` applies to columns whose unit is given neither by
    the file nor by their name. The values are multiplied by ``scale``.
    """

    file: Path
    column: ColumnKey | None = None
    axes: dict[str, ColumnKey] = Field(default_factory=dict)
    time: ColumnKey | None = None
    rate: Positive | None = None
    unit: str | None = None
    scale: Finite = 1.0


class NoiseFile(SignalFile):
    """Measured noise or vibration in a file.

    ``play`` "spectrum" draws random noise with the spectrum of the record; "record"
    plays stretches of the record itself, from its first half in tuning and from its
    second half in the hold-out. With ``frequency``, a column in Hz, the file holds a
    spectrum itself: ``unit`` is then that of a one-sided density, such as um/sqrt(Hz)
    or um^2/Hz.
    """

    play: Literal["spectrum", "record"] = "spectrum"
    frequency: ColumnKey | None = None

    @model_validator(mode="after")
    def _of_one_kind(self) -> "NoiseFile":
        if self.scale == 0.0:
            raise ValueError("scale is 0; there would be no noise")
        if self.frequency is not None and self.play == "record":
            raise ValueError(
                'play is "record", but a file with a frequency column is a spectrum'
            )
        return self


class TrajectoryTable(SignalFile):
    """Trajectory in a file, as a reference.

    The reference begins ``start`` s after the beginning of the file. ``offset`` is
    added to the values, in the unit of the axis. If the file ends before the reference,
    its last value is held (``then = "hold"``) or it begins again (``"repeat"``).
    """

    start: NotNegative = 0.0
    offset: ByAxis[Finite] = 0.0
    then: Literal["hold", "repeat"] | None = None

    @model_validator(mode="after")
    def _scaled(self) -> "TrajectoryTable":
        if self.scale == 0.0:
            raise ValueError("scale is 0; the reference would not move")
        return self


def check_trajectory_name(name: str) -> None:
    """Raise ValueError for a malformed name, or one that is the name of a signal."""
    if not NAME.fullmatch(name):
        raise ValueError(
            f"files.{name}: the name must begin with a letter or _ and contain only "
            "letters, digits, _ and -"
        )
    if re.sub(r"[0-9.]+$", "", name) in waveforms.SIGNALS:
        raise ValueError(
            f"files.{name}: {name} is the name of a signal; choose another"
        )
