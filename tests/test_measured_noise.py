"""Noise and vibrations of files: spectra of draws, stretches of records."""

import copy

import numpy as np
import pytest
from scipy import signal, stats

import piezojax as pj
from piezojax.study import Study, build
from piezojax.study.file_tables import NoiseFile
from piezojax.study.measured_noise import confidence, read_noise
from piezojax.study.study_file import as_toml, load
from piezojax.study.tables import validated
from piezojax.tuning.data import make_data

RATE = 2000.0
STUDY = {
    "title": "a stage with measured noise",
    "rate": RATE,
    "seed": 3,
    "plant": {"type": "Affine", "gain": 0.15},
    "actuator": {"lower": -20.0, "upper": 120.0},
    "controller": {"type": "PID", "proportional": 0.0, "integral": 300.0, "dt": 5e-4},
    "references": {"tune": ["SIN5"], "unseen": ["SIN7"], "duration": 1.0},
    "tune": ["controller.integral"],
}


def noise(rate, seconds, seed=0):
    """Broadband noise, a resonance at 300 Hz, mains at 50 Hz; um."""
    random = np.random.default_rng(seed)
    samples = int(rate * seconds)
    white = random.standard_normal(samples)
    poles = np.exp((-40.0 + 2j * np.pi * 300.0) / rate)
    ringing = signal.lfilter([0.05], np.poly([poles, poles.conj()]).real, white)
    mains = 0.05 * np.sin(2 * np.pi * 50.0 * np.arange(samples) / rate + 1.0)
    return 0.02 * random.standard_normal(samples) + ringing + mains


@pytest.fixture
def folder(tmp_path):
    np.savez(tmp_path / "noise.npz", z_um=0.3 + noise(RATE, 20.0), fs=RATE)
    np.savez(tmp_path / "short.npz", z_um=noise(RATE, 1.5), fs=RATE)
    np.savez(tmp_path / "slow.npz", z_um=noise(1000.0, 10.0), fs=1000.0)
    np.savez(tmp_path / "fast.npz", z_um=noise(4000.0, 20.0), fs=4000.0)
    np.savez(tmp_path / "drive.npz", u_mV=1e3 * noise(RATE, 20.0), fs=RATE)
    return tmp_path


def study_of(**tables):
    return Study.model_validate(copy.deepcopy(STUDY) | tables)


def read(folder, sensor=False, **table):
    table = NoiseFile.model_validate({"file": "noise.npz"} | table)
    units = ("um",)
    return read_noise(
        table, study_of(), folder, "sensor.measured_noise", units, sensor=sensor
    )


def levels(values, rate, length=500):
    """One-sided levels of Welch's method, and their number of segments."""
    frequency, found = signal.welch(values, rate, nperseg=length, axis=-1)
    count = (values.shape[-1] - length) // (length // 2) + 1
    return frequency, np.atleast_2d(found), count


def share_within(drawn, measured, segments, draws):
    """Share of lines at which the ratio of two levels lies in its 95 % interval.

    Both are Welch's estimates: their ratio has an F distribution.
    """

    def degrees(count):
        return 36.0 * count**2 / (19.0 * count - 1.0)

    low, high = stats.f.ppf(
        [0.025, 0.975], draws * degrees(segments[0]), degrees(segments[1])
    )
    ratio = drawn / measured
    return np.mean((ratio > low) & (ratio < high))


@pytest.mark.parametrize("name", ["noise.npz", "fast.npz"])
def test_draws_have_the_spectrum_of_the_record(folder, name):
    """A faster record folds, as when a converter reads the sensor."""
    found = read(folder, file=name, sensor=True)
    random = np.random.default_rng(1)
    drawn = found.draws(random, (3, 10), 2000, "train")[..., 0].reshape(30, -1)
    frequency, sizes, count = levels(drawn, RATE)
    record = np.load(folder / name)["z_um"][:: 1 if name == "noise.npz" else 2]
    _, expected, segments = levels(record - record.mean(), RATE)
    # A line and a resonance: leave out the lines that the window smears.
    kept = (frequency > 10.0) & (np.abs(frequency - 50.0) > 15.0) & (frequency < 990.0)
    inside = share_within(
        sizes.mean(axis=0)[kept], expected[0][kept], (count, segments), 30
    )
    assert inside > 0.85
    assert np.std(drawn) == pytest.approx(np.std(record), rel=0.05)
    assert found.rms[0] == pytest.approx(np.std(record), rel=0.02)
    near = np.abs(frequency - 50.0) < 10.0
    assert sizes.mean(axis=0)[near].sum() == pytest.approx(
        expected[0][near].sum(), rel=0.3
    )
    assert np.abs(np.corrcoef(drawn) - np.eye(30)).max() < 0.3


def test_the_interval_of_a_level_is_that_of_repeated_records():
    low, high = confidence(15)
    random = np.random.default_rng(0)
    _, found, count = levels(random.standard_normal((200, 1600)), RATE, 200)
    assert count == 15
    ratio = (2.0 / RATE) / found[:, 1:-1]
    assert np.mean((ratio > low) & (ratio < high)) == pytest.approx(0.95, abs=0.015)


@pytest.mark.parametrize(
    ("unit", "power", "scale"), [("nm/sqrt(Hz)", 1, 1e3), ("um^2/Hz", 2, 1.0)]
)
def test_a_spectrum_gives_draws(folder, unit, power, scale):
    frequency = np.array([0.0, 1.0, 10.0, 100.0, 1000.0])
    density = np.array([9.0, 1e-2, 1e-3, 1e-3, 1e-4])  # um/sqrt(Hz)
    text = "\n".join(
        f"{f:g},{scale * d**power:.6g}" for f, d in zip(frequency, density, strict=True)
    )
    (folder / "density.csv").write_text(f"f_Hz,density\n{text}")
    table = {"frequency": "f_Hz", "column": "density", "unit": unit}
    found = read(folder, file="density.csv", sensor=True, **table)
    drawn = found.draws(np.random.default_rng(1), (40,), 4000, "train")[..., 0]
    measured, sizes, _ = levels(drawn, RATE, 1000)
    for line in (10.0, 50.0, 100.0, 316.0):
        at = np.abs(measured - line) <= 4.0
        expected = np.exp(np.interp(np.log(measured[at]), np.log(frequency[1:]),
                                    2.0 * np.log(density[1:])))  # fmt: skip
        np.testing.assert_allclose(
            sizes.mean(axis=0)[at].mean(), expected.mean(), rtol=0.25
        )
    assert "the spectrum of density.csv" in found.note


def test_a_record_plays_other_stretches_in_the_holdout(folder):
    found = read(folder, play="record", sensor=True)
    record = np.load(folder / "noise.npz")["z_um"]
    record = record - record.mean()
    for part, half in (("train", record[:20000]), ("validate", record[20000:])):
        drawn = found.draws(np.random.default_rng(0), (2, 3), 2000, part)
        assert drawn.shape == (2, 3, 2000, 1)
        for stretch in drawn.reshape(6, 2000):
            (begin,) = np.flatnonzero(np.isclose(half, stretch[0]))
            np.testing.assert_allclose(stretch, half[begin : begin + 2000])
    slow = read(folder, file="slow.npz", play="record")
    original = np.load(folder / "slow.npz")["z_um"]
    np.testing.assert_allclose(
        slow.record[100:-100:2, 0], (original - original.mean())[50:-50], atol=6e-4
    )
    frequency, sizes, _ = levels(slow.record[:, 0], RATE)
    assert sizes[0, frequency > 600.0].sum() < 1e-3 * sizes[0].sum()
    assert "no frequency above 500 Hz" in slow.note


def test_a_study_has_the_noise_of_its_files(folder):
    tables = {
        "sensor": {"measured_noise": {"file": "noise.npz"}},
        "disturbance": {
            "output": {"file": "slow.npz", "scale": 2.0},
            "input": {"file": "drive.npz", "play": "record"},
        },
    }
    case = build(study_of(**tables), folder / "study.toml")
    rms = np.load(folder / "noise.npz")["z_um"].std()
    assert case.study.sensor.noise_rms == pytest.approx(rms, rel=0.02)
    assert float(case.loop.sensor.parts[0].noise_rms) == pytest.approx(rms, rel=0.02)
    assert [note.split(":")[0] for note in case.notes[:3]] == [
        "sensor.measured_noise",
        "disturbance.output",
        "disturbance.input",
    ]
    data = make_data(case)
    assert np.std(data.holdout.noise) == pytest.approx(1.0, rel=0.15)
    moved = np.asarray(data.holdout.disturbance)
    assert np.std(moved) == pytest.approx(2.0 * noise(1000.0, 10.0).std(), rel=0.2)
    pushed = np.asarray(data.holdout.input_disturbance)
    assert np.std(pushed) == pytest.approx(noise(RATE, 20.0).std(), rel=0.2)
    # The plant is a gain: both disturbances add up at its output.
    reference = data.holdout.references[0]
    run_noise = data.holdout.run_noise.of(0, 0)
    inputs = pj.loop_inputs(reference, *run_noise)
    _, log = pj.simulate(case.loop, inputs, case.loop.init(reference[0]))
    expected = 0.15 * (np.asarray(log.voltage) + pushed[0, 0]) + moved[0, 0]
    np.testing.assert_allclose(log.displacement[1:], expected[:-1], atol=1e-9)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"file": "none.npz"}, "sensor.measured_noise: record .*none.npz: No such"),
        (
            {"file": "slow.npz"},
            "no frequency above 500 Hz, and the sensor is sam",
        ),
        (
            {"file": "short.npz", "play": "record"},
            "half of short.npz lasts 0.74",
        ),
        ({"file": "tiny.npz"}, "tiny.npz has 511 samples; at least 512"),
        ({"file": "flat.npz"}, "column 'z_um' never changes"),
        ({"unit": "nm"}, "column 'z_um' is in um in the file, but unit is nm"),
        ({"frequency": "z_um"}, "column 'z_um' is named twice|name the column"),
        (
            {"file": "psd.npz", "frequency": "f", "column": "s"},
            "unit of column 's' is",
        ),
        (
            {"file": "psd.npz", "frequency": "f", "column": "s", "unit": "V^2/Hz"},
            "column 's' is in V, and um is needed",
        ),
        (
            {"file": "psd.npz", "frequency": "s", "column": "f", "unit": "um^2/Hz"},
            "the frequencies must be above 0 and increase",
        ),
        (
            {"file": "psd.npz", "frequency": "f", "column": "s", "unit": "um^2/Hz"},
            "the file covers no frequency above 4 Hz",
        ),
    ],
)
def test_a_bad_file_is_one_line(folder, table, message):
    np.savez(folder / "tiny.npz", z_um=noise(RATE, 1.0)[:511], fs=RATE)
    np.savez(folder / "flat.npz", z_um=np.ones(1000), fs=RATE)
    np.savez(folder / "psd.npz", f=[1.0, 2.0, 3.0, 4.0], s=[1.0, 2.0, 1.0, 1.0])
    with pytest.raises(ValueError, match=message) as caught:
        read(folder, sensor=True, **table)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        (
            {"sensor": {"noise_rms": 0.1, "measured_noise": {"file": "a.csv"}}},
            "noise_rms and measured",
        ),
        (
            {"sensor": {"measured_noise": {"file": "a.csv", "play": "loop"}}},
            "sensor.measured_noise.play",
        ),
        (
            {"disturbance": {"input": {"file": "a.csv", "scale": 0.0}}},
            "disturbance.input: scale is 0",
        ),
        (
            {
                "disturbance": {
                    "output": {"file": "a", "frequency": 0, "play": "record"}
                }
            },
            'disturbance.output: play is "record"',
        ),
    ],
)
def test_a_bad_table_is_refused(tables, message):
    with pytest.raises(ValueError, match=message) as caught:
        validated(Study, copy.deepcopy(STUDY) | tables, "")
    assert "\n" not in str(caught.value)


def test_the_study_of_a_case_is_read_back(folder):
    study = study_of(sensor={"measured_noise": {"file": "noise.npz"}})
    case = build(study, folder / "study.toml")
    assert case.study.sensor.noise_rms > 0.0
    written = folder / "written.toml"
    written.write_text(as_toml(case.study), encoding="utf-8")
    assert load(written) == study
    assert pj.study.read(written).sha256 == case.sha256
