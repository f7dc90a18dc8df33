"""Margins at the largest gain of an assumed hysteresis."""

import numpy as np
import pytest

from piezojax.analysis.stability import OperatingPoint, stability_report
from piezojax.core.paths import replace
from piezojax.solve.clock import Clock
from piezojax.study import Study, build
from piezojax.tuning.data import make_data
from piezojax.tuning.evaluator import Evaluator
from piezojax.tuning.steep_stage import steep_stage

STUDY = {
    "title": "a gain and a delay",
    "rate": 20_000.0,
    "plant": {
        "type": "Series",
        "parts": [{"type": "Affine", "gain": 0.15}, {"type": "Delay", "samples": 2}],
    },
    "actuator": {"lower": -20.0, "upper": 120.0},
    "controller": {"type": "PID", "proportional": 0.0, "integral": 2e4, "dt": 5e-5},
    "references": {"tune": ["SIN50"], "duration": 0.02, "settle": 0.0},
    "disturbance": {"hysteresis": 0.1},
    "constraints": {"sensitivity_peak": 2.0},
    "tune": ["controller.integral"],
}
RISE = 1.2 / 0.8
"""(1 + 2 width) / (1 - 2 width)"""


def case_of(**tables):
    return build(Study.model_validate(STUDY | tables), "small.toml")


def test_its_gain_is_that_at_the_end_of_a_branch():
    case = case_of()
    stage = steep_stage(case)
    np.testing.assert_allclose(stage.plant.parts[0].gain, [RISE * 0.15])
    assert float(case.loop.plant.parts[0].gain) == 0.15


@pytest.mark.parametrize(
    "tables",
    [
        {"disturbance": {}},
        {"plant": {"type": "FirstOrderLag", "time_constant": 1e-3, "dt": 5e-5}},
    ],
)
def test_without_hysteresis_or_a_gain_there_is_none(tables):
    assert steep_stage(case_of(**tables)) is None


def test_limits_on_margins_hold_on_it():
    case = case_of()
    loops = [case.loop, replace(case.loop, {"plant.0.gain": RISE * 0.15})]
    point = OperatingPoint(case.margin_reference, dt=case.study.dt)
    expected = [stability_report(loop, point).sensitivity_peak for loop in loops]
    assert expected[1] > 1.2 * expected[0]
    evaluator = Evaluator(Clock(), case)
    found = evaluator.limited(
        case.loop, make_data(case).tuning, None, evaluator.margin_stages
    )
    peaks = np.max(found.margins["sensitivity_peak"], axis=(1, 2))
    np.testing.assert_allclose(peaks, expected, rtol=0.01)
