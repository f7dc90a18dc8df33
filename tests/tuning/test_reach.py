"""References beyond the stroke of the stage are refused before tuning."""

import copy
import dataclasses
from unittest.mock import Mock

import pytest

import piezojax as pj
from piezojax.core.paths import replace
from piezojax.identification.response_model import ResponseModel
from piezojax.study import Study, build, read, shipped
from piezojax.tuning.data import make_data
from piezojax.tuning.reach import SLACK, require_reach

# 1 um/V from -20 to 120 V: a stroke of 140 um.
STUDY = {
    "title": "a stage of 140 um",
    "rate": 1000.0,
    "plant": {"type": "FirstOrderLag", "time_constant": 1e-2, "dt": 1e-3},
    "actuator": {"lower": -20.0, "upper": 120.0},
    "controller": {"type": "PID", "proportional": 0.1, "integral": 1.0, "dt": 1e-3},
    "references": {
        "tune": ["CONST1", "SIN10"],
        "unseen": ["TRI10"],
        "amplitude": 50.0,
        "offset": 0.0,
        "duration": 0.2,
        "settle": 0.1,
    },
    "tune": ["controller.integral"],
}
AXES = {
    "axes": {"names": ["Z", "Rx"], "units": ["um", "urad"]},
    "plant": {"type": "PerAxis", "parts": [STUDY["plant"]] * 2},
    "controller": {"type": "PerAxis", "parts": [STUDY["controller"]] * 2},
    "tune": ["controller.0.integral"],
}


def case_of(references, **tables):
    study = copy.deepcopy(STUDY) | tables
    study["references"] |= references
    return build(Study.model_validate(study), "study.toml")


def checked(references, **tables):
    case = case_of(references, **tables)
    require_reach(case, make_data(case))


def test_a_reference_inside_the_stroke_passes():
    checked({})
    checked({"amplitude": 70.0, "offset": -20.0})


def test_tuning_refuses_a_reference_with_stroke_and_remedy():
    with pytest.raises(ValueError, match="beyond") as refused:
        pj.tune(case_of({"amplitude": 75.0, "tune": ["SIN10"]}))
    assert str(refused.value) == (
        "references.tune: SIN10 spans 0 to 150 um, beyond the stroke of the stage, "
        "-20 to 120 um between the limits of the actuator: reduce "
        "references.amplitude, now 75, or change references.offset, now 0"
    )


def test_the_stroke_of_a_fitted_model_points_to_its_record():
    case = case_of({"amplitude": 75.0})
    fitted = dataclasses.replace(case, plant_about=pj.About(record="bench.csv"))
    message = "now 0. The stroke is that of the model: .* columns of bench.csv are in"
    with pytest.raises(ValueError, match=message):
        require_reach(fitted, make_data(fitted))
    measured = dataclasses.replace(fitted, response=Mock(spec=ResponseModel))
    message = "the response was measured with small motions, whose gain is less than"
    with pytest.raises(ValueError, match=message):
        require_reach(measured, make_data(measured))


@pytest.mark.parametrize(
    ("references", "message"),
    [
        ({"tune": ["CONST1"], "amplitude": 75.0}, r"references.unseen: TRI10 spans"),
        (
            {"tune": ["CONST1"], "unseen": ["STEP1", "TRI10"], "amplitude": 75.0},
            r"references.unseen: TRI10 spans",
        ),
        ({"offset": 30.0}, r"SIN10 spans 30 to 130 um.*references.offset, now 30"),
        ({"offset": -95.0}, r"references.tune: CONST1 spans -45 to -45 um"),
    ],
)
def test_every_reference_is_checked(references, message):
    with pytest.raises(ValueError, match=message):
        checked(references)


def test_the_limits_of_a_device_count():
    case = read(shipped("nv200"))
    low = replace(case.loop, {"controller.avmax": 30.0})
    with pytest.raises(ValueError, match="between the limits of the controller: red"):
        require_reach(dataclasses.replace(case, loop=low), make_data(case))


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_small_excess_is_allowed(way):
    limit, allowed = (120.0 if way > 0.0 else -20.0), SLACK * 140.0
    # CONST is offset plus amplitude.
    alone = {"tune": ["CONST1"], "unseen": [], "amplitude": 1.0}
    checked(alone | {"offset": limit - 1.0 + way * 0.9 * allowed})
    with pytest.raises(ValueError, match="CONST1 spans"):
        checked(alone | {"offset": limit - 1.0 + way * 1.1 * allowed})


def test_the_axis_is_named():
    drive = {"lower": [-20.0, -10.0], "upper": [120.0, 30.0]}
    motions = {"tune": ["Z:SIN10", "Z:SIN10 Rx:SIN20"], "unseen": []}
    fits = motions | {"amplitude": [50.0, 15.0]}
    checked(fits, **AXES, actuator=drive)
    with pytest.raises(ValueError, match="Z:SIN10 Rx:SIN20 spans 0 to 40 urad") as got:
        checked(fits | {"amplitude": [50.0, 20.0]}, **AXES, actuator=drive)
    assert "the stroke of axis Rx, -10 to 30 urad" in str(got.value)
    assert "references.amplitude, now 20" in str(got.value)


@pytest.mark.parametrize("name", ["p753_dob", "three_dof_sliding_mode", "mirror"])
def test_shipped_studies_pass(name):
    case = read(shipped(name))
    require_reach(case, make_data(case))
