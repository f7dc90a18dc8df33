"""Every format of files, written by other libraries, and damaged in every way."""

import csv
import io
import re
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nptdms import ChannelObject, TdmsWriter
from openpyxl import Workbook
from scipy.io import savemat

from piezojax import (
    read_record,
)
from piezojax.identification.records.columns import decoded, parsed
from piezojax.identification.records.formats import FORMATS, read_columns

SAMPLES = 60
TIME = np.arange(SAMPLES) * 1e-3
DRIVE = 10.0 * np.sin(2.0 * np.pi * 50.0 * TIME)
SENSOR = 0.1 * DRIVE + 3.0
PAIR = np.stack([DRIVE, SENSOR], axis=1)


def table_text(separator, decimal, header=None, units=None):
    """Return a table as the program of a lab would print it, exact to the last bit."""
    rows = [
        [repr(float(x)).replace(".", decimal) for x in row]
        for row in zip(TIME, DRIVE, SENSOR, strict=True)
    ]
    lines = [line for line in (header, units) if line] + rows
    if separator == " ":
        return "".join("  ".join(line) + "\n" for line in lines)
    text = io.StringIO()
    csv.writer(text, delimiter=separator).writerows(lines)
    return text.getvalue()


def assert_columns(columns, expected):
    assert list(columns) == list(expected)
    for name, values in expected.items():
        assert columns[name].fault is None
        # Excel files have 16 digits: the last bit may differ.
        np.testing.assert_allclose(columns[name].values, values, rtol=4e-16, atol=0)


def refused(path, message):
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        read_columns(path)
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)


# Text


@given(
    separator=st.sampled_from([";", "\t", ",", " "]),
    decimal=st.sampled_from([".", ","]),
    header=st.sampled_from(
        [None, ["t", "u", "y"], ["Zeit", "Spannung", "Weg"], ["x1", "a,b", "#2"]]
    ),
    units=st.sampled_from([None, ["s", "V", "um"], ["[s]", "[V]", "[nm]"]]),
    ends=st.sampled_from(["\n", "\r\n"]),
    codec=st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"]),
    remark=st.sampled_from(["", "# bench 3, run 2; 1.5 V\n", "%\n% note\n"]),
)
def test_text_dialects(separator, decimal, header, units, ends, codec, remark):
    text = remark + table_text(separator, decimal, header, header and units)
    content = text.replace("\r\n", "\n").replace("\n", ends).encode(codec)
    columns = parsed(decoded(content))
    names = header or ["0", "1", "2"]
    assert_columns(columns, dict(zip(names, (TIME, DRIVE, SENSOR), strict=True)))
    found = [column.unit for column in columns.values()]
    assert found == (units if header and units else [None] * 3)


@pytest.mark.parametrize("codec", ["utf-8", "cp1252", "utf-16"])
def test_the_micro_sign_in_any_encoding(tmp_path, codec):
    text = table_text(";", ",", ["t", "u", "y"], ["s", "mV", "µm"])
    path = tmp_path / "record.csv"
    path.write_bytes(text.encode(codec))
    record = read_record(path, time="t", input="u", output="y")
    assert (record.input_unit, record.output_unit) == ("mV", "um")


def test_a_comma_between_whole_numbers_separates_them():
    columns = parsed("1,2\n3,4\n5,6\n")
    assert_columns(columns, {"0": [1.0, 3.0, 5.0], "1": [2.0, 4.0, 6.0]})


def test_a_comma_before_a_blank_separates():
    columns = parsed("t, u\n0.5, 1\n1.5, 2\n")
    assert_columns(columns, {"t": [0.5, 1.5], "u": [1.0, 2.0]})


def test_blanks_in_names_separate_nothing_beside_tabs():
    header = "Time (s)\tAO0 Piezo (V)\tAI3 CapSensor (um)"
    found = parsed(f"{header}\n0.0\t1.5\t2\n0.1\t2.5\t3\n")
    assert list(found) == header.split("\t")
    assert found["AO0 Piezo (V)"].values.tolist() == [1.5, 2.5]


def test_thousands_separators_are_not_decimals():
    columns = parsed("t;u\n0,5;1,5\n1,5;1.234\n2,5;2,5\n")
    assert columns["t"].fault is None
    assert columns["u"].fault == "sample 1: '1.234' is not a number"


def test_a_column_of_text_does_not_affect_the_others():
    columns = parsed("t;state;u\n0,5;on;1,5\n1,5;off;2,5\n")
    np.testing.assert_array_equal(columns["u"].values, [1.5, 2.5])
    assert columns["state"].fault == "sample 0: 'on' is not a number"


def test_empty_cells_are_missing_numbers_and_empty_names_are_counted():
    columns = parsed("t;;y;\n0,5;;1,5;\n1,5;2;;\n")
    assert list(columns) == ["t", "1", "y"]  # the last one is empty
    np.testing.assert_array_equal(columns["1"].values, [np.nan, 2.0])
    np.testing.assert_array_equal(columns["y"].values, [1.5, np.nan])


def test_separators_at_line_ends_are_not_columns():
    assert_columns(parsed("t;u\n1;2;\n3;4;\n"), {"t": [1.0, 3.0], "u": [2.0, 4.0]})


def test_a_row_of_broken_numbers_is_not_a_row_of_units():
    columns = parsed("t;u;y\n1;overload;2\n3;4;5\n")
    assert columns["u"].fault == "sample 0: 'overload' is not a number"
    assert columns["u"].unit is None


# Binary formats, written by their own libraries


def write_mat(path):
    stage = {"drive": DRIVE[:, None], "both": PAIR, "axis": {"sensor": SENSOR}}
    several = np.empty((1, 2), dtype=object)
    several[0, 0], several[0, 1] = DRIVE, SENSOR
    savemat(
        path,
        {"t": TIME, "stage": stage, "cells": several, "fs": 1e3, "note": "bench 3"},
    )
    return {
        "t": TIME,
        "stage.drive": DRIVE,
        "stage.both[0]": DRIVE,
        "stage.both[1]": SENSOR,
        "stage.axis.sensor": SENSOR,
        "cells[0]": DRIVE,
        "cells[1]": SENSOR,
    }


def write_hdf5(path):
    with h5py.File(path, "w", track_order=True) as file:
        file["t"] = TIME
        file["fs"] = 1e3
        file["note"] = "bench 3"
        file["nothing"] = h5py.Empty("f8")
        file.create_dataset("stage/drive", data=DRIVE[:, None])
        file.create_dataset("stage/both", data=PAIR, chunks=True, compression="gzip")
        file["wide"] = PAIR.T
        file["table"] = np.rec.fromarrays([TIME, SENSOR], names="when,where")
    return {
        "t": TIME,
        "stage/drive": DRIVE,
        "stage/both[0]": DRIVE,
        "stage/both[1]": SENSOR,
        "wide[0]": DRIVE,
        "wide[1]": SENSOR,
        "table.when": TIME,
        "table.where": SENSOR,
    }


def write_mat73(path):
    """Write a file like MATLAB with -v7.3: columns first, text as codes, a header."""
    with h5py.File(path, "w", userblock_size=512, track_order=True) as file:
        file["t"] = TIME[None, :]
        file["stage/both"] = PAIR.T
        file["note"] = np.array([[104], [105]], dtype="u2")
        file["note"].attrs["MATLAB_class"] = np.bytes_("char")
        file["empty"] = np.array([0, 5], dtype="u8")
        file["empty"].attrs["MATLAB_empty"] = np.uint8(1)
        file["#refs#/a"] = TIME
    header = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, HDF5 schema 1.00 ."
    with open(path, "r+b") as file:
        file.write(header.ljust(124) + b"\x00\x02IM")
    return {"t": TIME, "stage.both[0]": DRIVE, "stage.both[1]": SENSOR}


def write_npz(path):
    np.savez(path, t=TIME, both=PAIR, wide=PAIR.T, fs=1e3, note="bench 3")
    names = ["t", "both[0]", "both[1]", "wide[0]", "wide[1]"]
    return dict(zip(names, (TIME, DRIVE, SENSOR, DRIVE, SENSOR), strict=True))


def write_tdms(path):
    with TdmsWriter(path) as writer:
        for part in (slice(0, 20), slice(20, SAMPLES)):
            writer.write_segment(
                [
                    ChannelObject("bench", "drive", DRIVE[part]),
                    ChannelObject("bench", "sensor", SENSOR[part]),
                ]
            )
    return {"drive": DRIVE, "sensor": SENSOR}


def write_xlsx(path):
    book = Workbook()
    book.active.append(["time", "drive", "sensor"])
    for row in zip(TIME, DRIVE, SENSOR, strict=True):
        book.active.append([float(x) for x in row])
    book.create_sheet("notes").append(["not", "read"])
    book.save(path)
    book.close()
    return {"time": TIME, "drive": DRIVE, "sensor": SENSOR}


def lvm_text(x_columns="One", decimal=".", separator="\t"):
    """Return a segment as LabVIEW writes it (NI specification 4139)."""
    times = [repr(float(x)) for x in TIME]
    channels = [[repr(float(x)) for x in column] for column in (DRIVE, SENSOR)]
    step, units = ["1.0E-3"] * 2, ["Volts", "um"]
    names = ["X_Value", "drive", "sensor"]
    rows = [list(row) for row in zip(times, *channels, strict=True)]
    if x_columns == "Multi":
        names = ["X_Value", "drive", "X_Value", "sensor"]
        step, units = [step[0], "", step[1]], [units[0], "", units[1]]
        rows = [[time, u, time, y] for time, u, y in rows]
    if x_columns == "No":
        rows = [["", u, y] for _, u, y in rows]
    rows[3].append("a remark")
    name = {"\t": "Tab", ",": "Comma"}[separator]
    lines = [
        ["LabVIEW Measurement", ""],
        ["Writer_Version", "2"],
        ["Separator", name],
        ["Decimal_Separator", decimal],
        ["X_Columns", x_columns],
        ["***End_of_Header***", ""],
        ["", ""],
        ["Channels", "2", *[""] * (len(names) - 1)],
        ["Samples", "60", "60", ""],
        ["Y_Unit_Label", *units, ""],
        ["X_Dimension", "Time", "Time", ""],
        ["Delta_X", *step, ""],
        ["***End_of_Header***", "", "", ""],
        [*names, "Comment"],
        *rows,
    ]
    lines[9:12] = [[cell.replace(".", decimal) for cell in row] for row in lines[9:12]]
    lines[14:] = [[cell.replace(".", decimal) for cell in row] for row in lines[14:]]
    return "".join(separator.join(line) + "\r\n" for line in lines)


def write_lvm(path):
    path.write_text(lvm_text(), newline="")
    return {"X_Value": TIME, "drive": DRIVE, "sensor": SENSOR}


WRITERS = {
    "record.npz": write_npz,
    "record.mat": write_mat,
    "matlab73.mat": write_mat73,
    "record.h5": write_hdf5,
    "RECORD.HDF5": write_hdf5,
    "record.tdms": write_tdms,
    "record.lvm": write_lvm,
    "record.xlsx": write_xlsx,
}


@pytest.mark.parametrize("name", WRITERS)
def test_round_trip(tmp_path, name):
    path = tmp_path / name
    expected = WRITERS[name](path)
    columns = read_columns(path)
    # HDF5 lists its members by name, MATLAB in the order of saving.
    assert_columns({name: columns[name] for name in expected}, expected)
    assert set(columns) == set(expected)


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("share", [0.0, 0.05, 0.6, 0.97])
def test_a_file_cut_short_is_one_clear_error(tmp_path, name, share):
    path = tmp_path / name
    WRITERS[name](path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    if path.suffix == ".lvm" and share > 0.5:
        # Whole lines are missing, or the last line ends early: still a table.
        assert 20 < read_columns(path)["drive"].values.size < SAMPLES
    else:
        refused(path, path.name)


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_file_of_another_kind_is_one_clear_error(tmp_path, suffix):
    path = tmp_path / f"record{suffix}"
    path.write_bytes(np.random.default_rng(0).bytes(4096))
    refused(path, f"cannot be read: it is not {FORMATS[suffix].content}")


@pytest.mark.parametrize(
    ("suffix", "other"),
    [
        *(
            (suffix, "record.npz")
            for suffix in (".csv", ".mat", ".h5", ".tdms", ".lvm", ".xlsx")
        ),
        (".npz", "record.h5"),
        (".npz", "record.npy"),
        (".mat", "record.xlsx"),
        (".h5", "record.mat"),
        (".xlsx", "record.tdms"),
    ],
)
def test_a_wrong_suffix_is_one_clear_error(tmp_path, suffix, other):
    if other == "record.npy":
        np.save(tmp_path / other, TIME)
    else:
        WRITERS[other](tmp_path / other)
    path = (tmp_path / other).rename(tmp_path / f"wrong{suffix}")
    refused(path, f"cannot be read: it is not {FORMATS[suffix].content}")


@pytest.mark.parametrize("suffix", [".npz", ".mat", ".h5", ".tdms", ".lvm", ".xlsx"])
def test_a_text_table_of_another_name_is_one_clear_error(tmp_path, suffix):
    path = tmp_path / f"record{suffix}"
    path.write_text(table_text(",", ".", ["t", "u", "y"]))
    refused(path, f"cannot be read: it is not {FORMATS[suffix].content}")


def test_an_unknown_suffix_lists_the_known_ones(tmp_path):
    for name, suffix in (("record.doc", ".doc"), ("record", "")):
        message = (
            f"its suffix {suffix!r} is unknown; it must be one of .csv, .txt, .dat"
        )
        refused(tmp_path / name, message)


@pytest.mark.parametrize("suffix", [".npz", ".mat", ".h5", ".xlsx"])
def test_a_file_without_columns(tmp_path, suffix):
    path = tmp_path / f"record{suffix}"
    if suffix == ".npz":
        np.savez(path, fs=1e3, note="bench 3")
    elif suffix == ".mat":
        savemat(path, {"fs": 1e3})
    elif suffix == ".h5":
        with h5py.File(path, "w") as file:
            file["fs"] = 1e3
    else:
        Workbook().save(path)
    refused(path, "the file is empty" if suffix == ".xlsx" else "no column of numbers")


def test_a_pickle_is_not_opened(tmp_path):
    opened = tmp_path / "opened"

    class Trap:
        def __reduce__(self):
            return (opened.touch, ())

    path = tmp_path / "record.npz"
    np.savez(path, u=np.array([Trap()] * 60, dtype=object))
    refused(path, "cannot be read: it is not an NPZ archive of plain arrays")
    # The library of LVM files would load a cached pickle beside the file.
    lvm = tmp_path / "record.lvm"
    expected = write_lvm(lvm)
    Path(f"{lvm}.pkl").write_bytes(b"garbage")
    assert_columns(read_columns(lvm), expected)
    assert not opened.exists()


@pytest.mark.parametrize("x_columns", ["No", "One", "Multi"])
@pytest.mark.parametrize(
    ("decimal", "separator"), [(".", "\t"), (",", "\t"), (".", ",")]
)
def test_labview_text(tmp_path, x_columns, decimal, separator):
    path = tmp_path / "record.lvm"
    path.write_text(lvm_text(x_columns, decimal, separator), newline="")
    columns = read_columns(path)
    clocks = {"No": [], "One": ["X_Value"], "Multi": ["X_Value[0]", "X_Value[1]"]}
    expected = dict.fromkeys(clocks[x_columns], TIME)
    expected |= {"drive": DRIVE, "sensor": SENSOR}
    assert_columns({name: columns[name] for name in expected}, expected)
    assert set(columns) == set(expected)
    # The file has the sample time of its channels; neither column nor rate is needed.
    record = read_record(path, input="drive", output="sensor")
    assert record.dt == pytest.approx(1e-3, rel=1e-12)
    assert (record.input_unit, record.output_unit) == ("V", "um")


def test_several_labview_segments_are_separated(tmp_path):
    path = tmp_path / "record.lvm"
    head, body = lvm_text().split("***End_of_Header***\t\r\n\t\r\n")
    path.write_text(
        f"{head}***End_of_Header***\t\r\n\t\r\n{body}\t\r\n{body}", newline=""
    )
    columns = read_columns(path)
    assert {"0/drive", "1/sensor"} <= set(columns)
    np.testing.assert_array_equal(columns["1/sensor"].values, SENSOR)


def test_names_and_units_of_tdms_channels(tmp_path):
    path = tmp_path / "record.tdms"
    with TdmsWriter(path) as writer:
        for name, unit, values in (("u", "mV", DRIVE), ("y", "µm", SENSOR)):
            known = {"unit_string": unit, "wf_increment": 5e-5}
            writer.write_segment([ChannelObject("a", name, values, known)])
        writer.write_segment([ChannelObject("b", "u", DRIVE)])
    assert set(read_columns(path)) == {"a/u", "a/y", "b/u"}
    record = read_record(path, input="a/u", output="a/y")
    assert record.dt == pytest.approx(5e-5, rel=1e-12)
    assert (record.input_unit, record.output_unit) == ("mV", "um")


def tdms_step(path, step):
    with TdmsWriter(path) as writer:
        for name, values in (("u", DRIVE), ("y", SENSOR)):
            channel = ChannelObject("a", name, values, {"wf_increment": step})
            writer.write_segment([channel])


@pytest.mark.parametrize("step", [5e-5, "0.00005"])
def test_a_tdms_increment_as_number_and_as_text(tmp_path, step):
    tdms_step(tmp_path / "record.tdms", step)
    assert read_record(tmp_path / "record.tdms").dt == pytest.approx(5e-5, rel=1e-12)


@pytest.mark.parametrize("step", ["fast", -1.0, float("inf")])
def test_a_bad_tdms_increment_is_refused(tmp_path, step):
    tdms_step(tmp_path / "record.tdms", step)
    message = f"the time step of 'u' is {step!r}; it must be a number above 0"
    refused(tmp_path / "record.tdms", message)


@pytest.mark.parametrize("attribute", ["unit", "units"])
@pytest.mark.parametrize("kind", [str, np.bytes_])
def test_units_from_the_attributes_of_an_hdf5_file(tmp_path, attribute, kind):
    path = tmp_path / "record.h5"
    with h5py.File(path, "w") as file:
        for name, unit, values in (("u", "mV", DRIVE), ("y_um", "nm", SENSOR)):
            file[name] = values
            file[name].attrs[attribute] = kind(unit)
    record = read_record(path, input="u", output="y_um", rate=1e3)
    assert (record.input_unit, record.output_unit) == ("mV", "nm")


def test_an_excel_sheet_with_units_gaps_and_errors(tmp_path):
    path = tmp_path / "record.xlsx"
    book = Workbook()
    book.active.append(["t", "u", "y"])
    book.active.append(["s", "V", "nm"])
    for row in zip(range(SAMPLES), DRIVE, SENSOR, strict=True):
        book.active.append([float(x) for x in row])
    book.active["B7"] = None
    book.active["C9"] = "#DIV/0!"
    book.save(path)
    book.close()
    columns = read_columns(path)
    assert [column.unit for column in columns.values()] == ["s", "V", "nm"]
    assert np.flatnonzero(np.isnan(columns["u"].values)).tolist() == [4]
    assert columns["y"].fault == "sample 6: '#DIV/0!' is not a number"


@pytest.mark.parametrize(
    ("suffix", "package"),
    [(".tdms", "nptdms"), (".lvm", "lvm_read"), (".xlsx", "openpyxl")],
)
def test_a_missing_package_is_named(tmp_path, monkeypatch, suffix, package):
    monkeypatch.setitem(sys.modules, package, None)
    path = tmp_path / f"record{suffix}"
    path.write_bytes(b"")
    refused(path, f"needs the package {package}: pip install 'piezojax[lab]'")
