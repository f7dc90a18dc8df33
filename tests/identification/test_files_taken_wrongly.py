"""Files whose columns or units are easily taken for others."""

import numpy as np
import pytest
from scipy.io import savemat

from piezojax.core.progress import Silent
from piezojax.core.system import Affine, series
from piezojax.identification import METHODS, Options, Record, read_record
from piezojax.identification.chain import structure
from piezojax.identification.estimators.model_preisach import PreisachFit
from piezojax.identification.plausibility import assumed_units
from piezojax.identification.records.parts import train_and_validation
from piezojax.identification.records.recognise import recognised

TIME = 1e-3 * np.arange(300.0)
DRIVE = 50.0 - 50.0 * np.cos(2.0 * np.pi * 5.0 * TIME)


@pytest.mark.parametrize("rate", [None, 1000.0])
def test_a_matrix_whose_first_column_is_the_time_is_refused(tmp_path, rate):
    """As a rapid-prototyping system writes it: one matrix, no names."""
    path = tmp_path / "trace.mat"
    savemat(path, {"trace": np.c_[TIME, DRIVE, 0.1 * DRIVE], "Ts": 1e-3})
    with pytest.raises(ValueError, match=r"column 0 \('trace\[0\]'\), taken as the in"):
        read_record(path, rate=rate)
    with pytest.raises(ValueError, match=r"column 0 .*rises in even steps of 0.001"):
        read_record(path, input=1, output="0")
    record = read_record(path, time=0, input=1, output=2)
    np.testing.assert_allclose(record.input, DRIVE)
    pair = read_record(path, time=0, input="1", output=["1", "2"][1:])
    np.testing.assert_allclose(pair.output, 0.1 * DRIVE)
    with pytest.raises(ValueError, match=r"column 0 .*rises in even steps"):
        read_record(path, input=(1, 0), output=2)
    # A column that is named is meant: a slow ramp is possible.
    read_record(path, input="trace[0]", output=1)


def test_a_unit_that_is_not_stated_is_noted(tmp_path):
    path = tmp_path / "bench.npz"
    np.savez(path, drive=DRIVE, z_m=1e-7 * DRIVE, counts=DRIVE, fs=1000.0)
    record = read_record(path, input="drive", output="z_m")
    assert (record.input_units, record.output_units) == (("V",), ("m",))
    assert assumed_units(record) == [
        "the unit of column 'drive' is not stated; V is assumed: name the column with "
        "its unit, as drive_V"
    ]
    record = read_record(path, input="drive", output="counts")
    assert record.assumed == ("drive", "counts")
    assert assumed_units(Record(DRIVE, DRIVE, 1e-3)) == []
    path = tmp_path / "bench.csv"
    columns = np.c_[np.arange(DRIVE.size), DRIVE, 0.1 * DRIVE]
    np.savetxt(path, columns, delimiter=",", header="time,drive_V,z_um", comments="")
    record = read_record(path, time="time", input="drive_V", output="z_um")
    assert (record.clock, record.dt) == ("time", 1.0)
    assert assumed_units(record) == [
        "the unit of column 'time' is not stated; s is assumed: name the column with "
        "its unit, as time_s"
    ]


@pytest.mark.parametrize(
    ("train", "expected"),
    [
        (None, (slice(0, 150), slice(150, 300))),
        (slice(0, 100), (slice(0, 100), slice(100, 300))),
        (slice(200, 300), (slice(200, 300), slice(0, 200))),
    ],
)
def test_a_part_to_fit_leaves_one_to_validate_on(train, expected):
    assert train_and_validation(300, train, None) == expected


def test_a_fit_to_the_whole_record_needs_a_part_to_validate_on():
    with pytest.raises(ValueError, match="train is 0:300, the whole record: nothing"):
        train_and_validation(300, slice(0, 300), None)
    whole = slice(0, 300)
    assert train_and_validation(300, whole, whole) == (whole, whole)


def test_bashash_jalili_describes_an_output_that_falls():
    shapes = [structure("bashash_jalili", Record(DRIVE, y, 1e-3)) for y in
              (0.1 * DRIVE + 3.0, -0.1 * DRIVE - 3.0)]  # fmt: skip
    rising, falling = (shape.system for shape in shapes)
    assert float(falling.parts[-1].gain) == -float(rising.parts[-1].gain) == -1.0
    assert float(falling.parts[-1].offset) == -float(rising.parts[-1].offset)
    for one, other in zip(
        (rising.parts[0].upper_output, rising.parts[0].lower_output),
        (falling.parts[0].upper_output, falling.parts[0].lower_output),
        strict=True,
    ):
        assert float(one) == pytest.approx(float(other))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_preisach_describes_an_output_that_falls(monkeypatch, sign):
    """The fit itself, which takes long, sees an output that rises."""
    given = []

    def fit(record, train, model):
        given.append(record)
        system = series(hysteresis=Affine(0.1), lag=Affine(1.0))
        return PreisachFit(system, {}, [], [])

    monkeypatch.setattr("piezojax.identification.methods.preisach_with_lag", fit)
    record = Record(DRIVE, sign * 0.1 * DRIVE, 1e-3)
    method = METHODS["nonnegative_least_squares"]
    found = method.estimate("preisach", [record], slice(0, 150), Options(), Silent())
    np.testing.assert_allclose(given[0].output, 0.1 * DRIVE)
    run = found.simulations[0][:, 0]
    np.testing.assert_allclose(run[1:], sign * 0.1 * DRIVE[:-1], atol=1e-12)
    assert len(found.system.parts) == (2 if sign > 0.0 else 3)


def test_a_frequency_response_is_pointed_to_its_option(tmp_path):
    path = tmp_path / "bode.csv"
    columns = np.c_[np.geomspace(5.0, 500.0, 40), np.zeros(40), np.ones(40)]
    header = "Frequency (Hz),Magnitude (dB),Phase (deg)"
    np.savetxt(path, columns, delimiter=",", header=header, comments="")
    message = "; for a frequency response, identify and start have"
    with pytest.raises(ValueError, match=message):
        recognised(path, dict.fromkeys(("time", "input", "output", "rate")))
    with pytest.raises(ValueError, match=message):
        read_record(path, time=None, input=1, output=2)
