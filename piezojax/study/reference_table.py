"""Table of a study with the references of its runs."""

from typing import Annotated

from pydantic import Field, field_validator, model_validator

from .file_tables import TrajectoryTable, check_trajectory_name
from .tables import (
    ByAxis,
    Finite,
    NotNegative,
    Positive,
    Table,
    example,
    in_unit,
    once,
)


class References(Table):
    """References of the runs, by the names of their signals or trajectories."""

    model_config = example(
        {
            "tune": ["SIN10", "SW50"],
            "unseen": ["SIN20"],
            "amplitude": 5.0,
            "duration": 0.5,
            "settle": 0.25,
        }
    )

    tune: tuple[str, ...] = Field(min_length=1)
    """References of the objective: signals such as ``SIN10``, or names of ``files``. On
    several axes the driven axes precede the signal, as in ``x:SIN10``."""
    unseen: tuple[str, ...] = ()
    """Other references, used only to evaluate the tuned gains."""
    amplitude: Annotated[ByAxis[Positive], in_unit("um or urad")] = 5.0
    """Amplitude of the signals."""
    offset: Annotated[ByAxis[Finite], in_unit("um or urad")] = 0.0
    """Offset of the signals."""
    duration: Annotated[Positive, in_unit("s")] = 1.0
    """Duration of each run, at least 2 samples."""
    settle: Annotated[NotNegative, in_unit("s")] = 0.5
    """Time after which errors count, below ``duration``."""
    files: dict[str, TrajectoryTable] = Field(default_factory=dict)
    """Trajectories in files, by name; they have an offset of their own and no
    amplitude."""

    _once = field_validator("tune", "unseen")(once)

    @model_validator(mode="after")
    def _consistent(self) -> "References":
        if self.settle >= self.duration:
            raise ValueError(
                f"settle is {self.settle:g} s; it must be below the duration, "
                f"{self.duration:g} s"
            )
        for name in self.unseen:
            if name in self.tune:
                raise ValueError(f"{name} is in both tune and unseen")
        for name in self.files:
            check_trajectory_name(name)
            if name not in (*self.tune, *self.unseen):
                raise ValueError(f"files.{name} is in neither tune nor unseen")
        return self
