"""What every table of a study file is made of."""

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)]
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]


class Table(BaseModel):
    """A table of a study: nothing in it is guessed, nothing unknown is passed over."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def one_of(name: str, allowed: Any) -> str:
    """Return ``name``; raise ValueError, listing ``allowed``, if it is not in there."""
    if not isinstance(name, str) or name not in allowed:
        raise ValueError(f"{name!r} is unknown; there are {', '.join(allowed)}")
    return name
