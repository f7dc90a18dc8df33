"""``trial`` and ``emulate`` as commands, against each other."""

import json
from contextlib import contextmanager

import numpy as np
import pytest
from small_runs import call, succeeded, write_study
from stages.stage_in_tests import served

import piezojax as pj
from piezojax.core.serial import save
from piezojax.report.trial_report import nanometres
from piezojax.stages import RemoteStage, StageServer
from piezojax.stages.of_study import emulated_stage


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tuned")
    study = write_study(folder)
    succeeded(call("tune", study, "--out", folder / "results"))
    return folder


@contextmanager
def emulated(folder, **deviations):
    one = emulated_stage(folder / "small.toml", speed=0.0, **deviations)
    with served(one) as address:
        yield one, address


def tried(folder, address, out):
    return call("trial", folder / "results", "--stage", address, "--out", out)


def test_tuned_gains_are_kept_on_the_stage_of_their_study(tuned, tmp_path):
    with emulated(tuned) as (one, address):
        printed = succeeded(tried(tuned, address, tmp_path / "out")).stdout
        gains = pj.load(tuned / "results" / "gains.toml")
        kept = one.gains()
    assert kept["integral"] == pytest.approx(float(gains.integral), rel=1e-12)
    assert "verdict: the gains are kept on the stage" in printed
    report = json.loads((tmp_path / "out" / "trial.json").read_text())
    promised = json.loads((tuned / "results" / "result.json").read_text())
    for run in report["runs"]:
        name = run["reference"]
        assert run["promised_um"] == promised["holdout"]["per_reference_rms_um"][name]
        if run["share"] == 1.0:
            # A little more noise is taken off than the sensor has on the average.
            assert 0.85 < run["error_um"] / run["promised_um"] < 1.05
    page = (tmp_path / "out" / "report.html").read_text()
    assert "References, readings and errors on the stage" in page
    assert (tmp_path / "out" / "trial.png").stat().st_size > 20_000


def test_another_stage_ends_with_an_alarm(tuned, tmp_path):
    with emulated(tuned, gain=0.3) as (one, address):
        before = one.gains()
        result = tried(tuned, address, tmp_path / "out")
        assert one.gains() == before
    assert result.exit_code == 3
    assert "ALARM: " in result.stdout
    assert "the gains from before are set again" in result.stdout


def test_a_guard_that_gives_up_ends_with_an_alarm(tuned, tmp_path):
    with emulated(tuned, largest_error=1e-3) as (one, address):
        result = tried(tuned, address, tmp_path / "out")
        assert one.voltage == pytest.approx(0.0, abs=1e-9)
    assert result.exit_code == 3
    assert "the tracking error is too large" in result.stdout


def test_a_lost_connection_ends_with_an_alarm(tuned, tmp_path, monkeypatch):
    def lost(self, reference, gains):
        self._connection.close()
        return self.gains()

    monkeypatch.setattr(RemoteStage, "run", lost)
    with emulated(tuned) as (_, address):
        result = tried(tuned, address, tmp_path / "out")
    assert result.exit_code == 3
    assert "Look at it before the next run" in result.stdout
    assert (
        json.loads((tmp_path / "out" / "trial.json").read_text())["verdict"] == "lost"
    )


def test_a_stage_that_is_not_there_is_said(tuned, tmp_path):
    result = tried(tuned, "127.0.0.1:1", tmp_path / "out")
    assert result.exit_code == 1
    assert "no stage answers at 127.0.0.1:1" in result.stderr
    assert not (tmp_path / "out").exists()


def test_gains_with_an_alarm_are_not_tried(tuned, tmp_path):
    results = tmp_path / "results"
    results.mkdir()
    for name in ("result.json", "study.toml"):
        (results / name).write_bytes((tuned / "results" / name).read_bytes())
    gains = pj.load(tuned / "results" / "gains.toml")
    save(gains, results / "gains.toml", pj.About(unsafe=["the loop is unstable"]))
    result = call("trial", results, "--stage", "127.0.0.1:1")
    assert result.exit_code == 1
    assert "the loop is unstable" in result.stderr


def test_deviations_change_the_plant_of_a_stage(tuned):
    plain = emulated_stage(tuned / "small.toml").plant
    other = emulated_stage(tuned / "small.toml", gain=1.2, delay=2.0).plant
    voltage = np.cumsum(np.random.default_rng(1).normal(size=40))
    found = pj.simulate(other, voltage, other.init(0.0))[1]
    expected = 1.2 * np.r_[0.0, 0.0, pj.simulate(plain, voltage, plain.init(0.0))[1]]
    np.testing.assert_allclose(found, expected[:-2], rtol=0.0, atol=1e-12)


def test_a_model_replaces_the_plant(tuned, tmp_path):
    save(pj.Affine(0.25), tmp_path / "other.json", pj.About())
    one = emulated_stage(tuned / "small.toml", plant=tmp_path / "other.json")
    assert (
        float(pj.simulate(one.plant, np.array([4.0]), one.plant.init(0.0))[1][0]) == 1
    )


def test_ctrl_c_ends_the_emulator(tuned, monkeypatch):
    def press(server):
        raise KeyboardInterrupt

    monkeypatch.setattr(StageServer, "serve_forever", press)
    printed = succeeded(call("emulate", tuned / "small.toml")).stdout
    assert printed.endswith("Ctrl-C ends it\nthe emulator has ended\n")


def watched(folder, address, *arguments):
    return call("watch", folder / "results", "--stage", address, *arguments)


def test_watch_compares_a_stage_with_its_baseline(tuned, tmp_path):
    with emulated(tuned) as (_, address):
        first = watched(tuned, address, "--runs", "12", "--out", tmp_path / "first")
        assert "these runs are a baseline" in succeeded(first).stdout
        options = "--baseline", tmp_path / "first", "--false-alarms", "0.001"
        same = watched(tuned, address, *options, "--out", tmp_path / "same")
        assert "0 of 3 runs differ from the baseline" in succeeded(same).stdout
    with emulated(tuned, gain=0.9) as (_, address):
        found = watched(tuned, address, *options, "--out", tmp_path / "other")
    assert found.exit_code == 3
    assert "3 of 3 runs differ from the baseline" in found.stdout
    assert "ALARM: run_01.npz: the stage has changed: its gain by -1" in found.stdout
    for name in ("first", "same", "other"):
        assert (tmp_path / name / "watch.png").stat().st_size > 20_000
        assert "watch.png" not in (tmp_path / name / "watch.json").read_text()


def test_watch_names_the_references(tuned, tmp_path):
    with emulated(tuned) as (_, address):
        result = watched(tuned, address, "--reference", "SIN5", "--out", tmp_path / "x")
    assert result.exit_code == 1
    assert "SIN50" in result.stderr


@pytest.mark.parametrize(
    ("error", "shown"),
    [(None, "-"), (0.01234, "12.3 nm"), (0.9996, "1000 nm"), (1.234, "1234 nm")],
)
def test_large_errors_have_no_exponent(error, shown):
    assert nanometres(error) == shown
