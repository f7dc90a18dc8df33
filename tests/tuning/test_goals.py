"""Limits on usual specifications in a study: kept if active, with exact figures."""

import json

import pytest
import tomli_w

import piezojax as pj
from piezojax.analysis.stability import stability_reports
from piezojax.analysis.step_response import NAMES
from piezojax.catalog import p753, p753_stage
from piezojax.report.step_pictures import steps_table
from piezojax.report.tuning_pictures import write_results
from piezojax.study import read
from piezojax.tuning.alarms import delay_notes, peak_notes
from piezojax.tuning.result import load_result
from piezojax.tuning.step_tests import StepResult

STUDY = {
    "title": "integral action that noise would like to be slow",
    "rate": 10_000.0,
    "seed": 5,
    "plant": {"catalog": "p753"},
    "actuator": {"lower": -20.0, "upper": 120.0},
    "sensor": {"noise_rms": 0.2},
    "controller": {"type": "PID", "proportional": 0.0, "integral": 500.0, "dt": 1e-4},
    "references": {
        "tune": ["SIN1"],
        "amplitude": 2.0,
        "duration": 0.1,
        "settle": 0.05,
    },
    "parameters": {
        "controller.integral": {"lower": 100.0, "upper": 2e4, "scale": "log"}
    },
    "optimiser": {"method": "gauss_newton", "starts": 1, "candidates": 3, "steps": 20},
}


def tuned(folder, **constraints):
    path = folder / "study.toml"
    path.write_text(tomli_w.dumps(STUDY | {"constraints": constraints}))
    return pj.tune(path)


def test_goals_are_kept_and_active_with_steps_in_the_result(tmp_path):
    goals = {"settling_time": 0.008, "gain_margin": 6.0, "bandwidth": 60.0}
    outcome = tuned(tmp_path, **goals)
    found = outcome.result.constraints
    assert not outcome.result.alarms
    assert {name: found[name].kept for name in goals} == dict.fromkeys(goals, True)
    assert found["settling_time"].active
    assert found["settling_time"].of == 1
    before, after = outcome.steps
    # Without the limit the step is slower; the limit applies to the worst step.
    assert max(s.settling_time_s for s in before.values()) > 0.01
    worst = max(step.settling_time_s for step in after.values())
    assert worst == pytest.approx(found["settling_time"].value, rel=1e-6)
    for report in outcome.stability.reports["after"].values():
        assert report.gain_margin_dB >= 6.0
        assert report.following.bandwidth_Hz >= found["bandwidth"].value * 0.999
    write_results(outcome, tmp_path)
    assert (tmp_path / "steps.png").stat().st_size > 10_000
    assert load_result(tmp_path).steps == after
    data = json.loads((tmp_path / "result.json").read_text())
    assert data["steps_before"]["large step up"]["rise_time_s"] > 0.0
    titles = [
        column.header.replace("\n", ", ")
        for column in steps_table(outcome.steps).columns
    ]
    assert titles[2] == "to 2 %, ms"
    assert list(steps_table(outcome.steps).columns[2].cells)[3] == f"{1e3 * worst:.3g}"


def test_a_diverged_step_is_told_from_one_that_never_settles():
    names = list(StepResult.model_fields)[2:]
    slow = dict.fromkeys(names[:4]) | dict.fromkeys(names[4:], 0.05)
    lost, late = (
        dict.fromkeys(NAMES, StepResult(before_um=0.0, after_um=1.0, **figures))
        for figures in (dict.fromkeys(names), slow)
    )
    table = steps_table((lost, late))
    rows = list(zip(*(column.cells for column in table.columns), strict=True))
    assert rows[0] == ("1 um, before", *["diverges"] * 6)
    assert rows[1] == ("1 um, tuned", *["never"] * 4, "5", "5")


def test_incompatible_goals_have_an_alarm_each(tmp_path):
    result = tuned(tmp_path, settling_time=0.008, phase_margin=70.0).result
    for name, unit in (("settling_time", "s"), ("phase_margin", "deg")):
        assert not result.constraints[name].kept
        assert any(
            alarm.startswith(f"{name} is ") and f" {unit}: " in alarm
            for alarm in result.alarms
        )


def test_a_loop_that_amplifies_its_reference_has_a_note():
    """The loop with observer excites the lightly damped mode by steps."""
    observer = p753.disturbance_observer()
    actuator, sensor = p753.actuator(), pj.Sensor(0.0)
    amplifying = pj.Feedback(observer, p753_stage.stage(), actuator, sensor)
    slow = pj.Feedback(
        pj.control.PID(0.0, 500.0, dt=5e-5), p753_stage.stage(), actuator, sensor
    )
    (note,) = peak_notes(stability_reports({"after": amplifying}, 5.0))
    report = pj.stability_report(amplifying, 5.0).following
    assert report.closed_loop_peak > 2.0
    assert "the tuned loop amplifies references at" in note
    assert peak_notes(stability_reports({"after": slow}, 5.0)) == []
    assert peak_notes(stability_reports({"before": amplifying}, 5.0)) == []


def test_a_small_delay_margin_has_a_note():
    def loop(integral):
        control = pj.control.PID(0.0, integral, dt=5e-5)
        plant = p753_stage.stage()
        return pj.Feedback(control, plant, p753.actuator(), pj.Sensor(0.0))

    notes = {
        integral: delay_notes(stability_reports({"after": loop(integral)}, 5.0))
        for integral in (500.0, 3e4)
    }
    report = pj.stability_report(loop(3e4), 5.0)
    assert report.stable
    assert report.delay_margin_samples < 2.0
    (note,) = notes.pop(3e4)
    assert f"unstable with {report.delay_margin_samples:.3g} samples more" in note
    assert notes == {500.0: []}


@pytest.mark.parametrize(
    ("name", "limit", "message"),
    [
        ("phase_margin", 200.0, "must be a number above 0 and below 180"),
        ("settling_time", 0.0, "must be a number above 0"),
        ("settling", 0.01, "settling_time"),
    ],
)
def test_impossible_limits_are_refused(tmp_path, name, limit, message):
    path = tmp_path / "study.toml"
    path.write_text(tomli_w.dumps(STUDY | {"constraints": {name: limit}}))
    with pytest.raises(ValueError, match=message) as caught:
        read(path)
    assert "\n" not in str(caught.value)


def test_several_axes_have_no_bandwidth(tmp_path):
    shipped = pj.study.shipped("three_dof_sliding_mode").read_text()
    path = tmp_path / "study.toml"
    path.write_text(shipped + "\n[constraints]\nbandwidth = 100.0\n")
    with pytest.raises(ValueError, match="bandwidth is known for one axis only"):
        pj.study.load(path)
