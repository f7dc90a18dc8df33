"""A trial of gains on a stage: what is kept, what is restored, and what is left."""

import contextlib
import dataclasses
import json

import numpy as np
import pytest
from stages.stage_in_tests import DT, REFERENCE, SAFE, lag, stage, write_study

from piezojax.stages import (
    Fault,
    LostError,
    Motion,
    StageError,
    TrialReport,
    trial,
)
from piezojax.stages.of_study import motions_of
from piezojax.stages.run_files import run_file, run_files, save_samples
from piezojax.stages.try_gains import TRIAL_FILE
from piezojax.study import load

GAINS = {"proportional": 1.0, "integral": 900.0}
START = 500


def error_of(gains, plant=None):
    """Return the rms error of a run with ``gains``, um, without sensor noise."""
    one = stage(plant=plant or lag(), seed=9)
    record = one.run(REFERENCE, gains)
    error = (record.reference - record.output)[START:]
    return float(np.sqrt(np.mean(error**2) - 1e-6))


def motions(promised=None, count=2):
    known = error_of(GAINS) if promised is None else promised
    return [
        Motion(f"SIN{number}", REFERENCE, known, START, 1e-3)
        for number in range(1, count + 1)
    ]


def read(folder):
    return TrialReport.model_validate_json((folder / TRIAL_FILE).read_text())


def test_gains_that_keep_their_promise_are_kept(tmp_path):
    one = stage()
    report = trial(one, GAINS, motions(), tmp_path)
    assert report.verdict == "kept"
    assert not report.alarms
    assert one.gains() | GAINS == one.gains()
    assert [(run.reference, run.share) for run in report.runs] == [
        ("SIN1", 0.1),
        ("SIN1", 0.3),
        ("SIN1", 1.0),
        ("SIN2", 1.0),
    ]
    assert [run.ratio for run in report.runs] == pytest.approx(
        [0.1, 0.3, 1.0, 1.0], rel=0.02
    )
    assert report.before | SAFE == report.before
    assert read(tmp_path) == report


def test_every_run_leaves_its_samples(tmp_path):
    report = trial(stage(), GAINS, motions(count=1), tmp_path)
    for run in report.runs:
        with np.load(tmp_path / run.file, allow_pickle=False) as samples:
            reference, measured = samples["reference_um"], samples["measured_um"]
            voltage = samples["voltage_V"]
        begin = REFERENCE[0]
        np.testing.assert_allclose(reference, begin + run.share * (REFERENCE - begin))
        error = (reference - measured)[START:]
        assert run.measured_um == pytest.approx(np.sqrt(np.mean(error**2)))
        assert run.peak_um == pytest.approx(np.abs(error).max())
        assert run.voltage_V == (voltage.min(), voltage.max())


def test_a_motion_without_a_promise_is_refused(tmp_path):
    unknown = [dataclasses.replace(*motions(count=1), promised=None)]
    with pytest.raises(ValueError, match="SIN1 has no promised error"):
        trial(stage(), GAINS, unknown, tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_noise_of_a_motion_may_be_measured(tmp_path):
    drawn = 5e-3 * np.random.default_rng(0).standard_normal(4000)
    np.savez(tmp_path / "noise.npz", z_um=drawn, fs=1.0 / DT)
    sensor = {"measured_noise": {"file": "noise.npz"}}
    study = load(write_study(tmp_path, sensor=sensor))
    (motion,) = motions_of(study, tmp_path, {"SIN2": 0.01})
    assert motion.noise == pytest.approx(5e-3, rel=0.1)


def test_runs_are_read_in_the_order_of_their_numbers(tmp_path):
    for number in (9, 10, 99, 100):
        save_samples(run_file(tmp_path, number), *np.ones((3, 5)))
    assert run_files(tmp_path) == [run_file(tmp_path, n) for n in (9, 10, 99, 100)]


def test_a_broken_promise_restores_the_gains_from_before(tmp_path):
    one = stage()
    one.apply({"integral": 650.0})
    report = trial(one, GAINS, motions(0.3 * error_of(GAINS)), tmp_path)
    assert report.verdict == "restored"
    assert one.gains()["integral"] == 650.0
    assert "3.33 times the promised" in report.alarms[0]
    assert len(report.runs) == 3  # the small motions alone keep it


def test_a_small_motion_finds_unstable_gains(tmp_path):
    one = stage()
    wild = {"proportional": 150.0, "integral": 900.0}
    report = trial(one, wild, motions(), tmp_path)
    assert report.verdict in ("restored", "stopped")
    assert len(report.runs) == 1
    assert report.runs[0].share == 0.1
    assert one.gains()["proportional"] == SAFE["proportional"]
    assert report.alarms


def test_an_error_above_the_promise_is_noted(tmp_path):
    report = trial(stage(), GAINS, motions(error_of(GAINS) / 1.5), tmp_path)
    assert report.verdict == "kept"
    assert report.notes == [
        f"SIN{n} at 100 %: the error is 1.5 times the promised one" for n in (1, 2)
    ]


@pytest.mark.parametrize("run", [0, 2])
@pytest.mark.parametrize("kind", ["dropout", "stuck", "plant"])
def test_a_fault_ends_with_the_safe_gains(tmp_path, run, kind):
    one = stage()
    whole, count = one.run, iter(range(10))

    def failing(reference, gains):
        if next(count) == run:
            one.faults = [Fault(kind, 300, 600, lag(-0.1))]
        return whole(reference, gains)

    one.run = failing
    report = trial(one, GAINS, motions(), tmp_path)
    assert report.verdict == "stopped"
    assert len(report.runs) == run + 1
    assert report.runs[-1].stopped
    assert report.alarms == [
        f"{report.runs[-1].reference} at {100 * report.runs[-1].share:g} %: "
        f"{report.runs[-1].stopped}; the safe gains of the stage are set"
    ]
    assert one.gains() | SAFE == one.gains()
    assert one.voltage == pytest.approx(0.0, abs=1e-9)
    assert read(tmp_path) == report
    assert (tmp_path / report.runs[-1].file).exists()


def test_a_lost_connection_is_said(tmp_path):
    one = stage()
    whole, count = one.run, iter(range(10))

    def failing(reference, gains):
        if next(count) == 2:
            raise LostError("the connection to the stage is lost: it was closed")
        return whole(reference, gains)

    one.run = failing
    report = trial(one, GAINS, motions(), tmp_path)
    assert report.verdict == "lost"
    assert len(report.runs) == 2
    assert "Look at it before the next run" in report.alarms[0]
    assert read(tmp_path) == report


@pytest.mark.parametrize(
    "error", [StageError("the device keeps ki at 7"), KeyboardInterrupt()]
)
def test_a_stage_that_refuses_its_safe_gains_ends_with_an_alarm(tmp_path, error):
    one, cause = stage(), str(error) or "KeyboardInterrupt"

    def failing(*_):
        raise error

    def refusing():
        raise StageError("the device keeps kp at 3")

    one.run, one.safe = failing, refusing
    ends = pytest.raises(KeyboardInterrupt)
    with contextlib.nullcontext() if isinstance(error, StageError) else ends:
        trial(one, GAINS, motions(1.0), tmp_path)
    report = read(tmp_path)
    assert report.verdict == "lost"
    assert report.alarms[0].startswith(
        f"{cause}; the safe gains could not be set: the device keeps kp at 3: nothing"
    )


def test_an_interruption_makes_the_stage_safe(tmp_path):
    one = stage()
    whole, count = one.run, iter(range(10))

    def interrupted(reference, gains):
        if next(count) == 1:
            raise KeyboardInterrupt
        return whole(reference, gains)

    one.run = interrupted
    with pytest.raises(KeyboardInterrupt):
        trial(one, GAINS, motions(), tmp_path)
    assert one.gains() | SAFE == one.gains()
    assert read(tmp_path).verdict == "stopped"


def test_the_gains_from_before_are_saved_before_the_first_run(tmp_path):
    one = stage()
    one.apply({"integral": 650.0})

    def dying(reference, gains):
        saved = json.loads((tmp_path / TRIAL_FILE).read_text())
        assert saved["before"]["integral"] == 650.0
        assert saved["verdict"] == "running"
        raise SystemExit

    one.run = dying
    with pytest.raises(SystemExit):
        trial(one, GAINS, motions(), tmp_path)


@pytest.mark.parametrize(
    ("gains", "some", "message"),
    [
        (GAINS, False, "a trial needs at least one reference"),
        ({"speed": 1.0}, True, "the stage has no gain speed; it has proportional"),
    ],
)
def test_a_trial_without_sense_is_refused(tmp_path, gains, some, message):
    with pytest.raises(ValueError, match=message):
        trial(stage(), gains, motions(1.0) if some else [], tmp_path)
    assert stage().dt == DT
