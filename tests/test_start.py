"""``piezojax.start``: columns, defaults, the study that it writes, and its course."""

import re
import tomllib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy
from click.testing import CliRunner
from oracles import excitation, forty_stages

from piezojax import About, save
from piezojax.cli import start
from piezojax.control import PID
from piezojax.core.files import write_report
from piezojax.exporting.judge import ExportReport
from piezojax.identification import Record, read_record
from piezojax.identification.records.recognise import noise_rms, recognised
from piezojax.identification.records.response import FrequencyResponse
from piezojax.identification.records.saved_response import save_response
from piezojax.signals import signal, time_grid
from piezojax.study import build, contents_of, load, sha256_of
from piezojax.study.first_plan import Plan, Shown, doubts
from piezojax.study.first_plan import planned as planned_by
from piezojax.study.first_study import (
    first_study,
    plant_of_record,
    plant_of_response,
)
from piezojax.tuning.result import Result, Scores

NONE = {"time": None, "input": None, "output": None, "rate": None}


def planned(record, given):
    return planned_by(Shown.by_record(record), given)


def lag_record(samples=3000, noise=0.01):
    """Return time, voltage and displacement of a lag of 0.1 um/V at 1 kHz."""
    random = np.random.default_rng(2)
    time = 1e-3 * np.arange(samples)
    drive = 40.0 - 30.0 * np.cos(2.0 * np.pi * 2.0 * time * (1.0 + time))
    drive += 5.0 * np.repeat(random.choice([-1.0, 1.0], samples // 10), 10)
    drive[-500:] = drive[-500]
    moved = np.zeros(samples)
    for k in range(1, samples):
        moved[k] = 0.8 * moved[k - 1] + 0.02 * drive[k - 1]
    return time, drive, moved + noise * random.standard_normal(samples)


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    path = tmp_path_factory.mktemp("bench") / "record.csv"
    np.savetxt(
        path,
        np.c_[lag_record()],
        delimiter=",",
        header="time_s,command_V,sensor_um",
        comments="",
    )
    return path


def table(tmp_path, header, *rows, name="record.csv"):
    path = tmp_path / name
    values = np.arange(40.0).reshape(4, 10)[:, : header.count(",") + 1]
    lines = [*rows, *(",".join(map(str, row)) for row in values)]
    path.write_text("\n".join([header, *lines]), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("header", "rows", "found"),
    [
        ("time_s,input_V,position_um", (), ("time_s", "input_V", "position_um")),
        ("position_nm,drive_mV,time_ms", (), ("time_ms", "drive_mV", "position_nm")),
        (
            "Time (s),Sensor [um],Drive [V]",
            (),
            ("Time (s)", "Drive [V]", "Sensor [um]"),
        ),
        ("t,drive_V,sensor_um", (), ("t", "drive_V", "sensor_um")),
        ("t (ms),T,z_um,drive_V", (), ("t (ms)", "drive_V", "z_um")),
        ("time,first,second", (), ("time", "first", "second")),
        ("X,CH1,CH2", ("Sequence,V,um",), (None, "CH1", "CH2")),
    ],
)
def test_columns_are_recognised(tmp_path, header, rows, found):
    columns = recognised(table(tmp_path, header, *rows), dict(NONE))
    assert tuple(columns[role] for role in ("time", "input", "output")) == found


def test_given_columns_are_kept(tmp_path):
    path = table(tmp_path, "time_s,a_um,b_um")
    given = NONE | {"input": "a_um", "rate": 0.1, "resample": 2.0}
    assert recognised(path, given) == {
        "time": None,
        "input": "a_um",
        "output": "b_um",
        "rate": 0.1,
        "resample": 2.0,
    }


@pytest.mark.parametrize("unit", ["time_s", "t (ms)"])
def test_a_rate_that_contradicts_the_times_is_refused(tmp_path, unit):
    path = table(tmp_path, f"{unit},drive_V,sensor_um")  # a step of 10
    own = 0.1 if unit == "time_s" else 100.0
    message = f"--rate is 5 Hz, but the column '{unit}' has {own:g} Hz"
    with pytest.raises(ValueError, match=re.escape(message)):
        recognised(path, NONE | {"rate": 5.0})
    assert recognised(path, NONE | {"rate": 1.005 * own})["time"] is None


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (
            "time_s,command_V,monitor_V",
            "2 columns are in V or a multiple of it; name the input with --input: "
            r"there are time_s \[s\], command_V \[V\], monitor_V \[V\]",
        ),
        ("time_s,a_V,b", r"0 columns are in um .* --output: .* b \(no unit\)"),
        ("one,two,three", "0 columns are in V"),
    ],
)
def test_ambiguous_columns_are_refused(tmp_path, header, message):
    with pytest.raises(ValueError, match=message):
        recognised(table(tmp_path, header), dict(NONE))


@pytest.mark.parametrize("number", [4, 10, 24, 38])
def test_the_noise_of_a_moving_stage_is_measured(number):
    stage = forty_stages.stage(number)
    record = Record(*excitation.record(stage), stage.dt)
    assert noise_rms(record) == pytest.approx(stage.parameters.noise, rel=0.1)


@pytest.mark.parametrize("samples", [2000, 20_000, 200_000])
def test_the_noise_of_a_resting_stage_has_no_bias(samples):
    noise = 3e-3 * np.random.default_rng(samples).standard_normal(samples)
    record = Record(np.arange(samples), 5.0 + noise, 1e-4)
    assert noise_rms(record) == pytest.approx(3e-3, rel=0.1)


def test_the_noise_of_a_smooth_record_is_that_of_its_converter():
    time = np.arange(0.0, 1.0, 1e-4)
    sine = 10.0 * np.sin(2.0 * np.pi * 3.0 * time)
    assert noise_rms(Record(sine, sine, 1e-4)) < 1e-8
    rounded = Record(sine, np.round(sine / 0.02) * 0.02, 1e-4)
    # A constant code has no noise; a changing one has at most that of its steps.
    assert noise_rms(rounded) < 0.02


def test_defaults_lie_within_the_record(record):
    found = planned(read_record(record, time="time_s", input=1, output=2), {})
    _, drive, moved = lag_record()
    assert (found.lower, found.upper) == pytest.approx(
        (drive.min(), drive.max()), rel=1e-3
    )
    assert found.noise == pytest.approx(0.01, rel=0.25)
    assert (found.frequency, found.track) == (1.0, "SIN1,PWSW4")
    reference = signal("SIN1", time_grid(2.0, 1e3), found.amplitude, found.offset)
    middle = 0.5 * (moved.min() + moved.max())
    assert np.mean([reference.min(), reference.max()]) == pytest.approx(
        middle, abs=0.01
    )
    assert np.ptp(reference) == pytest.approx(0.4 * np.ptp(moved), rel=1e-3)


def test_the_default_references_are_as_slow_as_the_record(record):
    time, drive, _ = lag_record()
    slow = 40.0 - 30.0 * np.cos(2.0 * np.pi * 0.4 * time)
    assert np.abs(np.diff(slow)).max() < 0.1 * np.abs(np.diff(drive)).max()
    loaded = Record(slow, 0.1 * slow, 1e-3)
    found = planned(loaded, {})
    # 1.2 A 2 pi 4 f of PWSW is below 0.7 times the 7.5 um/s of the record.
    assert (found.frequency, found.track) == (0.1, "SIN0.1,PWSW0.4")
    assert found.slew < 0.7 * 0.1 * loaded.slews[0]
    assert planned(loaded, {"frequency": 1.0}).track == "SIN1,PWSW4"


def test_answers_replace_defaults(record):
    loaded = read_record(record, time="time_s", input=1, output=2)
    found = planned(loaded, {"frequency": 7.0, "upper": 50.0, "noise": None})
    assert (found.frequency, found.track) == (7.0, "SIN7,PWSW28")
    assert found.upper == 50.0
    fastest = 0.5 * found.amplitude * 2.0 * np.pi * 28.0
    assert found.slew > fastest
    # That of a cosine, and of the turns of the unseen SCAN, which take a tenth of it.
    cosine = fastest * 2.0 * np.pi * 28.0
    assert cosine < found.acceleration < 1e2 * cosine
    limited = planned(loaded, {"slew": 3.0, "acceleration": 5.0})
    assert (limited.slew, limited.acceleration) == (3.0, 5.0)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"frequency": 0.0}, "frequency is 0 Hz; it must be above 0"),
        ({"amplitude": -1.0}, "amplitude is -1 um; it must be above 0"),
        ({"slew": 0.0}, "slew is 0 um/s; it must be above 0"),
        ({"acceleration": -2.0}, r"acceleration is -2 um/s\^2; it must be above 0"),
        ({"noise": -0.1}, "noise is -0.1 um; it must be at least 0"),
        ({"noise": np.nan}, "noise is nan; it must be a number"),
        (
            {"lower": 5.0, "upper": 5.0},
            "lower is 5 V and upper 5 V; lower must be below upper",
        ),
        ({"track": " ,"}, "track names no reference, as SIN10,PWSW40"),
        ({"track": "SIN"}, "track: SIN has no frequency; SIN10 has 10 Hz"),
        ({"track": "SINE10"}, "signal 'SINE10' is unknown; it must be one of SIN"),
        ({"slew_rate": -1.0}, "slew_rate is -1 V/s; it must be at least 0"),
        ({"scale": -1.0}, "scale is -1 V/um; it must be at least 0"),
        (
            {"lowest": 3.0, "highest": 2.0},
            "lowest is 3 um and highest 2 um; lowest must be below highest",
        ),
        ({"controller": "pid"}, "'pid' is unknown; there are inversion_slid"),
        (
            {"amplitude": 4.0, "offset": 1.0},
            r"the references cover 1 to 9 um \(offset to offset \+ 2 amplitude\), the "
            "measured stage .* um: change amplitude or offset, or measure the whole",
        ),
    ],
)
def test_impossible_answers_are_refused(record, given, message):
    loaded = read_record(record, time="time_s", input=1, output=2)
    with pytest.raises(ValueError, match=message):
        planned(loaded, given)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, None),
        ({"upper": 76.0}, None),
        ({"upper": 90.0}, "the voltage may reach .* to 90 V, but the record covers"),
        ({"lower": -9.0}, "outside it the model extrapolates"),
        ({"noise": 1.0}, "a noise of 1 um rms is .* % of the recorded span: is it in"),
        ({"noise": 0.25}, "shows a noise of about 0.0.* um rms, and 0.25 um are"),
        ({"noise": 0.0}, "the record shows a noise of about 0.0.* um rms, more than"),
    ],
)
def test_answers_that_the_record_contradicts_are_doubted(record, given, message):
    loaded = read_record(record, time="time_s", input=1, output=2)
    found = doubts(planned(loaded, given), Shown.by_record(loaded))
    if message is None:
        assert found == []
    else:
        (doubt,) = found
        assert re.search(message, doubt)


def test_a_record_that_was_smoothed_is_doubted(record):
    loaded = read_record(record, time="time_s", input=1, output=2)
    low_pass = scipy.signal.butter(4, 0.05, output="sos")
    smoothed = scipy.signal.sosfilt(low_pass, loaded.output - loaded.output[0])
    quiet = Record(loaded.input, loaded.output[0] + smoothed, loaded.dt)
    (doubt,) = doubts(planned(quiet, {}), Shown.by_record(quiet))
    assert "less than that of any sensor: if the displacement was smoothed" in doubt


def test_the_study_holds_the_answers_and_fits_the_record(record, tmp_path):
    plan = Plan(
        0.0, 80.0, 0.02, 2.0, "SIN2, SCAN4", 1.0, 2.0, 50.0, 4e3, "inversion_pid"
    )
    columns = {"time": "time_s", "input": "command_V", "output": "sensor_um"}
    plant = plant_of_record(record, columns, tmp_path, model="lag")
    text = first_study(plan, plant, 1e3, seed=4)
    path = tmp_path / "study.toml"
    path.write_text(text, encoding="utf-8")
    study = load(path)
    assert study.seed == 4
    assert (study.actuator.lower, study.actuator.upper) == (0.0, 80.0)
    assert study.references.tune == ("SIN2", "SCAN4")
    # Two samples of delay may be hidden in a record that was saved early.
    assert study.limits == {"sensitivity_peak": 2.0, "delay_margin": 2.0}
    # SCAN4 is tuned on, so it is not unseen.
    assert study.references.unseen == ("SIN4",)
    assert (study.references.duration, study.references.settle) == (1.5, 0.5)
    stages = []
    progress = SimpleNamespace(
        stage=lambda text, steps=0: stages.append(text), advance=lambda *_: None
    )
    case = build(study, path, progress=progress)
    assert case.fit.record.source == "record.csv"
    assert "controller.controller.feedback.integral" in case.space.paths
    limited = case.loop.controller
    assert (limited.slew, limited.acceleration) == (50.0, 4e3)
    # The fit of the plant reports its progress.
    assert any(text.startswith("fitting from") for text in stages)


def test_the_voltage_stays_as_slow_as_in_the_record_or_as_given(record):
    loaded = read_record(record, time="time_s", input=1, output=2)

    def actuator(**given):
        text = first_study(planned(loaded, given), {"record": "record.csv"}, 1e3)
        return tomllib.loads(text)["actuator"]

    assert actuator()["slew_rate"] == pytest.approx(loaded.slews[0], rel=1e-3)
    assert actuator(slew_rate=5e3)["slew_rate"] == 5e3
    assert "slew_rate" not in actuator(slew_rate=0.0)


LIMITS = {"lower": -20.0, "upper": 120.0, "noise": 2e-3}


def mode_response(gain=0.1):
    """Return the response of a mode at 300 Hz from 1 Hz to 2 kHz, in um/V."""
    frequency = np.geomspace(1.0, 2000.0, 200)
    ratio = frequency / 300.0
    return FrequencyResponse(frequency, gain / (1.0 - ratio**2 + 0.1j * ratio))


@pytest.mark.parametrize("gain", [0.1, -0.1])
def test_a_response_and_the_limits_give_the_range(gain):
    shown = Shown.by_response(mode_response(gain), 1e-4, LIMITS)
    low, high = sorted((-20.0 * gain, 120.0 * gain))
    assert shown.outputs == pytest.approx((low, high), rel=1e-3)
    plan = planned_by(shown, LIMITS)
    assert (plan.lower, plan.upper, plan.noise) == (-20.0, 120.0, 2e-3)
    assert plan.amplitude == pytest.approx(0.2 * 14.0, rel=1e-3)
    assert plan.offset + plan.amplitude == pytest.approx(50.0 * gain, rel=1e-3)
    assert (plan.frequency, plan.slew_rate) == (10.0, 0.0)
    assert doubts(plan, shown) == []
    assert "is it in um" in doubts(replace(plan, noise=1.0), shown)[0]


def test_the_hysteresis_of_a_stage_replaces_the_typical_one():
    shown = Shown.by_response(mode_response(), 1e-4, LIMITS)
    assert shown.hysteresis == 0.15
    for width in (0.0, 0.03):
        plan = planned_by(shown, LIMITS | {"hysteresis": width})
        assert f"\nhysteresis = {width}\n" in first_study(plan, {"response": "r"}, 1e4)
    for wrong in (-0.1, 0.5):
        with pytest.raises(ValueError, match=f"hysteresis is {wrong:g}; the width of"):
            planned_by(shown, LIMITS | {"hysteresis": wrong})
    plan = planned_by(replace(shown, hysteresis=None), LIMITS)
    assert "[disturbance]" not in first_study(plan, {"record": "r.csv"}, 1e4)


def test_a_response_without_limits_is_refused():
    with pytest.raises(ValueError, match="not show these: give --lower and --noise"):
        Shown.by_response(mode_response(), 1e-4, {"upper": 3.0})


def test_the_study_of_a_response_fits_it(tmp_path):
    path = tmp_path / "bench.csv"
    save_response(mode_response(), path)
    plan = planned_by(Shown.by_response(mode_response(), 1e-4, LIMITS), LIMITS)
    plant = plant_of_response(path, tmp_path, unit="um/V", held=True)
    assert plant == {"response": "bench.csv", "unit": "um/V", "held": True}
    text = first_study(plan, plant, 1e4)
    file = tmp_path / "study.toml"
    file.write_text(text, encoding="utf-8")
    case = build(load(file), file)
    assert case.response is not None
    assert case.study.title == "inversion_sliding_mode on the stage of bench.csv"
    assert case.study.disturbance.hysteresis == case.assumed_hysteresis == 0.15
    assert case.study.rate == 1e4
    assert "controller.controller.feedback.law.integral" in case.space.paths


DEVICE_PLAN = Plan(
    0.0, 80.0, 0.02, 2.0, "SIN2", 1.0, 2.0, 50.0, 4e3, "nv200", 5.0, -1.0, 9.0
)


@pytest.mark.parametrize(
    ("device", "parameter"), [("nv200", "ki"), ("e727", "integral_time")]
)
def test_the_study_of_a_device_runs_at_its_rate(record, tmp_path, device, parameter):
    plan = replace(DEVICE_PLAN, controller=device)
    columns = {"time": "time_s", "input": "command_V", "output": "sensor_um"}
    columns["resample"] = 2e4
    plant = plant_of_record(record, columns, tmp_path, model="lag")
    text = first_study(plan, plant, 2e4)
    path = tmp_path / "study.toml"
    path.write_text(text, encoding="utf-8")
    case = build(load(path), path)
    assert case.study.rate == 20_000.0
    assert len(case.fit.record.input) == pytest.approx(3000 * 20, rel=1e-3)
    controller = case.loop.controller
    assert (type(controller).__name__.lower(), controller.scale) == (device, 5.0)
    assert f"controller.{parameter}" in case.space.paths
    ranges = case.space.ranges()
    (notch,) = (path for path in ranges if "notchf" in path or "frequency" in path)
    start = float(getattr(controller, notch.rpartition(".")[2]))
    found = ranges[notch].lower, ranges[notch].upper
    assert found == pytest.approx((start / 1.5, 1.5 * start), abs=1.0)
    if device == "nv200":
        assert (controller.posmin, controller.posmax) == (-1.0, 9.0)
        # 50 um/s of 10 um are 0.5 % a millisecond.
        assert controller.sr == pytest.approx(0.5)


def test_a_record_at_another_rate_than_the_device_is_refused(tmp_path):
    message = "the record has 16000 Hz, the device 20000 Hz: record at that rate"
    with pytest.raises(ValueError, match=message):
        first_study(DEVICE_PLAN, {"record": "r.csv"}, 16e3)
    message = "--rate is 16000 Hz, but the device has 20000 Hz"
    with pytest.raises(ValueError, match=message):
        first_study(DEVICE_PLAN, {"response": "r.csv"}, 16e3)


@pytest.mark.parametrize("structure", [None, "parallel"])
def test_the_study_of_an_e727_holds_its_structure(record, structure):
    loaded = read_record(record, time="time_s", input=1, output=2)
    shown = Shown.by_record(loaded)
    given = {"controller": "e727", "scale": 2.0, "structure": structure}
    plan = planned(loaded, given)
    table = tomllib.loads(first_study(plan, {"record": "r.csv"}, 2e4))["controller"]
    assert table["structure"] == (structure or "unknown")
    found = doubts(plan, shown)
    assert len(found) == (structure is None)
    assert not found or "docs/devices.md) and give it as --structure" in found[0]
    plan = planned(loaded, given | {"controller": "nv200", "structure": None})
    assert "structure" not in first_study(plan, {"record": "r.csv"}, 2e4)
    with pytest.raises(ValueError, match="structure is 'both'; it must be one of"):
        planned(loaded, given | {"structure": "both"})


def test_a_device_without_a_scale_is_doubted_or_refused(record, tmp_path):
    loaded = read_record(record, time="time_s", input=1, output=2)
    shown = Shown.by_record(loaded)
    (doubt,) = doubts(planned(loaded, {"controller": "nv200"}), shown)
    assert "--controller nv200, with a record of error and voltage" in doubt
    assert doubts(planned(loaded, {"controller": "nv200", "scale": 2.0}), shown) == []
    plan = replace(DEVICE_PLAN, controller="e727", scale=0.0)
    with pytest.raises(ValueError, match="the E-727 needs the scale of its gains"):
        first_study(plan, {"record": "r.csv"}, 2e4)


@pytest.mark.parametrize("title", ['"quoted" \\ back', "um ä µ"])
def test_names_of_files_are_quoted(tmp_path, title):
    plan = Plan(0.0, 80.0, 0.02, 2.0, "SIN2", 1.0, 2.0, 50.0, 4e3)
    text = first_study(plan, plant_of_record(tmp_path / title, {}, tmp_path), 1e3)
    assert tomllib.loads(text)["plant"]["record"] == title


_SCORES = Scores(
    per_reference_rms_um={},
    geomean_rms_um=1.0,
    worst_rms_um=1.0,
    peak_error_um={},
    saturated_percent={},
    peak_voltage_V=1.0,
)

RESULT = Result(
    **dict.fromkeys(("study", "title", "method"), "none"),
    status="converged",
    **dict.fromkeys(("before", "after", "holdout_before", "holdout"), _SCORES),
    **dict.fromkeys(("unseen_before", "unseen")),
    **dict.fromkeys(("evaluations", "compile_s", "wall_s", "seed"), 0),
    gains={},
    start={},
    at_bound=[],
    warnings=[],
    history=[],
    versions={},
)


class Verbs:
    """Stand-ins of tune and export that record their calls."""

    def __init__(self, **result):
        self.calls, self.found = [], result
        self.exported = result.pop("exported", [])

    def tune(self, study, out, seed, baselines, console, *, sliders):
        assert sliders  # the default of the command
        self.calls.append(("tune", out.name))
        if self.found.pop("stopped", False):
            raise KeyboardInterrupt
        result = RESULT.model_copy(update=self.found)
        out.mkdir(parents=True)
        (out / "result.json").write_text(result.model_dump_json(), encoding="utf-8")
        known = load(study)
        contents = contents_of(known, study.parent)
        about = About(study_sha256=sha256_of(known, contents))
        save(PID(0.1, 1.0, dt=1e-3), out / "gains.toml", about)
        (out / "report.html").touch()
        return SimpleNamespace(result=result, case=None, holdout=None)

    def export(self, source, console, *, to, study, out, runs):
        self.calls.append(("export", source.name, to))
        out.mkdir()
        (out / "Makefile").touch()
        report = ExportReport(written="double", alarms=self.exported)
        write_report(out / "report.json", report)
        (out / "report.html").touch()
        return self.exported


@pytest.fixture
def run(monkeypatch, record, tmp_path):
    """Return a start with stand-ins: exit status, output, calls of the verbs."""

    def started(*options, answers=None, record=record, **result):
        verbs = Verbs(**result)
        monkeypatch.setattr(start, "tune_study", verbs.tune)
        monkeypatch.setattr(start, "export_file", verbs.export)
        monkeypatch.setattr(
            "piezojax.tuning.exported_runs.make_runs", lambda case, holdout: None
        )
        out = ["--out", str(tmp_path / "out")]
        found = CliRunner().invoke(
            start.main, [str(record), *out, *options], input=answers
        )
        return found.exit_code, found.output, verbs.calls

    return started


def test_a_start_without_questions_tunes_and_exports(run, tmp_path):
    status, output, calls = run("--yes", "--upper", "60")
    assert status == 0, output
    assert calls == [("tune", "tuned"), ("export", "tuned", "c")]
    assert "input 'command_V' from" in output
    assert "upper limit of the voltage [V]: 60.0" in output
    assert "done: gains and pictures in" in output
    study = load(tmp_path / "out" / "study.toml")
    assert study.actuator.upper == 60.0
    assert set(study.limits) == {"sensitivity_peak", "delay_margin"}


def test_the_questions_of_a_device_are_asked_for_it_alone(run, tmp_path):
    answers = 9 * "\n" + "nv200\n2.5\n\n12\n"
    status, output, calls = run("--resample", "20000", answers=answers)
    assert status == 0, output
    assert calls == [("tune", "tuned"), ("export", "tuned", "vendor")]
    assert f"values in {tmp_path / 'out' / 'controller'}" in output
    table = load(tmp_path / "out" / "study.toml").controller
    assert (table["design"], table["scale"], table["range"][1]) == ("nv200", 2.5, 12.0)


def test_other_controllers_have_no_questions_of_devices(run):
    status, output, _ = run("--yes")
    assert status == 0, output
    assert "scale of the gains" not in output


def test_answers_are_asked_for_with_defaults(run, tmp_path):
    answers = "\n80\n900\n\n3\n\n0.5\n\n70\ninversion_pid\n8000\n"
    status, output, _ = run(answers=answers)
    assert status == 0, output
    assert "references to track, with their frequencies in Hz [SIN3,PWSW12]:" in output
    study = load(tmp_path / "out" / "study.toml")
    assert study.actuator.upper == 80.0
    assert study.actuator.slew_rate == 900.0
    assert study.references.tune == ("SIN3", "PWSW12")
    assert study.references.amplitude == 0.5
    assert study.controller == {
        "type": "LimitedReference",
        "slew": 70.0,
        "acceleration": 8000.0,
        "dt": 1e-3,
        "controller": {"design": "inversion_pid"},
    }


def test_a_question_is_asked_again_after_a_refused_answer(run, tmp_path):
    answers = "\n0\n80\n\n\n3\nSIN\n\n0.5\n\n\n\n\n"
    status, output, _ = run(answers=answers)
    assert status == 0, output
    assert "upper 0 V; lower must be below upper\nupper limit of" in output
    assert "track: SIN has no frequency; SIN10 has 10 Hz\nreferences to" in output
    study = load(tmp_path / "out" / "study.toml")
    assert (study.actuator.upper, study.references.tune[0]) == (80.0, "SIN3")


def test_without_an_answer_nothing_is_written(run, tmp_path):
    status, output, calls = run(answers="1\n")
    assert status == 1
    assert "no answer for the upper limit of the voltage [V]: give it as --upper" in (
        output
    )
    assert calls == []
    assert not (tmp_path / "out").exists()


def test_gains_with_an_alarm_are_not_exported(run):
    status, output, calls = run("--yes", alarms=["it rings"])
    assert status == 3
    assert calls == [("tune", "tuned")]
    assert "not exported because of the alarms" in output


def test_an_interrupted_start_goes_on(run, tmp_path):
    status, output, calls = run("--yes", stopped=True)
    assert status == 130
    assert calls == [("tune", "tuned")]
    assert f"to go on: python -m piezojax.start {tmp_path}"[:40] in output
    status, output, calls = run("--yes", status="interrupted")
    assert status == 130
    assert calls == [("tune", "tuned")]
    assert "interrupted; to go on: python -m piezojax.start" in output
    # The interrupted gains are kept; the search begins again beside them.
    status, output, calls = run("--yes")
    assert status == 0
    assert f"going on in {tmp_path / 'out'} with its study.toml" in output
    assert calls == [("tune", "tuned-2"), ("export", "tuned-2", "c")]
    status, output, calls = run()
    assert (status, calls) == (0, [])
    assert "tuned before: the gains are in" in output
    assert "exported before:" in output


@pytest.mark.parametrize("lost", ["report.html", "gains.toml", "result.json"])
def test_a_killed_search_is_tuned_again(run, tmp_path, lost):
    """Its page, which is written last, is missing, and maybe its numbers, too."""
    run("--yes", alarms=["it rings"])
    for name in {lost, "report.html"}:
        (tmp_path / "out" / "tuned" / name).unlink()
    status, output, calls = run("--yes")
    assert (status, calls) == (0, [("tune", "tuned-2"), ("export", "tuned-2", "c")])
    page = tmp_path / "out" / "tuned-2" / "report.html"
    assert f"page with the results: {page}\n" in output
    status, output, calls = run("--yes")
    assert (status, calls) == (0, [])
    assert f"exported before: {tmp_path / 'out' / 'controller-2'}\n" in output


def test_a_killed_export_is_exported_again(run, tmp_path):
    run("--yes")
    (tmp_path / "out" / "controller" / "report.html").unlink()
    status, output, calls = run("--yes")
    assert (status, calls) == (0, [("export", "tuned", "c")])
    assert "exported before" not in output
    assert (tmp_path / "out" / "controller" / "report.html").is_file()
    assert (tmp_path / "out" / "controller-unfinished" / "Makefile").is_file()


def test_alarms_of_an_export_are_printed_again(run, tmp_path):
    alarm = "the compiled controller diverges"
    status, output, _ = run("--yes", exported=[alarm])
    assert status == 3
    assert "done: gains and pictures in" in output
    status, output, calls = run("--yes")
    assert (status, calls) == (3, [])
    assert f"ALARM: {alarm}" in output


def test_a_changed_study_is_tuned_again(run, tmp_path):
    run("--yes")
    path = tmp_path / "out" / "study.toml"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("steps = 80", "steps = 81"), encoding="utf-8")
    status, _, calls = run()
    assert (status, calls) == (0, [("tune", "tuned-2"), ("export", "tuned-2", "c")])
    assert (tmp_path / "out" / "controller-2" / "Makefile").is_file()
    # the first answers again: their gains are there
    path.write_text(text, encoding="utf-8")
    status, output, calls = run()
    assert (status, calls) == (0, [])
    assert f"the gains are in {tmp_path / 'out' / 'tuned'}\n" in output


def test_a_changed_record_is_tuned_again(run, tmp_path, record):
    run("--yes")
    content = record.read_bytes()
    try:
        record.write_bytes(content + b"3.0,10.0,1.0\n")
        status, output, calls = run("--yes")
    finally:
        record.write_bytes(content)
    assert (status, calls) == (0, [("tune", "tuned-2"), ("export", "tuned-2", "c")])
    assert "note: study.toml or its record has changed since tuned; the values" in (
        output
    )
    status, output, calls = run("--yes")
    assert (status, calls) == (0, [])
    assert f"the gains are in {tmp_path / 'out' / 'tuned'}\n" in output


def test_the_same_command_goes_on(run):
    options = "--yes", "--upper", "60", "--controller", "inversion_pid", "--seed", "2"
    _, _, calls = run(*options)
    assert len(calls) == 2
    status, output, calls = run(*options)
    assert (status, calls) == (0, [])
    assert "tuned before: the gains are in" in output


def test_answers_to_a_study_that_is_written_are_refused(run, tmp_path, record):
    run("--yes")
    status, output, calls = run("--upper", "50", "--seed", "3")
    assert (status, calls) == (1, [])
    assert "was written before and does not follow --upper, --seed: edit it, or" in (
        output
    )
    other = tmp_path / "other.csv"
    other.write_bytes(record.read_bytes())
    out = ["--out", str(tmp_path / "out")]
    printed = CliRunner().invoke(start.main, [str(other), *out])
    assert printed.exit_code == 1
    assert f"does not follow {other}: edit it" in printed.output
    path = tmp_path / "out" / "study.toml"
    table = re.compile(r"\[plant\].*?\n\n", re.DOTALL)
    model = '[plant]\nfile = "model.json"\n\n'
    path.write_text(table.sub(model, path.read_text(encoding="utf-8")))
    status, output, calls = run()
    assert (status, calls) == (1, [])
    assert f"does not follow {record}: edit it" in output


def test_alarms_of_earlier_gains_are_printed_again(run):
    run("--yes", alarms=["it rings"])
    status, output, calls = run("--yes")
    assert (status, calls) == (3, [])
    assert "ALARM: it rings" in output


@pytest.fixture
def response(tmp_path):
    path = tmp_path / "bench.csv"
    save_response(mode_response(), path)
    return path


LIMITED = "--lower", "-20", "--upper", "120", "--noise", "0.002"


def test_a_start_from_a_response_tunes_and_exports(run, response, tmp_path):
    options = "--response", "--rate", "10000", "--yes", *LIMITED
    status, output, calls = run(*options, record=response)
    assert status == 0, output
    assert calls == [("tune", "tuned"), ("export", "tuned", "c")]
    assert f"read {response}: 200 lines from 1 to 2000 Hz" in output
    gain = abs(mode_response().values[0])
    assert f"with a gain of {gain:.4g} um/V at the lowest" in output
    plant = load(tmp_path / "out" / "study.toml").plant
    assert plant == {"response": "../bench.csv"}
    for again in (options, ("--response",), ()):
        status, output, calls = run(*again, record=response)
        assert (status, calls) == (0, [])
        assert "tuned before: the gains are in" in output
    status, output, _ = run("--response", "--rate", "9000", *LIMITED, record=response)
    assert status == 1
    assert "does not follow --rate, --lower, --upper, --noise: edit it" in output


def test_what_a_response_does_not_show_is_asked_first(run, response, tmp_path):
    answers = "-20\n120\n0.002\n\n\n5\n"
    options = "--response", "--rate", "10000"
    status, output, _ = run(*options, record=response, answers=answers + 9 * "\n")
    assert status == 0, output
    assert "lower limit of the voltage [V]: -20\nupper limit" in output
    study = load(tmp_path / "out" / "study.toml")
    assert (study.actuator.lower, study.sensor.noise_rms) == (-20.0, 0.002)
    assert study.references.tune == ("SIN5", "PWSW20")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "--response needs a --rate: that of the controller, Hz"),
        (("--rate", "1e4", "--yes"), "give --lower and --upper and --noise"),
        (
            ("--rate", "1e4"),
            "no answer for the lower limit of the voltage [V]: give it",
        ),
        (("--input", "0"), "--input is for a record over time, not for a --response"),
        (("--model", "lag"), "--model is for a record over time, not for a --resp"),
        (("--rate", "1e4", "--unit", "V"), "is in um/V, and the unit given is V"),
    ],
)
def test_bad_options_of_a_response_are_refused(run, response, options, message):
    status, output, calls = run("--response", *options, record=response)
    assert (status, calls) == (1, [])
    assert message in output


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--held",), "--held needs --response"),
        (("--hysteresis", "0.1"), "--hysteresis needs --response"),
        (("--controller", "pid"), "'pid' is unknown; there are inversion_sliding_mode"),
        (("--frequency", "-1"), "frequency is -1 Hz; it must be above 0"),
        (("--lower", "9", "--upper", "3"), "lower is 9 V and upper 3 V; lower must"),
        (("--input", "none"), "input column 'none' is missing; there are time_s"),
    ],
)
def test_bad_options_are_refused_in_one_line(run, tmp_path, options, message):
    status, output, calls = run("--yes", *options)
    assert (status, calls) == (1, [])
    assert message in output.splitlines()[-1]
    assert not (tmp_path / "out").exists()


def test_a_folder_with_other_results_is_not_touched(run, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "notes.txt").touch()
    status, output, calls = run("--yes")
    assert (status, calls) == (1, [])
    assert "already holds results; name a new folder" in output
