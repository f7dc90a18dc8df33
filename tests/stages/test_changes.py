"""A watch of a stage: features by their definition, alarms as often as stated."""

import json
import re

import numpy as np
import pytest
from oracles.watched_stage import DT, REFERENCE, SAMPLES, runs
from scipy import stats
from stages.stage_in_tests import REFERENCE as MOTION
from stages.stage_in_tests import SAFE, lag, stage

import piezojax as pj
from piezojax.stages import Baseline, Fault, LostError, Motion, WatchReport, watch
from piezojax.stages.changes import FEATURES, WATCH_FILE, read_runs

GAINS = {"proportional": 1.0, "integral": 900.0}
TIME = DT * np.arange(SAMPLES)
VOLTAGE = 40.0 + 20.0 * np.sin(2.0 * np.pi * 3.0 * TIME)
READING = 4.0 + 2.0 * np.sin(2.0 * np.pi * 3.0 * TIME - 0.1)


def record(voltage, reading=READING, reference=REFERENCE):
    return pj.Record(voltage, reading, DT, reference=reference)


def known(seed=1, count=12):
    """Return a baseline of records that differ by white noise."""
    random = np.random.default_rng(seed)
    return Baseline(
        [
            record(*(x + s * random.standard_normal(SAMPLES) for x, s in parts))
            for parts in [((VOLTAGE, 1e-2), (READING, 1e-3))] * count
        ]
    )


@pytest.mark.parametrize("change", [-0.1, -0.01, 0.02, 0.1])
def test_the_gain_is_that_of_the_reading_over_the_voltage(change):
    features = known().judge(record(VOLTAGE, (1.0 + change) * READING)).features
    assert features.gain_percent == pytest.approx(100.0 * change, abs=0.05)
    assert features.lag_us == pytest.approx(0.0, abs=5.0)
    features = known().judge(record(VOLTAGE / (1.0 + change))).features
    assert features.gain_percent == pytest.approx(100.0 * change, abs=0.05)


@pytest.mark.parametrize("late", [-3e-4, 1e-4, 5e-4])
def test_the_lag_is_that_of_the_reading_behind_the_voltage(late):
    delayed = 4.0 + 2.0 * np.sin(2.0 * np.pi * 3.0 * (TIME - late) - 0.1)
    features = known().judge(record(VOLTAGE, delayed)).features
    assert features.lag_us == pytest.approx(1e6 * late, abs=5.0)
    assert features.gain_percent == pytest.approx(0.0, abs=0.05)


def test_zero_and_drift_are_no_change():
    random = np.random.default_rng(8)
    moved = VOLTAGE + 5.0 + 30.0 * TIME + 1e-2 * random.standard_normal(SAMPLES)
    noisy = READING + 1e-3 * random.standard_normal(SAMPLES)
    assert not known().judge(record(moved, noisy), 1e-3).moved


def test_noise_and_oscillation_are_changes():
    random = np.random.default_rng(8)
    ringing = VOLTAGE + 0.05 * np.sin(2.0 * np.pi * 180.0 * TIME)
    noisy = READING + 1e-2 * random.standard_normal(SAMPLES)
    assert known().judge(record(ringing)).moved
    assert known().judge(record(VOLTAGE, noisy)).moved


def test_the_distance_is_that_of_the_likelihood_ratio():
    """T^2 = (n - 1) (lambda - 1) with lambda the ratio of the determinants.

    Under the hypothesis that the run belongs to the baseline, the scatter is that of
    all runs about their common mean; otherwise that of the baseline about its own.
    """
    baseline = known()
    judged = baseline.judge(record(1.001 * VOLTAGE))
    rows = [list(each.model_dump().values()) for each in baseline.features]
    every = [*rows, list(judged.features.model_dump().values())]

    def scatter(values):
        away = np.array(values) - np.mean(values, axis=0)
        return np.linalg.det(away.T @ away)

    ratio = scatter(every) / scatter(rows)
    assert judged.distance == pytest.approx((len(rows) - 1) * (ratio - 1.0), rel=1e-6)
    share = judged.threshold * (12 - FEATURES) / (FEATURES * 11)
    assert stats.f.sf(share, FEATURES, 12 - FEATURES) == pytest.approx(0.01)


def test_alarms_are_as_many_as_stated_and_a_change_is_found():
    random = np.random.default_rng(3)
    found = runs(random, np.r_[np.ones(40 * 20), np.full(40, 0.9)])
    every = [record(u, y) for y, u in zip(*found, strict=True)]
    alarms = 0
    for number in range(40):
        first = 20 * number
        baseline = Baseline(every[first : first + 12], 200)
        alarms += sum(
            baseline.judge(one, 0.05).moved for one in every[first + 12 : first + 20]
        )
        assert baseline.judge(every[800 + number]).moved
    low, high = stats.binom.interval(0.999, 320, 0.05)
    assert low <= alarms <= high


@pytest.mark.parametrize("count", [0, FEATURES + 1])
def test_too_few_runs_are_no_baseline(count):
    with pytest.raises(ValueError, match=f"at least 6 runs, not {count}"):
        known(count=count)


def test_a_run_of_another_reference_is_refused():
    message = "a run can only be compared with runs of its reference"
    with pytest.raises(ValueError, match=message):
        known().judge(record(VOLTAGE, reference=REFERENCE + 1.0))
    with pytest.raises(ValueError, match=message):
        known().judge(pj.Record(VOLTAGE, READING, DT))


# on a stage


def watched(one, folder, **options):
    folder.mkdir()
    motion = Motion("SIN2", MOTION, 1.0, 200, 1e-3)
    return watch(one, GAINS, motion, folder, **options)


def test_a_stage_is_compared_with_its_baseline(tmp_path):
    one = stage(seed=2)
    first = watched(one, tmp_path / "first", runs=12)
    assert len(first.baseline) == 12
    assert not first.runs
    assert len(read_runs(tmp_path / "first", one.dt)) == 12
    later = watched(one, tmp_path / "later", baseline=tmp_path / "first", runs=3)
    assert later.baseline == first.baseline
    assert [run.moved for run in later.runs] == [False] * 3
    assert not later.alarms
    other = stage(seed=3, plant=lag(0.09))
    changed = watched(other, tmp_path / "changed", baseline=tmp_path / "first", runs=2)
    assert [run.moved for run in changed.runs] == [True] * 2
    assert re.search(r"its gain by -10 %.*record it again", changed.alarms[0])
    text = (tmp_path / "changed" / WATCH_FILE).read_text()
    assert WatchReport.model_validate_json(text) == changed


@pytest.mark.parametrize(
    ("gains", "differing"),
    [
        ({"integral": 800.0}, "integral is 800.0 now and was 900.0;"),
        ({"derivative": 0.0}, "derivative is 0.0 now and was not set;"),
    ],
)
def test_a_baseline_of_other_gains_is_refused(tmp_path, gains, differing):
    one = stage()
    watched(one, tmp_path / "first", runs=6)
    one.run = lambda *_: pytest.fail("the stage must not move")
    motion = Motion("SIN2", MOTION, 1.0, 200, 1e-3)
    options = {"baseline": tmp_path / "first", "runs": 1}
    with pytest.raises(ValueError, match=f"with other gains: {differing} record"):
        watch(one, GAINS | gains, motion, tmp_path, **options)
    (tmp_path / "first" / WATCH_FILE).unlink()
    with pytest.raises(ValueError, match=r"watch\.json: No such file"):
        watch(one, GAINS, motion, tmp_path, **options)


def test_a_stopped_run_is_a_change(tmp_path):
    one = stage()
    watched(one, tmp_path / "first", runs=6)
    one.faults = [Fault("dropout", 400)]
    found = watched(one, tmp_path / "later", baseline=tmp_path / "first", runs=3)
    assert len(found.runs) == 1
    assert found.runs[0].moved
    reason = "the reading is not a number"
    assert found.alarms == [f"run_01.npz: the run was stopped: {reason}"]
    assert one.gains() | SAFE == one.gains()
    report = json.loads((tmp_path / "later" / WATCH_FILE).read_text())
    assert report["runs"][0]["stopped"] == reason


def test_a_failure_makes_the_stage_safe(tmp_path):
    one = stage()
    whole, count = one.run, iter(range(9))

    def failing(reference, gains):
        if next(count) == 2:
            raise KeyboardInterrupt
        return whole(reference, gains)

    one.run = failing
    with pytest.raises(KeyboardInterrupt):
        watched(one, tmp_path / "first", runs=6)
    assert one.gains() | SAFE == one.gains()


def test_a_lost_connection_is_raised(tmp_path):
    one = stage()

    def lost(*arguments):
        raise LostError("the connection to the stage is lost: it was closed")

    one.run = one.safe = lost
    with pytest.raises(LostError, match="it was closed"):
        watched(one, tmp_path / "first", runs=6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"runs": 3}, "a baseline needs at least 6 runs, not 3; give more runs"),
        ({"baseline": "empty"}, "holds no runs of a watch"),
    ],
)
def test_a_watch_without_a_baseline_is_refused(tmp_path, options, message):
    (tmp_path / "empty").mkdir()
    if "baseline" in options:
        options = {"baseline": tmp_path / "empty"}
    with pytest.raises(ValueError, match=message):
        watched(stage(), tmp_path / "first", **options)
