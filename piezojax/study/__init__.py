"""Study files: the controller to tune, the stage, the references, the objective."""

from pathlib import Path

from .case import Case as Case
from .comparison_study import ComparedCase as ComparedCase
from .comparison_study import ComparisonStudy as ComparisonStudy
from .comparison_study import compared_cases as compared_cases
from .comparison_study import is_comparison_study as is_comparison_study
from .comparison_study import load_comparison_study as load_comparison_study
from .comparison_study import read_compared as read_compared
from .ensemble import Ensemble as Ensemble
from .ensemble import Stage as Stage
from .json_schema import study_schema as study_schema
from .make_case import build as build
from .make_case import read as read
from .schema import Study as Study
from .study_file import as_toml as as_toml
from .study_file import contents_of as contents_of
from .study_file import load as load
from .study_file import sha256_of as sha256_of

DEFAULT = "p753_learned_inverse"
"""Name of the default study."""


def shipped(name: str = DEFAULT) -> Path:
    """Return the path of a study or comparison study shipped with piezojax.

    Raises ValueError, listing the known names, for an unknown name.
    """
    here = Path(__file__).parents[1]
    # An installed package contains the studies; in a checkout they lie beside it.
    folder = here / "studies" if (here / "studies").is_dir() else here.parent / "tuning"
    known = {
        file.relative_to(folder).with_suffix("").as_posix(): file
        for file in sorted(folder.rglob("*.toml"))
    }
    if name not in known:
        raise ValueError(f"study {name!r} is unknown; there are {', '.join(known)}")
    return known[name]
