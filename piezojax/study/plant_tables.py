"""Tables of a plant that is fitted to records or to a frequency response."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import AliasChoices, Field, field_validator, model_validator

from ..identification import DEFAULT, METHODS, chain
from ..identification.estimators.estimate import Options
from .tables import Positive, Table

ALL = "all"
"""Value of ``model`` that fits every model the records support."""

Column = str | int
Span = tuple[int, int]
Count = Annotated[int, Field(strict=True, ge=1)]


class ResponsePlant(Table):
    """A plant fitted to a frequency response, for the rate of the study.

    ``response`` is the file, ``unit`` that of the response, output over input. ``held``
    is true for a response measured through converters at the rate of the study.
    """

    response: Path
    held: bool = False
    unit: str = "um/V"


class RecordPlant(Table):
    """A plant fitted to records, with the options of ``identify``.

    ``record``, or ``records``, is a file or a list of files of one stage. ``time``,
    ``input`` and ``output`` are columns, by name or number; several inputs and outputs
    are lists. ``record_rate`` is the sampling rate of the records, Hz, ``resample`` the
    rate to which they are interpolated, and ``period`` the samples in a period of a
    periodic input. ``train``, ``validate`` and ``test`` are pairs: the first sample and
    the sample after the last. ``among`` and ``test`` need the model "all". ``order``,
    ``window``, ``oversample`` and ``steps`` are those of ``identify``. ``check`` are
    other records of the stage, with the same columns, on which the fitted plant is
    validated.
    """

    record: tuple[Path, ...] = Field(
        min_length=1, validation_alias=AliasChoices("record", "records")
    )
    model: str = DEFAULT
    method: str | None = None
    among: tuple[str, ...] | None = None
    time: Column | None = None
    input: Column | tuple[Column, ...] = 0
    output: Column | tuple[Column, ...] = 1
    record_rate: Positive | None = None
    resample: Positive | None = None
    period: Annotated[int, Field(strict=True, ge=2)] | None = None
    train: Span | None = None
    validate_on: Span | None = Field(default=None, alias="validate")
    test: Span | None = None
    order: Count = Options.order
    window: Count = Options.window
    oversample: Count = Options.oversample
    steps: Count = Options.steps
    check: tuple[Path, ...] = ()

    @field_validator("record", "check", mode="before")
    @classmethod
    def _listed(cls, given: Any) -> Any:
        return (given,) if isinstance(given, str) else given

    @field_validator("model")
    @classmethod
    def _known(cls, name: str) -> str:
        whole = {model for method in METHODS.values() for model in method.models}
        if name not in (DEFAULT, ALL, *whole):
            chain(name)
        return name

    @model_validator(mode="after")
    def _consistent(self) -> "RecordPlant":
        if self.model != ALL and (self.among is not None or self.test is not None):
            raise ValueError('among and test need model = "all"')
        if self.model == ALL and self.method is not None:
            raise ValueError(
                'method needs one model; model = "all" uses the default of each'
            )
        return self

    @property
    def columns(self) -> dict[str, Any]:
        """Options of ``read_record``."""
        return {
            "time": self.time,
            "input": self.input,
            "output": self.output,
            "rate": self.record_rate,
            "period": self.period,
            "resample": self.resample,
        }

    @property
    def options(self) -> Options:
        """Options of the method of the fit."""
        return Options(self.order, self.window, self.oversample, self.steps)
