"""A model that is used far outside its record raises an alarm."""

import copy
import dataclasses
from types import SimpleNamespace

import pytest

import piezojax as pj
from piezojax.core.about import About
from piezojax.study import Study, build
from piezojax.tuning.data import make_data
from piezojax.tuning.drive import Drive
from piezojax.tuning.recorded_range import (
    COVERED,
    SLACK,
    recorded_range_alarms,
    recorded_slew_alarms,
)

# 2 um/V: references from -40 to 60 um need -20 to 30 V.
PLANT = {"type": "Affine", "gain": 2.0, "offset": 0.0}
PID = {"type": "PID", "proportional": 0.0, "integral": 10.0, "dt": 1e-3}
STUDY = {
    "title": "2 um/V",
    "rate": 1000.0,
    "plant": PLANT,
    "actuator": {"lower": -20.0, "upper": 120.0},
    "controller": PID,
    "references": {
        "tune": ["SIN10"],
        "unseen": ["TRI10"],
        "amplitude": 50.0,
        "offset": -40.0,
        "duration": 0.2,
        "settle": 0.1,
    },
    "tune": ["controller.integral"],
}
AXES = {
    "axes": {"names": ["Z", "Rx"], "units": ["um", "urad"]},
    "plant": {"type": "PerAxis", "parts": [PLANT] * 2},
    "controller": {"type": "PerAxis", "parts": [PID] * 2},
    "references": STUDY["references"] | {"tune": ["Z:SIN10", "Rx:SIN10"], "unseen": []},
    "tune": ["controller.0.integral"],
}


def case_of(*ranges, **tables):
    study = copy.deepcopy(STUDY) | tables
    case = build(Study.model_validate(study), "study.toml")
    return dataclasses.replace(case, plant_about=About(input_ranges=list(ranges)))


def alarms(*ranges, **tables):
    case = case_of(*ranges, **tables)
    return list(recorded_range_alarms(case, make_data(case)))


def test_a_record_of_the_whole_range_has_no_alarm():
    assert alarms((-20.0, 120.0)) == []
    assert alarms((-20.0, 30.0)) == []


def test_a_plant_without_a_fit_has_no_alarm():
    assert alarms() == []


@pytest.mark.parametrize(
    ("low", "high", "raised"),
    [
        (-20.0, 30.0 / (1.0 + 0.9 * SLACK), False),
        (-20.0, 22.0, True),
        (-11.0, 80.0, False),
        (-9.0, 80.0, True),
    ],
)
def test_references_beyond_the_record_raise_an_alarm(low, high, raised):
    found = alarms((low, high))
    assert len(found) == raised
    for alarm in found:
        assert alarm == (
            f"the references need -20 to 30 V, but the record of the plant covers "
            f"{low:.4g} to {high:.4g} V: outside it the model extrapolates; record the "
            "whole range, or reduce references.amplitude"
        )


def test_a_record_of_a_small_part_of_the_range_raises_an_alarm():
    """An example is an input recorded before an amplifier of gain ten."""
    small = {"references": STUDY["references"] | {"amplitude": 5.0, "offset": 0.0}}
    width = COVERED * 140.0
    assert alarms((0.0, 1.01 * width), **small) == []
    assert alarms((0.0, 0.99 * width), **small) == [
        "the record of the plant covers 0 to 34.65 V, the actuator -20 to 120 V: if "
        "one of them is the voltage before an amplifier, multiply it by the gain; if "
        "not, record the range that is used, or set actuator.lower and actuator.upper "
        "to the recorded range"
    ]
    limits = {"actuator": {"lower": 0.0, "upper": 0.99 * width}}
    assert alarms((0.0, 0.99 * width), **small, **limits) == []


def test_a_record_far_beyond_the_actuator_raises_an_alarm():
    """An example is an input recorded behind the amplifier."""
    (alarm,) = alarms((-200.0, 1201.0))
    assert alarm.startswith("the record of the plant covers -200 to 1201 V, the actuat")
    assert alarms((-20.0, 500.0)) == []


def test_each_axis_has_its_own_alarm():
    wide = (-20.0, 120.0)
    assert alarms(wide, wide, **AXES) == []
    (alarm,) = alarms(wide, (-20.0, 20.0), **AXES)
    assert alarm.startswith("the references of axis Rx need -20 to 30 V")
    # The order of the inputs is not known.
    assert alarms((0.0, 1.0), (0.0, 1.0), (0.0, 1.0), **AXES) == []


def test_tuning_ends_with_the_alarm():
    case = case_of((-20.0, 20.0))
    about = case.plant_about.model_copy(update={"record": "bench.csv"})
    result = pj.tune(dataclasses.replace(case, plant_about=about)).result
    assert result.alarms[0].startswith("the references")
    assert any(
        "fitted to bench.csv and never checked on a second record" in note
        for note in result.warnings
    )


def slew_alarms(recorded, *peaks, **tables):
    about = About(input_slews=list(recorded))
    case = dataclasses.replace(case_of(**tables), plant_about=about)
    names = case.study.axes.names if case.study.axes else ("piezo",)
    figures = {
        name: Drive(
            noise_rms_V=0.0,
            high_frequency_rms_V=0.0,
            slew_rms_V_per_s=0.0,
            slew_peak_V_per_s=peak,
        )
        for name, peak in zip(names, peaks, strict=True)
    }
    return list(recorded_slew_alarms(case, SimpleNamespace(drive=({}, figures))))


def test_a_voltage_that_is_faster_than_the_record_raises_an_alarm():
    assert slew_alarms([1000.0], 1000.0 * (1.0 + 0.9 * SLACK)) == []
    assert slew_alarms([1000.0], 2500.0) == [
        "the tuned loop moves the voltage at up to 2500 V/s, but the record of the "
        "plant at most at 1000 V/s: an amplifier that cannot follow can make the loop "
        "unstable; set actuator.slew_rate to what yours reaches, record faster motions "
        "(python -m piezojax.excite), or limit constraints.peak_slew"
    ]
    assert slew_alarms([1000.0], None) == []  # a diverging run has its own alarm
    (alarm,) = slew_alarms([10.0, 1000.0], 10.0, 1200.0, **AXES)
    assert alarm.startswith("the tuned loop moves the voltage of axis Rx at up to 1200")


def test_an_amplifier_in_the_study_may_be_faster_than_the_record():
    limits = STUDY["actuator"] | {"slew_rate": 2500.0}
    assert slew_alarms([1000.0], 2500.0, actuator=limits) == []
    limits = STUDY["actuator"] | {"current_limit": 0.1, "capacitance": 3e-6}
    assert slew_alarms([1000.0], 2500.0, actuator=limits) == []
    assert slew_alarms([], 2500.0) == []  # a plant without a fit


def test_a_tuned_loop_that_is_faster_than_the_record_has_the_alarm():
    about = About(input_ranges=[(-20.0, 120.0)], input_slews=[300.0])
    case = dataclasses.replace(case_of(), plant_about=about)
    (alarm,) = pj.tune(case).result.alarms
    assert alarm.startswith("the tuned loop moves the voltage at up to ")
