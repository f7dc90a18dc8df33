"""Reading of the records of a lab, and the messages about bad ones."""

import re

import numpy as np
import pytest

from piezojax import (
    Record,
    read_record,
)
from piezojax.identification.records.record import SHORTEST

SAMPLES = 60
TIME = np.arange(SAMPLES) * 1e-3
DRIVE = 10.0 * np.sin(2.0 * np.pi * 50.0 * TIME)
SENSOR = 0.1 * DRIVE + 3.0
ROWS = [
    [repr(float(cell)) for cell in row] for row in zip(TIME, DRIVE, SENSOR, strict=True)
]
HEADER = ["time_s", "drive_V", "sensor_um"]
COLUMNS = {"time": "time_s", "input": "drive_V", "output": "sensor_um"}


def text_of(rows, header=HEADER, delimiter=","):
    lines = [header, *rows] if header else rows
    return "".join(delimiter.join(line) + "\n" for line in lines)


def changed(sample, column, cell):
    rows = [list(row) for row in ROWS]
    rows[sample][column] = cell
    return rows


@pytest.fixture
def write(tmp_path):
    def written(content, name="record.csv"):
        path = tmp_path / name
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            path.write_text(content, encoding="utf-8")
        return path

    return written


@pytest.fixture
def write_npz(tmp_path):
    def written(**arrays):
        path = tmp_path / "record.npz"
        np.savez(path, **arrays)
        return path

    return written


def assert_is_the_record(record):
    np.testing.assert_array_equal(record.input, DRIVE)
    np.testing.assert_array_equal(record.output, SENSOR)
    assert record.dt == pytest.approx(1e-3, rel=1e-12)


@pytest.mark.parametrize("delimiter", [",", ";", "\t", " ", "   "])
@pytest.mark.parametrize("header", [HEADER, None])
@pytest.mark.parametrize("name", ["record.csv", "record.txt", "record.dat"])
def test_text_files(write, delimiter, header, name):
    path = write(text_of(ROWS, header, delimiter), name)
    assert_is_the_record(read_record(path, time=0, input=1, output=2))


def test_columns_by_name_by_number_and_by_number_as_text(write):
    path = write(text_of(ROWS))
    assert_is_the_record(read_record(path, **COLUMNS))
    assert_is_the_record(read_record(path, time="0", input="1", output="2"))
    assert_is_the_record(read_record(str(path), time=0, input="drive_V", output=2))


def test_the_columns_may_have_any_order(write):
    rows = [row[::-1] for row in ROWS]
    path = write(text_of(rows, HEADER[::-1]))
    assert_is_the_record(read_record(path, **COLUMNS))


def test_a_column_named_by_a_digit_precedes_the_number(write):
    rows = [[row[0], row[2], row[1]] for row in ROWS]
    path = write(text_of(rows, ["time", "2", "drive"]))
    assert_is_the_record(read_record(path, time="time", input="drive", output="2"))


def test_without_time_the_rate_is_used(write):
    path = write(text_of([row[1:] for row in ROWS], HEADER[1:]))
    record = read_record(path, rate=250.0)
    np.testing.assert_array_equal(record.input, DRIVE)
    assert record.dt == pytest.approx(1.0 / 250.0)
    np.testing.assert_allclose(record.time, 4.0 * TIME, atol=1e-12)


def test_windows_line_ends_byte_order_mark_and_blank_lines(write):
    text = "\n" + text_of(ROWS).replace("\n", "\r\n") + "\r\n\r\n"
    record = read_record(write(b"\xef\xbb\xbf" + text.encode()), **COLUMNS)
    assert_is_the_record(record)


def test_quoted_cells(write):
    rows = [[f'"{cell}"' for cell in row] for row in ROWS]
    path = write(text_of(rows, ['"time, s"', '"drive_V"', '"sensor_um"']))
    assert_is_the_record(
        read_record(path, time="time, s", input="drive_V", output="sensor_um")
    )


def test_npz(write_npz):
    path = write_npz(t=TIME, drive_V=DRIVE, sensor_um=SENSOR[:, None])
    record = read_record(path, time="t", input="drive_V", output="sensor_um")
    assert_is_the_record(record)
    assert (record.input_unit, record.output_unit) == ("V", "um")


@pytest.mark.parametrize(
    ("header", "units"),
    [
        (["t", "drive_V", "sensor_um"], ("V", "um")),
        (["t", "current_mA", "angle_urad"], ("mA", "urad")),
        (["t", "the_long_name_kV", "z_nm"], ("kV", "nm")),
        (["t", "drive", "sensor"], ("V", "um")),
        (["t", "_V2", "sensor_1"], ("V", "um")),
        (["t", "drive_raw", "stage sensor"], ("V", "um")),
        (["t", "drive (mV)", "angle [arc sec]"], ("mV", "arc sec")),
        (["t", "i_µA", "z \N{GREEK SMALL LETTER MU}m"], ("uA", "um")),
        (None, ("V", "um")),
    ],
)
def test_units_come_from_the_names(write, header, units):
    record = read_record(write(text_of(ROWS, header)), time=0, input=1, output=2)
    assert (record.input_unit, record.output_unit) == units


def test_properties_of_a_record(write):
    record = read_record(write(text_of(ROWS), "stage.csv"), **COLUMNS)
    assert record.source == "stage.csv"
    assert record.span == pytest.approx(2.0, rel=1e-2)
    np.testing.assert_allclose(record.time, TIME, atol=1e-15)


def test_small_jitter_of_the_clock_is_accepted(write):
    jitter = 2e-7 * np.random.default_rng(1).uniform(-1.0, 1.0, SAMPLES)
    rows = [
        [repr(float(t)), *row[1:]] for t, row in zip(TIME + jitter, ROWS, strict=True)
    ]
    record = read_record(write(text_of(rows)), **COLUMNS)
    # The sample time is the mean step, so the jitter of a sample has no effect.
    assert record.dt == pytest.approx(1e-3, rel=1e-4)


def refused(path, message, **options):
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        read_record(path, **(options or COLUMNS))
    text = str(caught.value)
    assert path.name in text
    assert "\n" not in text


def test_missing_file(tmp_path):
    refused(tmp_path / "nowhere.csv", "No such file or directory")


def test_a_folder_is_refused(tmp_path):
    folder = tmp_path / "folder.csv"
    folder.mkdir()
    refused(folder, "Is a directory")


@pytest.mark.parametrize("content", ["", "\n\n  \n"])
def test_empty_file(write, content):
    refused(write(content), "the file is empty")


def test_header_without_rows(write):
    refused(write(text_of([])), f"0 samples; at least {SHORTEST} are needed")


@pytest.mark.parametrize("name", ["record.csv", "record.dat", "record.npz"])
def test_binary_garbage(write, name):
    garbage = np.random.default_rng(0).bytes(4096)
    refused(write(garbage, name), "cannot be read")


@pytest.mark.parametrize("role", ["time", "input", "output"])
@pytest.mark.parametrize("key", ["voltage", 3, "3"])
def test_a_missing_column_lists_the_columns(write, role, key):
    refused(
        write(text_of(ROWS)),
        f"{role} column {key!r} is missing; there are time_s, drive_V, sensor_um",
        **(COLUMNS | {role: key}),
    )


@pytest.mark.parametrize("cell", ["", "nan", "NaN", "inf", "-inf"])
@pytest.mark.parametrize(("column", "role"), [(1, "input"), (2, "output")])
def test_missing_numbers_name_column_and_sample(write, cell, column, role):
    refused(
        write(text_of(changed(17, column, cell))),
        f"{role} column {HEADER[column]!r} is missing or not finite at sample 17 (1",
    )


def test_missing_numbers_are_counted(write):
    rows = changed(17, 1, "")
    rows[40][1] = rows[41][1] = ""
    refused(write(text_of(rows)), "at sample 17 (3 in all)")


@pytest.mark.parametrize("cell", ["", "nan", "inf"])
def test_missing_time(write, cell):
    refused(
        write(text_of(changed(9, 0, cell))),
        "time column 'time_s' is missing or not finite at sample 9",
    )


def test_missing_numbers_in_other_columns_are_accepted(write):
    rows = [[*row, ""] for row in ROWS]
    record = read_record(write(text_of(rows, [*HEADER, "remark"])), **COLUMNS)
    assert_is_the_record(record)


@pytest.mark.parametrize("cell", ["overload", "1,5", "1.2.3", "0x10", "#N/A"])
def test_text_names_column_sample_and_cell(write, cell):
    refused(
        write(text_of(changed(3, 1, cell), delimiter=";")),
        f"column 'drive_V', sample 3: {cell!r} is not a number",
    )


@pytest.mark.parametrize(("width", "found"), [(2, 2), (4, 4)])
def test_ragged_rows(write, width, found):
    rows = [list(row) for row in ROWS]
    rows[12] = (rows[12] + ["1.0"])[:width]
    refused(
        write(text_of(rows)), f"sample 12 has {found} columns; the first line has 3"
    )


@pytest.mark.parametrize("lines", [1, 2, 3])
def test_titles_above_the_header(write, lines):
    plain = read_record(write(text_of(ROWS)), **COLUMNS)
    titled = read_record(write("my record: 7\n" * lines + text_of(ROWS)), **COLUMNS)
    np.testing.assert_array_equal(titled.input, plain.input)
    assert (titled.dt, titled.input_names) == (plain.dt, plain.input_names)


@pytest.mark.parametrize("samples", [0, 1, 2, SHORTEST - 1])
def test_short_record(write, samples):
    refused(
        write(text_of(ROWS[:samples])),
        f"{samples} samples; at least {SHORTEST} are needed",
    )


def test_the_shortest_accepted_record(write):
    record = read_record(write(text_of(ROWS[:SHORTEST])), **COLUMNS)
    assert record.input.size == SHORTEST


def test_unsorted_time(write):
    rows = list(ROWS)
    rows[20], rows[21] = rows[21], rows[20]
    refused(write(text_of(rows)), "time does not increase at sample 21")


def test_repeated_time(write):
    refused(
        write(text_of(changed(30, 0, ROWS[29][0]))),
        "time does not increase at sample 30",
    )


def test_a_gap_in_time(write):
    rows = ROWS[:25] + ROWS[27:]
    refused(
        write(text_of(rows)),
        "time is not uniform: step 0.003 s at sample 25, 0.001 s elsewhere",
    )


def test_neither_time_nor_rate(write):
    refused(
        write(text_of(ROWS)),
        "name the time column, or give its rate in Hz",
        input=1,
        output=2,
    )


@pytest.mark.parametrize("rate", [0.0, -200.0, float("nan"), float("inf")])
def test_impossible_rate(write, rate):
    refused(
        write(text_of(ROWS)),
        f"rate is {rate:g} Hz; it must be above 0",
        input=1,
        output=2,
        rate=rate,
    )


@pytest.mark.parametrize(("column", "role"), [(1, "input"), (2, "output")])
def test_constant_column(write, column, role):
    rows = [list(row) for row in ROWS]
    for row in rows:
        row[column] = "4.0"
    refused(write(text_of(rows)), f"{role} never changes")


def test_columns_of_an_npz_of_different_length(write_npz):
    path = write_npz(t=TIME, u=DRIVE[:-5], y=SENSOR)
    refused(
        path, "columns differ in length: t 60, u 55, y 60", time="t", input=1, output=2
    )


def test_npz_with_pickled_objects_is_not_opened(tmp_path):
    opened = tmp_path / "opened"

    class Trap:
        def __reduce__(self):
            return (opened.touch, ())

    path = tmp_path / "record.npz"
    np.savez(path, u=np.array([Trap()] * 60, dtype=object), y=SENSOR)
    refused(path, "cannot be read", input="u", output="y", rate=1000.0)
    assert not opened.exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dt": 0.0}, "the sample time is 0 s; it must be above 0"),
        ({"dt": float("nan")}, "the sample time is nan s; it must be above 0"),
        ({"inputs": DRIVE[:10]}, "input has 10 samples and output 60"),
        ({"inputs": np.zeros(SAMPLES)}, "input never changes"),
        ({"outputs": np.full(SAMPLES, np.nan)}, "not finite at sample 0 (60 in all)"),
        ({"inputs": np.zeros((SAMPLES, 1, 1))}, "input has shape (60, 1, 1)"),
        ({"input_units": ("V", "V")}, "2 units for 1 input columns"),
        ({"period": 1}, "the period is 1 samples; it must lie in 2..60"),
        ({"period": 61}, "the period is 61 samples; it must lie in 2..60"),
    ],
)
def test_a_record_from_arrays_is_checked(change, message):
    good = {"inputs": DRIVE, "outputs": SENSOR, "dt": 1e-3, "source": "bench"}
    assert Record(**good).span > 0
    with pytest.raises(ValueError, match="^bench: .*" + re.escape(message)):
        Record(**(good | change))


def test_missing_numbers_have_the_column_name_of_the_file(write):
    refused(write(text_of(changed(17, 1, ""))), "drive_V")


def test_repeated_column_names(write):
    # Numbers count the remaining columns: input=1 is then the sensor.
    path = write(text_of(ROWS, ["t", "t", "sensor_um"]))
    refused(path, "'t'", rate=1000.0, input=1, output=2)


def test_one_column_for_two_signals_is_refused(write):
    # The default input is column 0, which is time in most files.
    refused(write(text_of(ROWS)), "time_s", time="time_s", output=2)


def test_time_in_milliseconds_is_converted_or_refused(write):
    path = write(text_of(ROWS, ["time_ms", "drive_V", "sensor_um"]))
    try:
        record = read_record(path, time=0, input=1, output=2)
    except ValueError:
        return
    assert record.dt == pytest.approx(1e-6)


def test_a_unit_in_brackets_is_read(write):
    path = write(text_of(ROWS, ["time [s]", "drive [V]", "sensor [nm]"]))
    assert read_record(path, time=0, input=1, output=2).output_unit == "nm"


def test_text_in_the_first_row_of_a_file_without_header(write):
    refused(
        write(text_of(changed(0, 1, "oops"), None)), "oops", time=0, input=1, output=2
    )


def test_npz_time_of_another_length(write_npz):
    path = write_npz(t=TIME[:-5], u=DRIVE, y=SENSOR)
    refused(path, "length", time="t", input="u", output="y")


def test_an_npz_remark_does_not_affect_the_columns(write_npz):
    path = write_npz(t=TIME, u=DRIVE, y=SENSOR, remark="bench 3")
    assert_is_the_record(read_record(path, time="t", input="u", output="y"))


def test_npz_complex_column(write_npz):
    path = write_npz(u=DRIVE + 1j, y=SENSOR)
    refused(path, "complex", input="u", output="y", rate=1000.0)


def test_npz_garbage_does_not_advise_to_unpickle(write):
    path = write(b"garbage", "record.npz")
    with pytest.raises(ValueError, match="cannot be read") as caught:
        read_record(path, rate=1000.0)
    assert "unsafely" not in str(caught.value)


def test_a_record_of_several_channels():
    pair = np.stack([DRIVE, SENSOR], axis=1)
    record = Record(pair, SENSOR, 1e-3, input_units=("V", "mV"), source="bench")
    assert record.inputs.shape == (SAMPLES, 2)
    assert record.outputs.shape == (SAMPLES, 1)
    assert record.output_units == ("um",)
    np.testing.assert_array_equal(record.output, SENSOR)
    with pytest.raises(ValueError, match=r"^bench: the record has 2 inputs"):
        _ = record.input


# Several inputs and outputs


@pytest.fixture
def two_axes(write):
    rows = [[row[0], row[1], row[2], row[2], row[1]] for row in ROWS]
    return write(text_of(rows, ["t", "x_V", "x_um", '"y, drive_mV"', "y_nm"], ";"))


@pytest.mark.parametrize(
    ("input", "output"),
    [
        (["x_V", "y, drive_mV"], ["x_um", "y_nm"]),
        ((1, 3), (2, 4)),
        ("1,3", "2, 4"),
        ("x_V,3", "x_um,y_nm"),
        (["1", 3], "x_um , 4"),
    ],
)
def test_several_columns(two_axes, input, output):
    record = read_record(two_axes, time="t", input=input, output=output)
    np.testing.assert_array_equal(record.inputs, np.stack([DRIVE, SENSOR], axis=1))
    np.testing.assert_array_equal(record.outputs, np.stack([SENSOR, DRIVE], axis=1))
    assert record.input_units == ("V", "mV")
    assert record.output_units == ("um", "nm")


def test_an_existing_name_with_a_comma_is_one_column(two_axes):
    record = read_record(two_axes, time="t", input="y, drive_mV", output="y_nm")
    np.testing.assert_array_equal(record.input, SENSOR)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"input": "1,9"}, "input column '9' is missing; there are t, x_V, x_um"),
        ({"input": "1,1"}, "column 'x_V' is named twice: as input and as input"),
        ({"input": "x_V", "output": "2,x_V"}, "'x_V' is named twice: as input and as"),
        ({"input": []}, "no input column is named"),
        ({"input": 1, "output": ()}, "no output column is named"),
        (
            {"input": 1, "output": 2, "time": "t,x_um"},
            "time column 't,x_um' is missing",
        ),
        ({"input": -1, "output": 2}, "input column -1 is missing"),
    ],
)
def test_several_columns_refused(two_axes, options, message):
    refused(two_axes, message, **({"time": "t"} | options))


def test_columns_of_a_matrix(write_npz):
    pair = np.stack([DRIVE, SENSOR], axis=1)
    path = write_npz(u_mV=pair, y_um=pair.T)
    record = read_record(path, input="u_mV[0]", output="y_um[1],y_um[0]", rate=1e3)
    np.testing.assert_array_equal(record.outputs, pair[:, ::-1])
    assert (record.input_units, record.output_units) == (("mV",), ("um", "um"))
    refused(path, "there are u_mV[0], u_mV[1], y_um[0]", input="u_mV", rate=1e3)


def test_the_period_is_kept(write):
    assert read_record(write(text_of(ROWS)), **COLUMNS, period=20).period == 20
    assert read_record(write(text_of(ROWS)), **COLUMNS).period is None


def test_a_german_table(write):
    text = text_of(ROWS, ["Zeit [ms]", "Spannung (V)", "Weg"], ";").replace(".", ",")
    head, rows = text.split("\n", 1)
    record = read_record(
        write(f"% Stand 3\n{head}\nms;V;nm\n{rows}"),
        time="Zeit [ms]",
        input=1,
        output=2,
    )
    np.testing.assert_array_equal(record.input, DRIVE)
    assert record.dt == pytest.approx(1e-6)
    assert record.output_unit == "nm"


# The sample time


@pytest.mark.parametrize("rate", [1000.0, 1000.9, 999.1])
def test_a_rate_beside_the_time_must_agree(write, rate):
    record = read_record(write(text_of(ROWS)), **COLUMNS, rate=rate)
    assert record.dt == pytest.approx(1e-3, rel=1e-12)


@pytest.mark.parametrize("rate", [250.0, 1001.5, 998.5, 1e6])
def test_a_rate_that_contradicts_the_time_is_refused(write, rate):
    refused(
        write(text_of(ROWS)),
        f"the sample rate is 1000 Hz by column 'time_s' and {rate:.6g} Hz by the rate; "
        "they must agree within 0.1 %",
        **COLUMNS,
        rate=rate,
    )


@pytest.mark.parametrize("name", ["time_min", "time [h]", "t [samples]"])
def test_time_in_an_unknown_unit(write, name):
    path = write(text_of(ROWS, [name, *HEADER[1:]]))
    refused(
        path, "an unknown unit; it must be one of s, ms, us", time=0, input=1, output=2
    )


def uneven():
    """Return a straight and a kinked line with time steps of 1 and 3 ms."""
    time = np.cumsum(np.tile([1e-3, 3e-3, 1e-3], 70))
    return [
        [repr(float(x)) for x in row]
        for row in zip(time, 5.0 * time, np.abs(time - time[100]), strict=True)
    ], time


def test_uneven_time_is_refused_with_a_remedy(write):
    rows, _ = uneven()
    refused(
        write(text_of(rows)),
        "time is not uniform: step 0.003 s at sample 1, 0.001 s elsewhere; "
        "--resample HZ interpolates it",
    )


@pytest.mark.parametrize("rate", [1000.0, 400.0, 777.7])
def test_uneven_time_is_resampled_if_asked(write, rate):
    rows, time = uneven()
    record = read_record(write(text_of(rows)), **COLUMNS, resample=rate)
    grid = time[0] + np.arange(record.samples) / rate
    assert grid[-1] <= time[-1] + 1e-12 < grid[-1] + 1.0 / rate
    assert record.dt == pytest.approx(1.0 / rate, rel=1e-15)
    # Straight lines are kept; a kink at a sample is smoothed by at most one step.
    np.testing.assert_allclose(record.input, 5.0 * grid, rtol=1e-12)
    np.testing.assert_allclose(record.output, np.abs(grid - time[100]), atol=1.5e-3)


def test_resampling_at_the_samples_changes_nothing(write):
    record = read_record(write(text_of(ROWS)), **COLUMNS, resample=1000.0)
    assert record.samples == SAMPLES
    np.testing.assert_allclose(record.output, SENSOR, rtol=0, atol=1e-12)


def test_a_record_without_time_is_resampled_from_its_rate(write):
    path = write(text_of(ROWS))
    record = read_record(path, input=1, output=2, rate=1000.0, resample=2000.0)
    assert record.samples == 2 * SAMPLES - 1
    np.testing.assert_allclose(record.input[::2], DRIVE, rtol=0, atol=1e-12)
    middle = 0.5 * (DRIVE[1:] + DRIVE[:-1])
    np.testing.assert_allclose(record.input[1::2], middle, rtol=0, atol=1e-12)


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf")])
def test_impossible_resampling(write, rate):
    refused(
        write(text_of(ROWS)),
        f"resample is {rate:g} Hz; it must be above 0",
        **COLUMNS,
        resample=rate,
    )


@pytest.mark.parametrize(("rate", "samples"), [(1e11, "5.9e+09"), (1e300, "5.9e+298")])
def test_resampling_beyond_the_memory_is_refused(write, rate, samples):
    refused(
        write(text_of(ROWS)),
        f"resample is {rate:g} Hz: 0.059 s would be {samples} samples; at most 1e+08",
        **COLUMNS,
        resample=rate,
    )


def test_resampling_does_not_sort_time(write):
    rows = list(ROWS)
    rows[20], rows[21] = rows[21], rows[20]
    refused(
        write(text_of(rows)),
        "time does not increase at sample 21",
        **COLUMNS,
        resample=1000.0,
    )


def test_a_time_column_is_not_a_signal(tmp_path):
    path = tmp_path / "clock.csv"
    rows = [f"{0.1 * k:.1f},{k % 7},{k % 5}" for k in range(60)]
    for header in ("time_s,u,y", "Time (s),u,y", "time,u,y"):
        path.write_text("\n".join([header, *rows]), encoding="utf-8")
        with pytest.raises(ValueError, match=r"the input column is '[Tt]ime"):
            read_record(path, rate=10.0)


@pytest.mark.parametrize("value", ["1e101", "-3e300"])
def test_values_whose_squares_are_not_finite(write, value):
    rows = list(ROWS)
    rows[7] = [rows[7][0], value, *rows[7][2:]]
    reached = f"input reaches {abs(float(value)):g}; it must stay below 1e+100"
    refused(write(text_of(rows)), reached, **COLUMNS)
