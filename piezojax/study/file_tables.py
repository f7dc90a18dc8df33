"""Tables of a study that name files with signals."""

import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from ..signals import waveforms
from .tables import ByAxis, Finite, NotNegative, Positive, Table, example, in_unit

NAME = re.compile(r"[A-Za-z_][\w-]*")
"""Pattern of the name of a trajectory; files are named after it."""

ColumnKey = str | Annotated[int, Field(ge=0, strict=True)]


class SignalFile(Table):
    """Columns of a file in one of the formats of records."""

    file: Path
    """File, relative to the study."""
    column: ColumnKey | None = None
    """Column, a name or a number from zero; needed if the file has several columns
    besides ``time``, on a stage with one axis."""
    axes: dict[str, ColumnKey] = Field(default_factory=dict)
    """Column of each axis, by the name of the axis, on a stage with several axes."""
    time: ColumnKey | None = None
    """Column of the time, unless ``rate`` or the file gives the sample time."""
    rate: Annotated[Positive | None, in_unit("Hz")] = None
    """Sampling rate, if no column gives the time."""
    unit: str | None = None
    """Unit of columns whose unit is given neither by the file nor by their name."""
    scale: Finite = 1.0
    """Factor of the values, not 0."""


class NoiseFile(SignalFile):
    """Measured noise or vibration in a file."""

    model_config = example({"file": "noise.csv", "time": "time_s", "column": "z_nm"})

    play: Literal["spectrum", "record"] = "spectrum"
    """``spectrum`` draws random noise with the spectrum of the record; ``record`` plays
    sections of the record itself, of its first half in tuning and of its second half in
    the hold-out."""
    frequency: Annotated[ColumnKey | None, in_unit("Hz")] = None
    """Column of the frequency: the file is then a one-sided spectrum, and ``unit`` that
    of a density such as um/sqrt(Hz) or um^2/Hz."""

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
    """Trajectory in a file, as a reference."""

    model_config = example(
        {"file": "trajectory.csv", "time": "time_s", "column": "z_um", "start": 2.0}
    )

    start: Annotated[NotNegative, in_unit("s")] = 0.0
    """Time in the file at which the reference begins, from the beginning of the
    file."""
    offset: Annotated[ByAxis[Finite], in_unit("um or urad")] = 0.0
    """Value added to the trajectory."""
    then: Literal["hold", "repeat"] | None = None
    """Continuation of a file that ends before the reference: ``hold`` keeps its last
    value, ``repeat`` begins again at ``start``. Without this key such a file is an
    error."""

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
