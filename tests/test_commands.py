"""The commands with their arguments."""

import csv
import dataclasses
import hashlib
import html
import io
import json
import re
import signal
import subprocess
import sys

import pytest
from golden import golden_vectors
from page_reader import checked
from rich.console import Console
from rich.table import Table
from small_runs import (
    COLUMNS,
    call,
    main_of,
    succeeded,
    write_model,
    write_record,
    write_study,
)

import piezojax as pj
from piezojax.analysis.stability import OperatingPoint
from piezojax.cli.command import results_folder
from piezojax.cli.reproduce import NAMES
from piezojax.cli.terminal import Bar, console
from piezojax.core.paths import replace
from piezojax.core.registry import parts
from piezojax.identification.chain import DEFAULT
from piezojax.identification.estimators.estimate import Options
from piezojax.report.tuning_tables import tuning_table
from piezojax.reproduction import TABLES
from piezojax.reproduction.cell import Cell
from piezojax.reproduction.rates import FIGURE, RateError
from piezojax.study import read

COMMANDS = (
    *("tune", "identify", "validate", "export", "start", "excite", "reproduce"),
)
PNG = b"\x89PNG\r\n\x1a\n"


def failed(result, message, code=1):
    """Check that there is one line of error and no traceback."""
    assert result.exit_code == code
    assert isinstance(result.exception, SystemExit)
    assert result.stderr.startswith("Error: ")
    assert result.stderr.count("\n") == 1
    assert result.stderr.endswith("\n")
    assert message in result.stderr
    assert "Traceback" not in result.output


def names(folder):
    return sorted(entry.name for entry in folder.iterdir())


def assert_pictures(folder, *pictures):
    for picture in pictures:
        content = (folder / picture).read_bytes()
        assert content.startswith(PNG)
        assert len(content) > 5_000


@pytest.fixture
def study(tmp_path):
    return write_study(tmp_path)


@pytest.fixture
def record(tmp_path):
    return write_record(tmp_path)


# All commands


@pytest.mark.parametrize("command", COMMANDS)
def test_help(command):
    result = succeeded(call(command, "--help"))
    for option in ("--out", "--seed", "--quiet", "--help"):
        assert option in result.stdout


def test_help_names_the_choices():
    assert "STUDY" in call("tune", "--help").stdout
    assert all(table in call("reproduce", "--help").stdout for table in TABLES)
    text = call("identify", "--help").stdout
    options = ("--time", "--input", "--output", "--rate", "--train", "--validate")
    assert all(option in text for option in (*options, "--model"))


def test_defaults_are_those_of_the_functions():
    """The commands repeat them, so that --help does not import the functions."""
    defaults = {option.name: option.default for option in main_of("identify").params}
    assert defaults["model"] == DEFAULT
    for field in dataclasses.fields(Options):
        if field.default is not None:
            assert defaults[field.name] == field.default
    assert (*TABLES, FIGURE) == NAMES


REFUSED = {
    "tune": ["nowhere.csv"],
    "identify": ["nowhere.csv"],
    "sweep": ["nowhere.csv"],
    "validate": ["nowhere.json", "nowhere.csv"],
    "export": ["nowhere.toml"],
    "start": ["nowhere.csv", "--yes"],
    "excite": ["--lower", "0", "--upper", "1", "--rate", "0"],
    "reproduce": ["--table", "9-9"],
    "trial": ["nowhere", "--stage", "127.0.0.1:1"],
    "watch": ["nowhere", "--stage", "127.0.0.1:1"],
    "retune": ["nowhere.toml", "--stage", "127.0.0.1:1"],
    "learn": ["nowhere", "--stage", "127.0.0.1:1"],
    "emulate": ["nowhere.toml"],
}
"""Arguments that each command refuses."""

IN_TURN = """
import runpy, sys
for command, *arguments in {commands!r}:
    sys.argv = [command, *arguments]
    try:
        runpy.run_module(f"piezojax.{{command}}", run_name="__main__")
    except SystemExit as stop:
        print("status of", command, stop.code)
"""


def test_python_m_returns_status_and_one_line():
    # as in a shell: exit status, one line, no traceback
    assert set(COMMANDS) <= set(REFUSED)
    commands = [(command, *arguments) for command, arguments in REFUSED.items()]
    done = subprocess.run(
        [sys.executable, "-c", IN_TURN.format(commands=commands)],
        capture_output=True,
        text=True,
    )
    for command in REFUSED:
        assert f"status of {command} 1" in done.stdout.splitlines()
    lines = done.stderr.splitlines()
    assert len(lines) == len(REFUSED)
    assert all(line.startswith("Error: ") for line in lines)


def arguments_for(command, request):
    if command == "tune":
        return [request.getfixturevalue("study")]
    if command == "identify":
        return [request.getfixturevalue("record"), *COLUMNS]
    if command == "validate":
        record = request.getfixturevalue("record")
        return [write_model(record.parent), record, *COLUMNS]
    if command == "start":
        return [request.getfixturevalue("record"), *COLUMNS, "--yes"]
    if command == "excite":
        return ["--lower", "0", "--upper", "1", "--rate", "1000"]
    if command == "export":
        return [write_model(request.getfixturevalue("tmp_path_factory").mktemp("m"))]
    return ["--table", "5-3"]


@pytest.mark.parametrize("command", COMMANDS)
def test_a_used_folder_is_refused(command, request, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "result.json").write_text("mine")
    result = call(command, *arguments_for(command, request), "--out", out)
    failed(result, f"--out {out} already holds results; name a new folder")
    assert (out / "result.json").read_text() == "mine"
    assert names(out) == ["result.json"]


@pytest.mark.parametrize("command", COMMANDS)
def test_a_folder_that_cannot_be_written_is_refused(command, request, tmp_path):
    # Not even root can create a folder under a file.
    (tmp_path / "file").write_text("mine")
    out = tmp_path / "file" / "sub"
    result = call(command, *arguments_for(command, request), "--out", out)
    failed(result, f"--out {out} cannot be written: Not a directory")


@pytest.mark.parametrize("command", COMMANDS)
def test_a_file_in_place_of_the_folder_is_refused(command, request, tmp_path):
    (tmp_path / "out").write_text("mine")
    result = call(command, *arguments_for(command, request), "--out", tmp_path / "out")
    failed(result, "cannot be written: File exists")
    assert (tmp_path / "out").read_text() == "mine"


# validate


def test_validate_writes_a_checked_model(tmp_path):
    record = write_record(tmp_path, late=1)
    model, out = write_model(tmp_path), tmp_path / "out"
    printed = succeeded(call("validate", model, record, *COLUMNS, "--out", out)).stdout
    assert names(out) == [
        *("model.json", "report.html", "validation.json", "validation.png"),
    ]
    assert "bench.csv" in checked(out / "report.html").cells
    assert_pictures(out, "validation.png")
    assert "input 'drive_V' from 0 to 39.84 V; output 'sensor_um'" in printed
    assert "% of span" in printed
    pj.load(out / "model.json")
    about = pj.read_about(out / "model.json")
    assert about.record == "first.csv"
    assert about.checked == ["bench.csv"]
    found = json.loads((out / "validation.json").read_text(encoding="utf-8"))
    (check,) = found["records"]
    assert check["zero"] == pytest.approx([4.0], abs=0.01)
    assert f"{check['zero'][0]:.3g} um" in checked(out / "report.html").cells
    assert found["alarms"] == []


def test_validate_ends_with_an_alarm_for_another_stage(tmp_path):
    record = write_record(tmp_path, late=1)
    model, out = write_model(tmp_path, gain=0.03), tmp_path / "out"
    result = call("validate", model, record, *COLUMNS, "--out", out)
    assert result.exit_code == 3
    assert "ALARM: bench.csv: the model does not hold on this record" in result.stdout
    with pytest.raises(ValueError, match="a model of another stage"):
        pj.load(out / "model.json")
    again = call(
        "validate",
        out / "model.json",
        record,
        *COLUMNS,
        "--quiet",
        "--out",
        tmp_path / "again",
    )
    assert again.exit_code == 3
    assert again.stdout == ""
    assert "ALARM" in again.stderr


def test_validate_bad_arguments(record, tmp_path):
    model = write_model(tmp_path)
    failed(call("validate", model), "Missing argument 'RECORD...'")
    failed(call("validate", model, "no.csv"), "No such file or directory")
    failed(
        call("validate", model, record, *COLUMNS, "--estimate", "9"),
        "'9' must be two sample numbers, as in 0:1200",
    )
    failed(
        call("validate", model, record, *COLUMNS, "--estimate", "0:300"),
        "estimate is 0:300; it must lie in 0:299",
    )


# export


def test_export_writes_the_tuned_controller_with_its_limits(tuned, tmp_path):
    out = tmp_path / "c"
    printed = succeeded(call("export", tuned[1], "--out", out)).stdout
    made = ["Makefile", "controller.c", "controller.h", "test_controller.c"]
    assert names(out) == sorted([*made, "vectors.csv", "report.json", "report.html"])
    assert "cost of float" in printed
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert report["written"] == "double"
    assert list(report["references"]) == ["SIN50", "SW50"]
    page, result = checked(out / "report.html"), pj.load_result(tuned[1])
    for name, cost in report["references"].items():
        promised = 1e3 * result.holdout.per_reference_rms_um[name]
        assert cost["rms"]["double"] == pytest.approx(promised, rel=1e-6)
    assert f"{report['references']['SIN50']['rms']['double']:.4g} nm" in page.cells
    assert abs(report["references"]["SIN50"]["percent"]["float"]) < 1.0
    assert f"make -C {out} test" in printed
    text = (out / "controller.c").read_text(encoding="utf-8")
    assert "Study: small, seed 3." in text
    written = (tuned[1] / "study.toml").read_bytes()
    assert f"SHA-256 of the study: {hashlib.sha256(written).hexdigest()}." in text
    assert re.search(r"parameters.actuator_\w*lower = -20.0;", text)
    assert re.search(r"parameters.actuator_\w*upper = 120.0;", text)
    assert "Judged: tuned loop: sensitivity peak" in text
    assert "Plants: the nominal one only." in text
    columns = golden_vectors(out).T
    references = pj.read_about(tuned[1] / "gains.toml").reference_ranges[0]
    assert columns[0].min() < references[0]
    assert columns[0].max() > references[1]


def test_export_of_a_loop_that_diverges_ends_with_status_3(tuned, tmp_path):
    """The gains were changed by hand, and no limit of the voltage bounds them."""
    (tmp_path / "study.toml").write_bytes((tuned[1] / "study.toml").read_bytes())
    path, tuned_gains = tmp_path / "gains.toml", tuned[1] / "gains.toml"
    loose = replace(pj.load(tuned_gains), {"proportional": 1e6})
    pj.save(loose, path, pj.read_about(tuned_gains))
    out, limits = tmp_path / "c", ("--limits", "-1e300", "1e300")
    result = call("export", path, "--out", out, *limits)
    assert result.exit_code == 3
    assert "ALARM: the compiled controller diverges in the simulat" in result.stdout
    assert "report.html" in names(out)


def test_export_beside_another_study_is_not_judged(tuned, tmp_path):
    for name in ("gains.toml", "study.toml"):
        (tmp_path / name).write_bytes((tuned[1] / name).read_bytes())
    other = (tmp_path / "study.toml").read_text().replace("seed = 3", "seed = 3\n# a")
    (tmp_path / "study.toml").write_text(other)  # a comment changes nothing
    result = succeeded(call("export", tmp_path / "gains.toml", "--out", tmp_path / "a"))
    assert "note: not judged" not in result.stdout
    (tmp_path / "study.toml").write_text(other.replace("SW50", "SW40"))
    result = succeeded(call("export", tmp_path / "gains.toml", "--out", tmp_path / "b"))
    assert "is not the study of" in result.stdout
    assert "report.json" not in names(tmp_path / "b")


def test_export_without_its_study_is_not_judged(tuned, tmp_path):
    path = tmp_path / "gains.toml"
    path.write_bytes((tuned[1] / "gains.toml").read_bytes())
    result = call("export", path, "--out", tmp_path / "c", "--precision", "float")
    assert "note: not judged in the simulated loop: study" in succeeded(result).stdout
    assert "report.json" not in names(tmp_path / "c")
    about = pj.read_about(path).model_copy(update={"rate_Hz": 1e4})
    pj.save(pj.load(path), path, about)
    study = tuned[1] / "study.toml"
    result = call("export", path, "--out", tmp_path / "d", "--study", study)
    failed(result, "is for 20000 Hz, the controller for 10000 Hz")


def test_export_of_a_model_needs_no_limits(tmp_path):
    out = tmp_path / "c"
    succeeded(call("export", write_model(tmp_path), "--out", out, "--name", "lag"))
    assert "Record: first.csv." in (out / "lag.h").read_text(encoding="utf-8")


def test_export_compares_the_file_of_a_device(tmp_path):
    path, saved, out = (tmp_path / name for name in ("gains.toml", "old.ini", "x"))
    span = {"avmin": -20.0, "avmax": 130.0, "posmin": 0.0, "posmax": 80.0}
    pj.save(pj.control.NV200(ki=70.0004, **span), path, pj.About(judged=["fine"]))
    saved.write_text("[Device Parameters]\nki = 55.5\n")
    command = ("export", path, "--to", "vendor", "--out", out)
    printed = succeeded(call(*command, "--before", saved)).stdout
    assert names(out) == [
        "controller.ini",
        "controller_parameters.csv",
        f"{saved.name}.backup",
        "report.html",
    ]
    assert "70.000" in checked(out / "report.html").cells
    assert re.search(r"ki +│ +55.5 │ +70.000 │ 1/s +│ integral gain", printed)
    failed(call(*command), f"--out {out} already holds results")
    failed(call(*command[:-1], tmp_path / "y", "--before", path), "no section headers")
    refused = call("export", path, "--before", saved, "--out", tmp_path / "y")
    failed(refused, "before is a file of a device")


def test_export_refuses_gains_with_an_alarm_unless_accepted(tmp_path):
    path = tmp_path / "gains.toml"
    about = pj.About(judged=["fine"], unsafe=["it rings"])
    pj.save(pj.control.PID(0.5, 3000.0, dt=5e-5), path, about)
    out = tmp_path / "c"
    command = ("export", path, "--out", out, "--limits", 0, 1)
    failed(call(*command), "was written with an alarm: it rings")
    assert not out.exists()
    result = call(*command, "--accept-unsafe")
    assert "ALARM: it rings" in succeeded(result).stdout
    assert (out / "controller.h").read_text().startswith("/* UNSAFE: it rings")


# tune


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tuned")
    result = call("tune", write_study(folder), "--out", folder / "out")
    return succeeded(result), folder / "out"


def test_tune_writes_its_results(tuned):
    _, out = tuned
    assert set(names(out)) >= {
        *("result.json", "gains.toml", "study.toml"),
        *("tracking.png", "hysteresis.png", "convergence.png"),
        *("stability.json", "stability.png", "limit.json"),
    }
    assert not [name for name in names(out) if name.startswith(".")]
    assert_pictures(out, "tracking.png", "hysteresis.png", "convergence.png")
    assert_pictures(out, "stability.png")


def test_tune_reports_margins_before_and_after(tuned):
    printed, out = tuned
    found = json.loads((out / "stability.json").read_text(encoding="utf-8"))
    assert set(found) == {"before", "after"}
    lag, drive = (
        pj.dynamics.FirstOrderLag(1e-3, 5e-5),
        pj.hardware.Saturation(-20.0, 120.0),
    )
    loop = pj.Feedback(pj.load(out / "gains.toml"), lag, drive, pj.hardware.Sensor(0.0))
    for branch in ("ascending", "descending"):
        report = found["after"][branch]
        assert report["stable"]
        expected = pj.stability_report(
            loop, OperatingPoint(report["reference_um"], branch)
        )
        assert report["sensitivity_peak"] == pytest.approx(expected.sensitivity_peak)
    assert "delay margin" in printed.stdout


def test_tune_result_and_gains_load(tuned):
    _, out = tuned
    result = pj.load_result(out)
    assert result.status in ("converged", "step limit")
    assert result.study == "small"
    controller = pj.load(out / "gains.toml")
    assert isinstance(controller, pj.control.PID)
    assert float(controller.integral) == result.gains["controller.integral"]
    assert float(controller.proportional) == result.gains["controller.proportional"]
    raw = json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert raw["holdout"]["geomean_rms_um"] < raw["holdout_before"]["geomean_rms_um"]


def test_tune_reports_progress_and_ends_with_a_table(tuned):
    printed, out = tuned
    lines = printed.stdout.splitlines()
    assert lines[:2] == ["loading", "reading small.toml"]
    assert "tuning from 2 starts" in lines
    text = printed.stdout
    for part in ("SIN50", "SW50", "geometric mean", "integral"):
        assert part in text
    assert "results in" in text
    assert "\x1b" not in text  # no colours without a terminal
    assert " ".join(text.split()).endswith(str(out))


def test_the_page_of_tuning_holds_the_figures_of_its_result(tuned):
    printed, out = tuned
    found, result = checked(out / "report.html"), pj.load_result(out)
    for path, value in result.gains.items():
        row = found.cells.index(path.removeprefix("controller."))
        before, after, unit = found.cells[row + 1 : row + 4]
        assert float(before) == pytest.approx(result.start[path], rel=1e-3)
        assert float(after) == pytest.approx(value, rel=1e-3)
        assert unit == result.gain_units[path]
    for name, rms in result.holdout.per_reference_rms_um.items():
        row = found.cells.index(name)
        assert float(found.cells[row + 2]) == pytest.approx(1e3 * rms, abs=0.006)
    report = json.loads((out / "stability.json").read_text(encoding="utf-8"))["after"]
    worst = max(branch["sensitivity_peak"] for branch in report.values())
    row = found.cells.index("tuned", found.cells.index("Ms"))
    assert float(found.cells[row + 1]) == pytest.approx(worst, abs=0.006)
    text = html.unescape((out / "report.html").read_text(encoding="utf-8"))
    notes = [x for x in printed.stdout.splitlines() if x.startswith(("note:", "limit"))]
    assert all(note in text for note in notes)
    assert notes != []
    assert "SHA-256 of the study" in text
    assert "jaxlib" in text


def test_tuned_gains_are_the_start_of_another_search(tuned, tmp_path):
    _, out = tuned
    (tmp_path / "gains.toml").write_bytes((out / "gains.toml").read_bytes())
    case = read(write_study(tmp_path, controller={"file": "gains.toml"}))
    assert float(case.loop.controller.integral) == pytest.approx(
        pj.load_result(out).gains["controller.integral"]
    )


@pytest.mark.usefixtures("undrawn")
def test_quiet_and_seed_without_a_folder(study, monkeypatch):
    monkeypatch.chdir(study.parent)
    used = study.parent / "results" / "small"
    used.mkdir(parents=True)
    (used / "result.json").write_text("mine")
    result = succeeded(call("tune", "small.toml", "--quiet", "--seed", 5))
    assert result.output == ""
    assert (used / "result.json").read_text() == "mine"
    assert names(study.parent / "results") == ["small", "small-2"]
    assert pj.load_result("results/small-2").seed == 5


def test_tune_bad_studies(tmp_path):
    out = ("--out", tmp_path / "out")
    failed(call("tune", "p754", *out), "study 'p754' is unknown; there are ")
    failed(call("tune", tmp_path / "no.toml", *out), "No such file or directory")
    (tmp_path / "a.toml").write_text("title = = 3")
    failed(call("tune", tmp_path / "a.toml", *out), "a.toml is not a TOML file")
    path = write_study(tmp_path, sead=3)
    failed(call("tune", path, *out), "sead is unknown; allowed are title, rate, seed")
    path = write_study(tmp_path, rate=-3.0)
    failed(call("tune", path, *out), "rate is -3.0: Input should be greater than 0")
    path = write_study(tmp_path, plant={"record": "no.csv", "model": "coleman_hodgdon"})
    failed(call("tune", path, *out), "no.csv: No such file or directory")
    failed(call("tune", path, *out, "--quiet"), "no.csv: No such file or directory")


def test_tune_refuses_a_box_of_diverging_loops(tmp_path):
    path = write_study(
        tmp_path,
        actuator={"lower": -1e300, "upper": 1e300},
        parameters={"controller.integral": {"lower": 3e6, "upper": 1e7, "start": 5e6}},
    )
    result = call("tune", path, "--out", tmp_path / "out")
    failed(result, "the loop diverges or stays at a voltage limit at the start and at")


def assert_interrupted(out):
    result = pj.load_result(out)
    assert result.status == "interrupted"
    assert result.holdout.stable
    # So early the search may violate the limits; result.alarms would list them.
    controller = pj.load(out / "gains.toml", accept_unsafe=True)
    assert float(controller.integral) == result.gains["controller.integral"]
    assert {"tracking.png", "hysteresis.png", "report.html"} < set(names(out))
    return result


def test_ctrl_c_during_the_search_keeps_the_best_gains(study, tmp_path, monkeypatch):
    def press(self, best):
        raise KeyboardInterrupt

    monkeypatch.setattr(Bar, "advance", press)
    result = call("tune", study, "--out", tmp_path / "out")
    assert result.exit_code == 130
    printed = " ".join(result.stdout.split())
    assert re.search(r"interrupted after \d+ evaluations", printed)
    assert "Traceback" not in result.output
    assert len(assert_interrupted(tmp_path / "out").history) == 1
    assert_pictures(tmp_path / "out", "tracking.png", "hysteresis.png")


def test_no_column_is_cut_in_a_pipe(capsys, monkeypatch):
    table = Table()
    for cell in ("a" * 70, "b" * 70):
        table.add_column(cell, no_wrap=True)
    monkeypatch.delenv("COLUMNS", raising=False)
    console(quiet=False).print(table)
    assert "a" * 70 + " ┃ " + "b" * 70 in capsys.readouterr().out
    monkeypatch.setenv("COLUMNS", "60")
    console(quiet=False).print(table)
    assert max(map(len, capsys.readouterr().out.splitlines())) == 60


def test_ctrl_c_waits_for_the_next_progress_report():
    with Bar(console(quiet=True)) as bar:
        bar.stage("compiling")
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            bar.advance(1.0)
        bar.stage("judging")  # Ctrl-C acted once, so the gains can be evaluated


@pytest.mark.usefixtures("undrawn")
def test_ctrl_c_during_the_evaluation_loses_nothing(study, tmp_path, monkeypatch):
    stage = Bar.stage

    def press(self, text, steps=0):
        stage(self, text, steps)
        if text.startswith("judging"):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Bar, "stage", press)
    result = call("tune", study, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert pj.load_result(tmp_path / "out").status != "interrupted"
    assert (tmp_path / "out" / "stability.json").exists()


def terminate():
    """Send SIGTERM to a command, as ``timeout`` and batch systems do."""
    signal.raise_signal(signal.SIGTERM)


@pytest.mark.usefixtures("undrawn")
def test_sigterm_acts_as_ctrl_c(study, tmp_path, monkeypatch):
    advance = Bar.advance

    def send(self, best, note=""):
        if not sent:
            sent.append(terminate())
        advance(self, best, note)

    sent = []
    monkeypatch.setattr(Bar, "advance", send)
    before = signal.getsignal(signal.SIGTERM)
    result = call("tune", study, "--out", tmp_path / "out")
    assert result.exit_code == 143
    assert "Traceback" not in result.output
    assert "interrupted after" in " ".join(result.stdout.split())
    assert_interrupted(tmp_path / "out")
    assert signal.getsignal(signal.SIGTERM) == before


def test_the_second_sigterm_has_the_default_handler():
    with Bar(console(quiet=True)) as bar:
        terminate()
        assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
        with pytest.raises(KeyboardInterrupt):
            bar.stage("judging")


def test_reproduce_keeps_finished_tables(made_up, tmp_path, monkeypatch):
    stage = Bar.stage

    def send(self, text, steps=0):
        if text == "simulating Table 5-5":
            terminate()
        stage(self, text, steps)

    monkeypatch.setattr(Bar, "stage", send)
    tables = ("--table", "5-3", "--table", "5-5", "--table", FIGURE)
    result = call("reproduce", *tables, "--out", tmp_path / "out")
    assert result.exit_code == 143
    assert made_up == ["5-3"]
    assert names(tmp_path / "out") == [
        *("cells.csv", "cells.png", "report.html", "summary.json"),
    ]
    assert list(json.loads((tmp_path / "out" / "summary.json").read_text())) == ["5-3"]
    assert "interrupted" in result.stdout


def test_identify_all_keeps_fitted_models(record, tmp_path, monkeypatch):
    advance = Bar.stage

    def send(self, text, steps=0):
        if text.startswith("2 of about"):
            terminate()
        advance(self, text, steps)

    among = ("--model", "all", "--among", "coleman_hodgdon", "--steps", 1)
    command = ("identify", record, *COLUMNS, *among, "--out", tmp_path / "out")
    with monkeypatch.context() as patch:
        patch.setattr(Bar, "stage", send)
        result = call(*command)
    assert result.exit_code == 143, result.output
    report = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert report["interrupted"]
    assert [row["status"] for row in report["rows"]].count("fitted") == 1
    assert pj.load(tmp_path / "out" / "model.json")
    assert not (tmp_path / "out" / "models").exists()
    hint = f"the same command with --out {tmp_path / 'out'} goes on from these fits"
    assert hint in result.stdout
    # The first fit is not repeated.
    again = succeeded(call(*command))
    assert "1 of about" not in again.stdout
    assert "2 of about" in again.stdout
    report = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert not report["interrupted"]
    assert not (tmp_path / "out" / "search").exists()
    refused = call(*command)
    assert refused.exit_code == 1
    assert "out" in refused.stderr


def test_a_folder_in_use_is_refused(study, tmp_path):
    with results_folder(tmp_path / "out", "tune"):
        result = call("tune", study, "--out", tmp_path / "out")
    failed(result, "out is in use by a running command")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_bar_of_a_moving_stage_ends_at_once(number):
    with (
        Bar(console(quiet=True), at_once=True),
        pytest.raises(KeyboardInterrupt),
    ):
        signal.raise_signal(number)


def test_ctrl_c_twice_acts_at_once():
    with Bar(console(quiet=True)):
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_the_handler_of_ctrl_c_is_restored():
    before = signal.getsignal(signal.SIGINT)
    with Bar(console(quiet=True)):
        assert signal.getsignal(signal.SIGINT) != before
    assert signal.getsignal(signal.SIGINT) == before


def test_ctrl_c_before_the_first_result(study, tmp_path, monkeypatch):
    def press(self, text, steps=0):
        raise KeyboardInterrupt

    monkeypatch.setattr(Bar, "stage", press)
    result = call("tune", study, "--out", tmp_path / "out")
    assert result.exit_code == 130
    assert "Traceback" not in result.output


def test_ctrl_c_while_drawing_keeps_the_result(study, tmp_path, monkeypatch):
    def press(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("piezojax.report.tuning_pictures.tracking_figure", press)
    result = call("tune", study, "--out", tmp_path / "out")
    assert result.exit_code == 130
    assert "Traceback" not in result.output
    assert names(tmp_path / "out") == ["gains.toml", "result.json", "study.toml"]
    assert pj.load_result(tmp_path / "out").status == "step limit"


@pytest.mark.slow
def test_a_real_ctrl_c(tmp_path):
    # Long steps, more than the command can take before the signal arrives.
    study = write_study(
        tmp_path,
        references={
            "tune": ["SIN50", "SW50", "PWSW50", "SIN10"],
            "duration": 0.1,
            "settle": 0.05,
        },
        optimiser={"starts": 2, "candidates": 2, "steps": 10_000},
    )
    out = tmp_path / "out"
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "piezojax.tune", str(study), "--out", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with process:
        try:
            for line in process.stdout:
                if line.startswith("tuning from"):
                    break
            process.send_signal(signal.SIGINT)
            printed, complaint = process.communicate(timeout=120)
        finally:
            process.kill()
    assert complaint == ""
    assert "stopping; Ctrl-C again stops at once\n" in printed
    assert process.returncode == 130
    assert "interrupted after" in " ".join(printed.split())
    assert_interrupted(out)


# identify


@pytest.fixture(scope="module")
def identified(tmp_path_factory):
    folder = tmp_path_factory.mktemp("identified")
    record = write_record(folder)
    parts = ("--train", "0:200", "--validate", "220:300")
    arguments = (*COLUMNS, *parts, "--model", "coleman_hodgdon")
    result = call("identify", record, *arguments, "--out", folder / "out")
    return succeeded(result), folder / "out"


def test_identify_writes_its_results(identified):
    _, out = identified
    assert names(out) == [
        *("fit.json", "fit.png", "model.json", "model.residual.npz", "report.html"),
    ]
    found = checked(out / "report.html")
    fit = json.loads((out / "fit.json").read_text(encoding="utf-8"))
    assert f"validation {fit['validation']['rmse']:.3g} um" in " ".join(found.captions)
    for path, parameter in fit["parameters"].items():
        row = found.cells.index(path)
        assert float(found.cells[row + 1]) == pytest.approx(
            parameter["value"], rel=1e-4
        )
    assert "um/V" in found.cells
    assert_pictures(out, "fit.png")


def test_fit_json_has_the_agreed_keys(identified):
    _, out = identified
    fit = json.loads((out / "fit.json").read_text(encoding="utf-8"))
    assert set(fit) >= {"model", "parameters", "train", "warnings", "wall_s"}
    assert fit["model"] == "coleman_hodgdon"
    for part in ("train", "validation"):
        assert set(fit[part]) >= {"rmse", "rmse_percent_of_span", "unit"}
        assert fit[part]["unit"] == "um"
        assert fit[part]["rmse_percent_of_span"] < 5.0
    for parameter in fit["parameters"].values():
        assert set(parameter) == {"value", "standard_error"}


def test_the_model_is_a_plant_of_a_study(identified, tmp_path):
    _, out = identified
    fit = json.loads((out / "fit.json").read_text(encoding="utf-8"))
    model = pj.load(out / "model.json")
    assert float(model.parts[0].b) == fit["parameters"]["hysteresis.b"]["value"]
    (tmp_path / "model.json").write_bytes((out / "model.json").read_bytes())
    path = write_study(
        tmp_path,
        rate=1000.0,
        plant={"file": "model.json"},
        controller={"design": "inversion_sliding_mode"},
        parameters={"controller.feedback.law.integral": {"lower": 1e-3, "upper": 1e6}},
    )
    case = read(path)
    assert float(case.loop.plant.parts[0].b) == float(model.parts[0].b)


def test_identify_ends_with_a_table(identified):
    printed, _ = identified
    for part in ("hysteresis.a", "standard error", "training", "validation", "um"):
        assert part in printed.stdout
    assert "results in" in printed.stdout


def test_model_help_lists_the_models(record):
    result = succeeded(call("identify", record, "--model", "help"))
    assert all(name in result.stdout.split() for name in parts())


@pytest.mark.parametrize(
    "model", [("lag",), ("all", "--among", "coleman_hodgdon", "--steps", "1")]
)
def test_identify_with_an_alarm_ends_with_status_3(record, tmp_path, model):
    """From the middle of the record on, the stage moves twice as far."""
    header, *rows = record.read_text(encoding="utf-8").splitlines()
    for i, row in enumerate(rows):
        time, drive, sensor = row.split(",")
        moved = (2.0 if i >= 150 else 1.0) * (float(sensor) - 4.0)
        rows[i] = f"{time},{drive},{moved:.6f}"
    record.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    out = tmp_path / "out"
    command = ("identify", record, *COLUMNS, "--model", *model, "--out", out)
    result = call(*command, "--quiet")
    assert result.exit_code == 3
    assert result.stdout == ""
    assert "ALARM: the model explains little: its validation" in result.stderr
    assert {"model.json", "report.html"} <= {*names(out)}
    with pytest.raises(ValueError, match="the model explains little"):
        pj.load(out / "model.json")


def test_identify_bad_input(record, tmp_path):
    out = ("--out", tmp_path / "out")
    failed(call("identify", tmp_path / "no.csv", *out), "no.csv: No such file or dir")
    failed(call("identify", record, *out), "name the columns of input and output")
    failed(
        call("identify", record, *out, *COLUMNS[2:], "--rate", -5.0),
        "bench.csv: rate is -5 Hz; it must be above 0",
    )
    failed(
        call("identify", record, *out, *COLUMNS, "--input", "volts"),
        "input column 'volts' is missing; there are time_s, drive_V, sensor_um",
    )
    failed(
        call("identify", record, *out, *COLUMNS, "--model", "maxwell"),
        "a model has no part 'maxwell'; there are coleman_hodgdon",
    )
    failed(
        call("identify", record, *out, *COLUMNS, "--train", "100:50"),
        "train is 100:50; it must lie in 0:300 and hold a sample",
    )
    failed(
        call("identify", record, *out, *COLUMNS, "--validate", "0:5000"),
        "validate is 0:5000; it must lie in 0:300 and hold a sample",
    )
    text = record.read_text().replace("0.0100,", "0.0100,nan", 1)
    record.write_text(text)
    failed(call("identify", record, *out, *COLUMNS), "sample 10")


# reproduce


@pytest.fixture
def made_up(monkeypatch):
    """Replace the simulation of the tables, which tests/reproduction covers."""
    asked = []

    def reproduce(table):
        asked.append(table)
        return [
            Cell(table, row, column, "um", 0.1, 0.11)
            for row in ("SIN1", "SW10")
            for column in ("pid_smc", "dob")
        ]

    monkeypatch.setattr("piezojax.reproduction.reproduce", reproduce)
    errors = [RateError(20_000, "continuous", row, 0.1) for row in ("SIN1", "SW10")]
    monkeypatch.setattr("piezojax.reproduction.rates.errors_by_rate", lambda: errors)
    return asked


def test_reproduce_writes_its_results(made_up, tmp_path):
    out = tmp_path / "out"
    result = succeeded(call("reproduce", "--table", "5-5", "--out", out))
    assert made_up == ["5-5"]
    assert names(out) == ["cells.csv", "cells.png", "report.html", "summary.json"]
    assert "dob" in checked(out / "report.html").cells
    assert_pictures(out, "cells.png")
    with (out / "cells.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["table", "row", "column", "unit", "paper", "sim"]
    assert len(rows) == 4
    summary = json.loads((out / "summary.json").read_text())
    assert summary["5-5"]["geomean_ratio"] == pytest.approx(1.1)
    assert summary["5-5"]["columns"]["dob"]["worst_ratio"] == pytest.approx(1.1)
    assert "Table 5-5" in result.stdout
    assert "geometric-mean ratio 1.100" in result.stdout


def test_reproduce_simulates_each_table_once(made_up, tmp_path):
    succeeded(call("reproduce", "--out", tmp_path / "a", "--quiet"))
    assert made_up == list(TABLES)
    rates = (tmp_path / "a" / f"{FIGURE}.csv").read_text().splitlines()
    assert rates[1:] == ["20000,continuous,SIN1,0.1", "20000,continuous,SW10,0.1"]
    made_up.clear()
    twice = ("--table", "5-5", "--table", "5-3", "--table", "5-5")
    succeeded(call("reproduce", *twice, "--out", tmp_path / "b"))
    assert made_up == ["5-5", "5-3"]
    named = ("--table", "figure-4-5", "--table", "4-6")
    printed = succeeded(call("reproduce", *named, "--out", tmp_path / "c")).stdout
    assert "simulating Figure 4-5\n" in printed
    assert "simulating Table 4-6\n" in printed


def test_calibration_takes_no_tables(tmp_path):
    result = call("reproduce", "--calibrate", "--table", "5-3", "--out", tmp_path / "a")
    failed(result, "--calibrate chooses its own tables; leave --table out")


@pytest.mark.usefixtures("undrawn")
def test_quiet_reproduce_prints_nothing(made_up, tmp_path):
    result = call("reproduce", "--quiet", "--out", tmp_path / "out")
    assert succeeded(result).output == ""


def test_reproduce_unknown_table(made_up, tmp_path):
    out = tmp_path / "out"
    result = call("reproduce", "--table", "5-3", "--table", "9-9", "--out", out)
    failed(result, "--table 9-9 is unknown; there are 3-6, 3-7, 4-5, 4-6")
    assert not out.exists()
    assert made_up == []


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("tune", ["--seed", "-1"]),
        ("tune", ["--sead", "1"]),
        ("tune", ["a.toml", "b.toml"]),
        ("identify", ["r.csv", "--train", "first half"]),
        ("identify", ["r.csv", "--rate", "fast"]),
        ("identify", []),
    ],
)
def test_usage_errors_in_one_line(command, arguments):
    result = call(command, *arguments)
    assert result.exit_code != 0
    assert result.stderr.count("\n") == 1


def test_model_help_needs_no_record():
    succeeded(call("identify", "--model", "help"))


def test_bad_input_leaves_no_empty_folder(record, tmp_path):
    out = tmp_path / "out"
    result = call("identify", record, *COLUMNS, "--model", "x", "--out", out)
    assert result.exit_code == 1
    assert not out.exists()


def test_an_early_ctrl_c_prints_one_line(study, tmp_path, monkeypatch):
    def press(self, text, steps=0):
        raise KeyboardInterrupt

    monkeypatch.setattr(Bar, "stage", press)
    result = call("tune", study, "--out", tmp_path / "out")
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("title", ["gain [um/V]", "a [bold] stage", "[/um] per volt"])
def test_titles_with_brackets_are_not_markup(tuned, title):
    result = pj.load_result(tuned[1]).model_copy(update={"title": title})
    stream = io.StringIO()
    Console(file=stream, width=200).print(tuning_table(result))
    assert title in stream.getvalue()


def test_names_with_brackets_are_not_markup(tmp_path):
    path = write_study(tmp_path, name="run[bold]1.toml", rate=10_000.0)
    result = call("tune", path, "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert result.stdout.splitlines()[:2] == ["loading", "reading run[bold]1.toml"]


def test_a_long_path_is_printed_in_one_piece(made_up, tmp_path):
    out = tmp_path / ("a_long_name_" * 8) / "out"
    result = succeeded(call("reproduce", "--table", "5-5", "--out", out))
    assert str(out) in result.stdout


def test_a_full_disk_gives_one_line(study, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("piezojax.report.tuning_pictures.write_text", full)
    result = call("tune", study, "--out", tmp_path / "out")
    failed(result, "No space left on device")


def test_pictures_of_a_start_that_diverges(tmp_path):
    path = write_study(
        tmp_path,
        actuator={"lower": -1e300, "upper": 1e300},
        parameters={
            "controller.integral": {
                **{"lower": 100.0, "upper": 1e7, "start": 5e6},
                "scale": "log",
            }
        },
    )
    out = tmp_path / "out"
    result = call("tune", path, "--out", out)
    assert result.exit_code == 0
    assert "diverges" in result.stdout
    assert_pictures(out, "tracking.png", "hysteresis.png", "convergence.png")
