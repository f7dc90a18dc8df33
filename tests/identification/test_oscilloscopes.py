"""Exports of oscilloscopes and loggers: preambles, units, sample times in the file."""

import re

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from piezojax import read_record
from piezojax.identification.records.formats import read_columns

DT = 2e-5
COUNT = 60
TIME = -6e-4 + DT * np.arange(COUNT)
DRIVE = np.round(3.0 * np.sin(2.0 * np.pi * 700.0 * TIME), 4)
SENSOR = np.round(0.4 * DRIVE + 1.2, 4)


def rows(*columns, end=""):
    return "".join(
        ",".join(f"{value:.8e}" for value in row) + end + "\n"
        for row in zip(*columns, strict=True)
    )


def number_rows(*columns, end=""):
    lines = rows(*columns, end=end).splitlines(keepends=True)
    return "".join(f"{i},{line}" for i, line in enumerate(lines))


# One line per setting, one value per channel; most lines end with a comma.
TEKTRONIX_MSO = """Model,MSO4034
Firmware Version,2.48

Waveform Type,ANALOG,,
Point Format,Y,,
Horizontal Units,S,,
Horizontal Scale,0.0004,,
Horizontal Delay,0,,
Sample Interval,2e-05,,
Record Length,60,,
Gating,0.0% to 100.0%,,
Probe Attenuation,10,10,
Vertical Units,V,mV,
Vertical Offset,0,0,
Vertical Scale,1,2,
Vertical Position,-1.2,0.4,
,,,
,,,
Label,,,
TIME,CH1,CH2,
"""
TEKTRONIX_DPO = """Model,DPO2024B
Sample Interval,2.0000e-05
Horizontal Units,s
Vertical Units,V,mV
Source,CH1,CH2
TIME,CH1,CH2
"""
# Settings beside the first samples of the only channel.
SETTINGS = [
    *("Record Length,6.0e+01", "Sample Interval,2.000000000000e-05"),
    *("Trigger Point,3.0e+01", ",", ",", ",", "Source,CH2", "Vertical Units,mV"),
    *("Vertical Scale,5.0e-01", "Vertical Offset,0.0e+00", "Horizontal Units,s"),
    *("Pt Fmt,Y", "Yzero,0.0e+00", "Probe Atten,1.0e+00", "Note,", "Model,TDS2014"),
]
TEKTRONIX_TDS = "".join(
    f"{SETTINGS[i] if i < len(SETTINGS) else ','},,{t:.9f},  {y:.5f},\n"
    for i, (t, y) in enumerate(zip(TIME, SENSOR, strict=True))
)
INFINIIUM = """Revision:,0
Type:,raw
Start:,0
Points:,60
Count:,1
XDispRange:,1.2e-03
XDispOrg:,-6e-04
XInc:,2.0000E-05
XOrg:,-6.00E-04
YData range:,8.0E+00
Frame:,DSO9254A
Max Bandwidth:,2.5e9
XUnits:,Second,Second
YUnits:,Volt,Volt
Data:,
"""

EXPORTS = {
    "Rigol DS1000Z": (
        "X,CH1,CH2,Start,Increment,\n"
        "Sequence,Volt,Volt,-6.000000e-04,2.000000e-05\n"
        + number_rows(DRIVE, SENSOR, end=","),
        {"input": "CH1", "output": "CH2"},
        ("V", "V"),
    ),
    "Rigol DS1000E": (
        "X,CH1,CH2,\nSecond,Volt,Volt,\n" + rows(TIME, DRIVE, SENSOR, end=","),
        {"time": "X", "input": "CH1", "output": "CH2"},
        ("V", "V"),
    ),
    "Rigol MSO5000": (
        "CH1V,CH2V,t0 =-6.00e-04, tInc = 2.00e-05,\n" + rows(DRIVE, SENSOR, end=",,"),
        {"input": "CH1V", "output": "CH2V"},
        ("V", "um"),
    ),
    "Rigol DHO800": (
        "Time(s),CH1(V),CH2(mV)\n" + rows(TIME, DRIVE, SENSOR),
        {"time": 0, "input": 1, "output": 2},
        ("V", "mV"),
    ),
    "Keysight InfiniiVision": (
        "x-axis,1,2\nsecond,Volt,Volt\n" + rows(TIME, DRIVE, SENSOR),
        {"time": "x-axis", "input": "1", "output": "2"},
        ("V", "V"),
    ),
    "Keysight Infiniium": (
        INFINIIUM + rows(DRIVE, SENSOR),
        {"input": 0, "output": 1},
        ("V", "um"),
    ),
    "Tektronix MSO4000": (
        TEKTRONIX_MSO + rows(TIME, DRIVE, SENSOR, end=","),
        {"input": "CH1", "output": "CH2"},
        ("V", "mV"),
    ),
    "Tektronix DPO2000": (
        TEKTRONIX_DPO + rows(TIME, DRIVE, SENSOR),
        {"time": "TIME", "input": "CH1", "output": "CH2"},
        ("V", "mV"),
    ),
    "LeCroy": (
        "LECROYWR64Xi,12345,Waveform\nSegments,1,SegmentSize,60\n"
        "Segment,TrigTime,TimeSinceSegment1\n#1,08-Jan-2024 14:00:00,0\n"
        "Time,Ampl,Ampl1\n" + rows(TIME, DRIVE, SENSOR),
        {"time": "Time", "input": "Ampl", "output": "Ampl1"},
        ("V", "um"),
    ),
    "a rate in the preamble": (
        "Logger;7\nSampling rate [Hz];50 kHz\ndrive_V;sensor_um\n"
        + rows(DRIVE, SENSOR).replace(",", ";"),
        {"input": "drive_V", "output": "sensor_um"},
        ("V", "um"),
    ),
}


@pytest.mark.parametrize("name", EXPORTS)
def test_exports_are_read(tmp_path, name):
    text, columns, units = EXPORTS[name]
    path = tmp_path / "scope.csv"
    path.write_text(text, newline="")
    record = read_record(path, **columns)
    assert record.dt == pytest.approx(DT, rel=1e-6)
    np.testing.assert_array_equal(record.input, DRIVE)
    np.testing.assert_array_equal(record.output, SENSOR)
    assert (record.input_unit, record.output_unit) == units


def test_a_tektronix_file_of_one_channel(tmp_path):
    path = tmp_path / "F0000CH2.CSV"
    path.write_text(TEKTRONIX_TDS)
    with pytest.raises(ValueError, match=r"input column is 'time'; .*time, CH2$"):
        read_record(path, output="CH2")


def refused(path, message, **columns):
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        read_record(path, **columns)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Rigol DS1000Z", "the input column is 'X'; name the columns of input and out"),
        ("Keysight InfiniiVision", "there are x-axis, 1, 2"),
        ("Tektronix MSO4000", "there are TIME, CH1, CH2"),
    ],
)
def test_a_column_of_sample_numbers_is_not_a_signal(tmp_path, name, message):
    path = tmp_path / "scope.csv"
    path.write_text(EXPORTS[name][0])
    refused(path, message)


def test_an_interval_that_contradicts_the_times(tmp_path):
    path = tmp_path / "scope.csv"
    text = TEKTRONIX_MSO.replace("2e-05", "4e-05") + rows(TIME, DRIVE, SENSOR, end=",")
    path.write_text(text)
    columns = {"time": "TIME", "input": "CH1", "output": "CH2"}
    refused(
        path, "is 50000 Hz by column 'TIME' and 25000 Hz by column 'CH1'", **columns
    )


def test_codes_of_a_converter_are_refused(tmp_path):
    path = tmp_path / "scope.csv"
    text = TEKTRONIX_MSO + rows(TIME, np.round(25.0 * DRIVE), SENSOR, end=",")
    path.write_text(text)
    message = "export volts instead of the codes of the converter"
    refused(path, message, input="CH1", output="CH2")


def test_a_broken_sample_is_not_a_preamble(tmp_path):
    path = tmp_path / "scope.csv"
    text = rows(TIME, DRIVE, SENSOR)
    path.write_text("t,u,y\n" + text.replace(text.split(",")[0], "late", 1))
    refused(path, "sample 0: 'late' is not a number", time="t", input="u", output="y")


# Sample times as scalars and attributes


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("dt", DT), ("Ts", DT), ("sample_time", DT), ("SampleInterval", DT)),
        *(("fs", 5e4), ("Fs", 5e4), ("sample rate", "50000"), ("sampling_rate", 5e4)),
    ],
)
@pytest.mark.parametrize("place", ["data set", "group", "root", "beside"])
def test_a_rate_in_an_hdf5_file(tmp_path, name, value, place):
    path = tmp_path / "record.h5"
    with h5py.File(path, "w") as file:
        for channel, values in (("u", DRIVE), ("y", SENSOR)):
            data = file.create_dataset(f"run/{channel}", data=values)
            if place == "data set":
                data.attrs[name] = value
        if place == "beside":
            file["run"][name] = float(value)
        elif place != "data set":
            (file if place == "root" else file["run"]).attrs[name] = value
    record = read_record(path, input="run/u", output="run/y")
    assert record.dt == pytest.approx(DT, rel=1e-12)


@pytest.mark.parametrize("suffix", [".mat", ".npz"])
@pytest.mark.parametrize(("name", "value"), [("fs", 5e4), ("Ts", DT)])
def test_a_rate_beside_the_arrays(tmp_path, suffix, name, value):
    path = tmp_path / f"record{suffix}"
    arrays = {"u": DRIVE, "y": SENSOR, name: value}
    savemat(path, arrays) if suffix == ".mat" else np.savez(path, **arrays)
    record = read_record(path, input="u", output="y")
    assert record.dt == pytest.approx(DT, rel=1e-12)
    refused(path, "50000 Hz by column 'u'", input="u", output="y", rate=1e3)


@pytest.mark.parametrize(
    ("scalars", "message"),
    [
        ({"fs": 0.0}, "fs is 0.0; it must be a number above 0"),
        ({"dt": np.nan}, "dt is nan; it must be"),
        ({"dt": "fast"}, "dt is 'fast'; it must be"),
        ({"dt": 1e-3, "fs": 5e4}, "contradict each other: dt (0.001 s), fs (2e-05 s)"),
    ],
)
def test_a_bad_rate_is_refused(tmp_path, scalars, message):
    path = tmp_path / "record.h5"
    with h5py.File(path, "w") as file:
        file["u"], file["y"] = DRIVE, SENSOR
        file.attrs.update(scalars)
    refused(path, message, input="u", output="y")


# LabVIEW


def test_a_table_that_only_begins_like_a_measurement_file(tmp_path):
    path = tmp_path / "record.csv"
    lines = [
        *("LabVIEW Measurement", "Operator,A. Weber", "Sample Rate,20000 S/s", ""),
        *("Piezo (V),Sensor (um)", "0.5,1.0", "0.6,1.25"),
    ]
    path.write_text("\n".join(lines), encoding="utf-8")
    found = read_columns(path)
    assert list(found) == ["Piezo (V)", "Sensor (um)"]
    assert found["Sensor (um)"].values.tolist() == [1.0, 1.25]
    assert found["Piezo (V)"].dt == 5e-5


def labview(x_columns):
    names, body = ["X_Value", "u", "y"], [TIME, DRIVE, SENSOR]
    if x_columns == "Multi":
        names, body = ["X_Value", "u", "X_Value", "y"], [TIME, DRIVE, TIME, SENSOR]
    lines = [
        *("LabVIEW Measurement\t", "Writer_Version\t2", "Reader_Version\t2"),
        *("Separator\tTab", "Decimal_Separator\t.", "Multi_Headings\tYes"),
        *(f"X_Columns\t{x_columns}", "Time_Pref\tRelative", "***End_of_Header***\t"),
        *("\t", "Channels\t2\t\t", f"Samples\t{COUNT}\t{COUNT}\t"),
        *("X_Dimension\tTime\tTime\t", "X0\t0.0\t0.0\t", "Delta_X\t2.0E-5\t2.0E-5\t"),
        *("***End_of_Header***\t\t\t", "\t".join([*names, "Comment"])),
        *("\t".join(f"{x:.8e}" for x in row) for row in zip(*body, strict=True)),
    ]
    return "\r\n".join(lines) + "\r\n"


@pytest.mark.parametrize("suffix", [".lvm", ".csv", ".txt"])
@pytest.mark.parametrize("x_columns", ["One", "Multi"])
def test_labview_files_with_x_columns(tmp_path, suffix, x_columns):
    path = tmp_path / f"record{suffix}"
    path.write_text(labview(x_columns), newline="")
    record = read_record(path, input="u", output="y")
    assert record.dt == pytest.approx(DT, rel=1e-9)
    np.testing.assert_array_equal(record.input, DRIVE)
    np.testing.assert_array_equal(record.output, SENSOR)
    first = "X_Value" if x_columns == "One" else "X_Value[0]"
    refused(path, f"the input column is '{first}'; name the columns")
