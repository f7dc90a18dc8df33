"""Tables of a plant that is fitted to records or to a frequency response."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import AliasChoices, Field, field_validator, model_validator

from ..identification import DEFAULT, METHODS, chain
from ..identification.estimators.estimate import Options
from .tables import Positive, Table, example, in_unit

ALL = "all"
"""Value of ``model`` that fits every model the records support."""

Column = str | int
Span = tuple[int, int]
Count = Annotated[int, Field(strict=True, ge=1)]


class ResponsePlant(Table):
    """A plant fitted to a frequency response, for the rate of the study."""

    model_config = example({"response": "sweep.csv", "unit": "nm/V"})

    response: Path
    """File with the frequency response, relative to the study."""
    held: bool = False
    """True if converters at the rate of the study held the input during the
    measurement; ignored if the file states how the response was measured."""
    unit: str = "um/V"
    """Unit of the response, output over input."""


class RecordPlant(Table):
    """A plant fitted to records, with the options of ``identify``.

    Columns are names or numbers from zero. A span of samples is a pair: the first
    sample and the sample after the last.
    """

    model_config = example(
        {
            "record": "record.csv",
            "model": "coleman_hodgdon+lag",
            "time": "time_s",
            "input": "input_V",
            "output": "displacement_um",
            "train": [0, 12000],
        }
    )

    record: tuple[Path, ...] = Field(
        min_length=1, validation_alias=AliasChoices("record", "records")
    )
    """File of a record, or several of one stage, relative to the study. The key may
    also be written ``records``."""
    model: str = DEFAULT
    """Model of ``identify``: a chain of parts joined by ``+``, or ``all`` for the best
    of all that the records support."""
    method: str | None = None
    """Method of the fit; without this key the first that can fit the model."""
    among: tuple[str, ...] | None = None
    """Hysteresis models to try, with the model ``all``."""
    time: Column | None = None
    """Column of the time."""
    input: Column | tuple[Column, ...] = 0
    """Column of the voltage, or a list for several axes."""
    output: Column | tuple[Column, ...] = 1
    """Column of the displacement, or a list for several axes."""
    record_rate: Annotated[Positive | None, in_unit("Hz")] = None
    """Sampling rate of the records, if no column gives the time."""
    resample: Annotated[Positive | None, in_unit("Hz")] = None
    """Rate to which the records are interpolated."""
    period: Annotated[
        Annotated[int, Field(strict=True, ge=2)] | None, in_unit("samples")
    ] = None
    """Period of a periodic input."""
    train: Annotated[Span | None, in_unit("samples")] = None
    """Span to fit; without this key the first half."""
    validate_on: Annotated[Span | None, in_unit("samples")] = Field(
        default=None, alias="validate"
    )
    """Span to validate the fit; without this key the rest."""
    test: Annotated[Span | None, in_unit("samples")] = None
    """Span for the error of the chosen model, with the model ``all``."""
    order: Count = Options.order
    """Number of states of a linear or neural model."""
    window: Annotated[Count, in_unit("samples")] = Options.window
    """Number of past and of future samples in the Hankel-Toeplitz regression."""
    oversample: Count = Options.oversample
    """Simulated samples per sample of a periodic record, for ``bouc_wen``."""
    steps: Count = Options.steps
    """Largest number of optimiser steps."""
    check: tuple[Path, ...] = ()
    """Another record of the stage, or several, on which the fitted plant is validated.
    If a column is missing there, all are recognised by their names and units."""

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
