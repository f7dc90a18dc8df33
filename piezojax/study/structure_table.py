"""Table ``[structures]`` of a study: the numbers of notches to compare."""

from typing import Annotated

from pydantic import Field, field_validator

from .tables import Table

MOST_NOTCHES = 4
"""Largest number of notches of a structure."""


class StructuresTable(Table):
    """Structures of the controller that are tuned alike: numbers of ``notches``.

    The notches filter the command of the part ``behind``, a path such as
    ``controller.feedback``. By default it is the feedback of the controller, or the
    controller if it has no such part. A notch is worth its parameters if it lowers the
    error on the hold-out by more than the share ``worth``, and by more than two
    standard errors.
    """

    notches: tuple[Annotated[int, Field(strict=True, ge=0, le=MOST_NOTCHES)], ...] = (
        Field(min_length=2)
    )
    behind: str | None = None
    worth: Annotated[float, Field(gt=0.0, lt=1.0, strict=True)] = 0.1

    @field_validator("notches")
    @classmethod
    def _distinct(cls, counts: tuple[int, ...]) -> tuple[int, ...]:
        for count in counts:
            if counts.count(count) > 1:
                raise ValueError(f"{count} is listed twice")
        return tuple(sorted(counts))
