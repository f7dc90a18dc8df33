"""Table ``[structures]`` of a study: the numbers of notches to compare."""

from typing import Annotated

from pydantic import Field, field_validator

from .tables import Table, example, once

MOST_NOTCHES = 4
"""Largest number of notches of a structure."""


class StructuresTable(Table):
    """Structures of the controller to compare; they differ in the number of notches."""

    model_config = example({"notches": [0, 1, 2], "behind": "controller.feedback"})

    notches: tuple[Annotated[int, Field(strict=True, ge=0, le=MOST_NOTCHES)], ...] = (
        Field(min_length=2)
    )
    """Numbers of notches to compare."""
    behind: str | None = None
    """Path of the part whose command the notches filter; by default the feedback of the
    controller, or the controller if it has no such part."""
    worth: Annotated[float, Field(gt=0.0, lt=1.0, strict=True)] = 0.1
    """Least relative decrease of the error on the hold-out for which a further notch is
    kept. The decrease must also exceed two standard errors."""

    @field_validator("notches")
    @classmethod
    def _distinct(cls, counts: tuple[int, ...]) -> tuple[int, ...]:
        return tuple(sorted(once(counts)))
