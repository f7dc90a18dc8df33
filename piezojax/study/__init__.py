"""The study file: what to tune, on what, how."""

from pathlib import Path

from .case import Case as Case
from .case import build as build
from .case import read as read
from .schema import Study as Study
from .schema import load as load

DEFAULT = "p753_dob"
"""Name of the study that runs when none is given."""


def shipped(name: str = DEFAULT) -> Path:
    """Return the path of a study that comes with piezojax.

    Raises ValueError, listing them, for a name that is none.
    """
    here = Path(__file__).parents[1]
    # In an installed package the studies lie inside it, in a checkout beside it.
    folder = here / "studies" if (here / "studies").is_dir() else here.parent / "tuning"
    known = {file.stem: file for file in sorted(folder.glob("*.toml"))}
    if name not in known:
        raise ValueError(f"study {name!r} is unknown; there are {', '.join(known)}")
    return known[name]
