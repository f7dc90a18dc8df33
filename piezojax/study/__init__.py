"""The study file: what to tune, on what, how."""

from pathlib import Path

from .case import Case as Case
from .case import build as build
from .case import read as read
from .contenders import Entry as Entry
from .contenders import entries_of as entries_of
from .contenders import is_comparison as is_comparison
from .contenders import load_comparison as load_comparison
from .contenders import read_entries as read_entries
from .ensemble import Ensemble as Ensemble
from .ensemble import Stage as Stage
from .schema import Study as Study
from .schema import load as load

DEFAULT = "p753_dob"
"""Name of the study that runs when none is given."""


def shipped(name: str = DEFAULT) -> Path:
    """Return the path of a study, or of a comparison, that comes with piezojax.

    Raises ValueError, listing them, for a name that is none.
    """
    here = Path(__file__).parents[1]
    # In an installed package the studies lie inside it, in a checkout beside it.
    folder = here / "studies" if (here / "studies").is_dir() else here.parent / "tuning"
    known = {
        file.relative_to(folder).with_suffix("").as_posix(): file
        for file in sorted(folder.rglob("*.toml"))
    }
    if name not in known:
        raise ValueError(f"study {name!r} is unknown; there are {', '.join(known)}")
    return known[name]
