"""Share of the error in the sliding variable: means, printed line, and study."""

from typing import Any

import numpy as np
import pytest

from piezojax import loop_inputs
from piezojax.analysis.sliding_share import sliding_parts
from piezojax.catalog import p753
from piezojax.core.feedback import Feedback
from piezojax.report.tuning_tables import sliding_text
from piezojax.study import build, load, shipped
from piezojax.tuning import Result
from piezojax.tuning.data import make_data
from piezojax.tuning.sliding import SlidingShare, sliding_share

FIRST = 200


@pytest.fixture(scope="module")
def case():
    study = load(shipped("p753_sliding_mode"))
    changes: dict[str, Any] = {"tune": ("SIN50", "SW50"), "duration": 0.03}
    references = study.references.model_copy(update=changes | {"settle": 0.01})
    return build(study.model_copy(update={"references": references}), "short.toml")


def test_the_share_is_the_mean_over_the_tuning_references(case):
    data = make_data(case)
    found = sliding_share(case.loop, data, FIRST)
    assert found is not None
    signals = data.holdout
    parts = []
    for i in range(2):
        assert signals.disturbance is not None
        inputs = loop_inputs(
            signals.references[i], signals.noise[i, 0], signals.disturbance[i, 0]
        )
        start = signals.references[i, 0]
        parts.append(sliding_parts(case.loop, inputs, start, FIRST))
    expected = [np.mean([part.share for part in parts]), *np.mean(parts, axis=0)]
    np.testing.assert_allclose(list(found.model_dump().values()), expected, rtol=1e-9)


def test_another_controller_has_no_share(case):
    loop = case.loop
    other = Feedback(p753.pid(), loop.plant, loop.actuator, loop.sensor)
    assert sliding_share(other, make_data(case), FIRST) is None


def test_the_line_has_both_shares():
    def parts(share):
        return SlidingShare(
            share=share, sliding_um_per_s=1.0, error_um_per_s=1.0, rest_um_per_s=1.0
        )

    def line_of(before, after):
        found = {"sliding_before": before, "sliding": after}
        return sliding_text(Result.model_construct(**found))

    line = line_of(parts(0.875), parts(0.5971))
    assert line is not None
    assert line.startswith("sliding variable: 59.7 % of its mean square is tracking")
    assert "(87.5 % before)" in line
    assert "(- before)" in str(line_of(parts(None), parts(0.5)))
    assert line_of(None, None) is None


def test_the_bounded_study_differs_from_that_of_the_thesis_in_bounds_only():
    bounded, free = load(shipped("p753_sliding_mode")), load(shipped("p753_dob"))
    same = set(type(free).model_fields) - {"title", "parameters"}
    for name in same:
        assert getattr(bounded, name) == getattr(free, name)
    assert set(bounded.parameters) == set(free.parameters)
