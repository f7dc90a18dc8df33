import pytest
import tomli_w
from swept_studies import study_of

from piezojax.sweeping import read_swept


@pytest.fixture
def write(tmp_path):
    def write(sweep, **changes):
        path = tmp_path / "study.toml"
        path.write_text(tomli_w.dumps(study_of(sweep, **changes)))
        return path

    return write


@pytest.fixture
def case_of(write):
    return lambda sweep, **changes: read_swept(write(sweep, **changes))
