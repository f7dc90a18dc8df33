"""The operating points at which the margins of a study are judged."""

import dataclasses

import pytest

import piezojax as pj
from piezojax.analysis.stability import OperatingPoint, stability_report
from piezojax.analysis.stability.operating_point import BRANCHES
from piezojax.solve.search_state import SearchState
from piezojax.study import Study, build, shipped
from piezojax.study.study_file import load
from piezojax.tuning.limited_search import exact_stability


def case_of(amplitude, offset):
    """Return the P-753 with a disturbance observer and limits of both signs."""
    study = load(shipped("p753_dob"))
    data = study.model_dump(exclude_unset=True)
    data["actuator"] |= {"lower": -120.0, "upper": 120.0}
    data["references"] |= {"tune": ["SIN10"], "unseen": [], "duration": 0.6}
    data["references"] |= {"amplitude": amplitude, "offset": offset}
    return build(Study.model_validate(data), shipped("p753_dob"))


@pytest.mark.parametrize(("offset", "far"), [(-12.0, -12.0), (0.0, 12.0)])
def test_margins_are_judged_far_from_rest_and_at_the_other_end(offset, far):
    case = case_of(6.0, offset)
    assert case.margin_reference == pytest.approx(far, abs=1e-6)
    assert case.nearer_reference == pytest.approx(0.0, abs=1e-6)
    search = SearchState(case.space.nearest(case.loop))
    reports = exact_stability(case, search).reports["after"]
    assert {round(each.reference_um, 6) for each in reports.values()} == {0.0, far}
    worst = max(each.sensitivity_peak for each in reports.values())
    peaks = [
        stability_report(case.loop, OperatingPoint(place, branch)).sensitivity_peak
        for place in (far, 0.0)
        for branch in BRANCHES
    ]
    assert worst == pytest.approx(max(peaks[:2]), rel=1e-6)
    assert worst > 1.2 * max(peaks[2:])


def test_an_end_at_which_the_stage_cannot_rest_is_named():
    """The actuator ends at 0 V, where the stage rests a little above the reference."""
    case = case_of(6.0, 0.0)
    data = case.study.model_dump(exclude_unset=True)
    data["actuator"]["lower"] = 0.0
    plant = pj.series(stage=case.loop.plant, offset=pj.core.system.Affine(1.0, 0.01))
    loop = dataclasses.replace(
        case.loop, plant=plant, actuator=pj.hardware.Saturation(0.0, 120.0)
    )
    shifted = dataclasses.replace(case, loop=loop)
    search = SearchState(case.space.nearest(case.loop))
    found = exact_stability(shifted, search)
    assert set(found.reports["after"]) == set(BRANCHES)
    assert "cannot rest" in found.problems["after at 0 um"]
    assert "after" not in found.problems
