"""Trajectories in files as references of a study."""

import copy

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from piezojax.study import Study, build
from piezojax.study.trajectories import read_trajectories
from piezojax.tuning.contouring import contours_in
from piezojax.tuning.data import make_data
from piezojax.tuning.reach import require_reach
from piezojax.tuning.traces import traces_of

STUDY = {
    "title": "a stage of 140 um",
    "rate": 1000.0,
    "plant": {"type": "FirstOrderLag", "time_constant": 1e-2, "dt": 1e-3},
    "actuator": {"lower": -20.0, "upper": 120.0},
    "controller": {"type": "PID", "proportional": 0.1, "integral": 1.0, "dt": 1e-3},
    "references": {"tune": ["scan"], "duration": 0.2, "settle": 0.1},
    "tune": ["controller.integral"],
}
TIME = np.arange(501) / 500.0  # 1 s at 500 Hz
PATH = 30.0 + 20.0 * np.sin(2.0 * np.pi * 3.0 * TIME) + 5.0 * TIME


@pytest.fixture
def folder(tmp_path):
    text = "\n".join(f"{t:.6f},{z:.9f}" for t, z in zip(TIME, PATH, strict=True))
    (tmp_path / "scan.csv").write_text("time_s,z_um\n" + text)
    return tmp_path


def study_of(files, **tables):
    references = STUDY["references"] | tables.pop("references", {}) | {"files": files}
    study = STUDY | tables | {"references": references}
    return Study.model_validate(study)


def read(folder, table, **tables):
    study = study_of({"scan": {"file": "scan.csv"} | table}, **tables)
    return read_trajectories(study, folder)["scan"]


STAMPED = {"time": "time_s"}


@pytest.mark.parametrize("start", [0.0, 0.3, 0.333])
def test_a_trajectory_is_linear_between_its_samples(folder, start):
    found = read(folder, STAMPED | {"start": start, "scale": 2.0, "offset": -3.0})
    instants = start + np.arange(200) / 1000.0
    index = np.floor(instants * 500.0 + 1e-9).astype(int)
    share = instants * 500.0 - index
    expected = (1.0 - share) * PATH[index] + share * PATH[index + 1]
    np.testing.assert_allclose(found.values[:, 0], 2.0 * expected - 3.0, atol=1e-6)
    assert "501 samples of scan.csv at 500 Hz, interpolated linearly at 1000" in (
        found.note
    )


def test_every_format_and_unit_gives_the_same_reference(folder):
    expected = read(folder, STAMPED).values
    np.savez(folder / "scan.npz", z=1e-6 * PATH, fs=500.0)
    savemat(folder / "scan.mat", {"t": TIME, "z_nm": 1e3 * PATH})
    with h5py.File(folder / "scan.h5", "w") as file:
        file["z"] = 1e-3 * PATH
        file["z"].attrs.update({"units": "mm", "dt": 2e-3})
    for table in (
        {"file": "scan.npz", "unit": "m"},
        {"file": "scan.mat", "column": "z_nm", "time": "t"},
        {"file": "scan.h5"},
    ):
        np.testing.assert_allclose(read(folder, table).values, expected, atol=1e-6)


def test_uneven_samples_are_read_at_their_times(folder):
    time = np.linspace(0.0, 1.0, 400) ** 2
    np.savez(folder / "scan.npz", t=time, z_um=np.interp(time, TIME, PATH))
    found = read(folder, {"file": "scan.npz", "time": "t", "column": "z_um"})
    expected = read(folder, STAMPED)
    assert "uneven steps" in found.note
    np.testing.assert_allclose(found.values, expected.values, atol=0.05)


def test_a_short_trajectory_is_held_or_repeated(folder):
    long = {"references": {"duration": 2.5}}
    held = read(folder, STAMPED | {"then": "hold"}, **long).values[:, 0]
    np.testing.assert_allclose(held[1000:], PATH[-1], atol=1e-6)
    again = read(folder, STAMPED | {"then": "repeat"}, **long)
    # 501 samples of 2 ms: the period is 1.002 s.
    values = again.values[:, 0]
    np.testing.assert_allclose(values[1002:2004], values[:1002], atol=1e-6)
    assert again.note.endswith("then repeated")


def test_another_part_of_a_file_is_held_out(folder):
    parts = {
        "line": {"file": "scan.csv", **STAMPED},
        "later": {"file": "scan.csv", "start": 0.5, **STAMPED},
    }
    names = {"references": {"tune": ["line", "SIN5"], "unseen": ["later"]}}
    case = build(study_of(parts, **names), folder / "study.toml")
    data = make_data(case)
    assert data.names == ("line", "SIN5", "later")
    holdout, tuning = data.holdout.references, data.tuning.references
    for run, start in ((0, 0), (2, 250)):
        np.testing.assert_allclose(
            holdout[run, ::2], PATH[start : start + 100], atol=1e-6
        )
    np.testing.assert_allclose(tuning, holdout[:2])
    assert case.margin_reference == pytest.approx(holdout.max())
    assert any("0.5 to 0.699 s of 1 s" in note for note in case.notes)
    require_reach(case, data)
    parts["later"]["start"] = 0.1
    with pytest.raises(ValueError, match=r"later shares the samples from 0.1 to 0.199"):
        build(study_of(parts, **names), folder / "study.toml")


def test_a_trajectory_beyond_the_stroke_is_refused(folder):
    table = {"scan": {"file": "scan.csv", "scale": 10.0, **STAMPED}}
    case = build(study_of(table), folder / "study.toml")
    with pytest.raises(ValueError, match=r"change scale or offset under references\.f"):
        require_reach(case, make_data(case))


AXES = {
    "axes": {"names": ["X", "Y", "Rz"], "units": ["um", "um", "urad"]},
    "plant": {"type": "PerAxis", "parts": [STUDY["plant"]] * 3},
    "controller": {"type": "PerAxis", "parts": [STUDY["controller"]] * 3},
    "tune": ["controller.0.integral"],
}


def test_columns_drive_their_axes(folder):
    np.savez(folder / "scan.npz", x_um=PATH, y=1e3 * PATH[::-1], dt=2e-3)
    table = {"scan": {"file": "scan.npz", "axes": {"X": "x_um", "Y": "y"}}}
    table["scan"]["unit"] = "nm"
    with pytest.raises(ValueError, match="column 'x_um' is in um in the file, but"):
        read_trajectories(study_of(table, **AXES), folder)
    np.savez(folder / "scan.npz", x_um=PATH, y_nm=1e3 * PATH[::-1], dt=2e-3)
    table["scan"] = {"file": "scan.npz", "axes": {"Y": "y_nm", "X": "x_um"}}
    study = study_of(table, **AXES, references={"offset": [1.0, 2.0, 3.0]})
    values = read_trajectories(study, folder)["scan"].values
    np.testing.assert_allclose(values[::2, 0], PATH[:100])
    np.testing.assert_allclose(values[::2, 1], PATH[::-1][:100])
    np.testing.assert_allclose(values[:, 2], 3.0)
    assert [trace.driven for trace in traces_of(study)] == [True, True, False]
    assert [contour.axes for contour in contours_in(study)] == [(1, 0)]


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"file": "none.csv"}, "references.files.scan: record .*none.csv: No such"),
        ({}, "scan.csv: name the time column, or give its rate in Hz"),
        ({"time": "time_s", "column": "y_um"}, "column 'y_um' is missing; there are t"),
        ({"time": "time_s", "column": "time_s"}, "the column column is 'time_s'"),
        ({"time": "time_s", "unit": "nm"}, "is in um in the file, but unit is nm"),
        ({"rate": 500.0, "time": "time_s", "start": 2.0}, "start is 2 s; scan.csv end"),
        ({"time": "time_s", "start": 0.9}, r'holds 0.1 s from.*then = "hold" or then'),
        ({"time": "time_s", "rate": 400.0}, "the sample rate is 500 Hz by column"),
        ({"time": "time_s", "axes": {"X": 1}}, "axes is for a stage with several axes"),
        ({"file": "flat.npz", "rate": 500.0}, "column 'z_um' never changes from 0 s"),
        ({"file": "two.npz", "rate": 500.0}, "name the column: two.npz has a_um, b_um"),
        ({"file": "bare.npz", "rate": 500.0}, "unit of column 'z' is not known: set u"),
        ({"file": "bare.npz", "rate": 500.0, "unit": "V"}, "'z' is in V, and um is ne"),
    ],
)
def test_a_bad_file_is_one_line(folder, table, message):
    np.savez(folder / "flat.npz", z_um=np.append(np.zeros(300), 1.0))
    np.savez(folder / "two.npz", a_um=PATH, b_um=PATH)
    np.savez(folder / "bare.npz", z=PATH)
    with pytest.raises(ValueError, match=message) as caught:
        read(folder, table)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "table", "message"),
    [
        ("scan", {"scale": 0.0}, "files.scan: scale is 0"),
        ("SIN5", {}, "files.SIN5: SIN5 is the name of a signal"),
        ("a b", {}, "files.a b: the name must begin with a letter or _"),
        ("other", {}, "files.other is in neither tune nor unseen"),
        ("scan", {"then": "stop"}, "files.scan.then"),
        ("scan", {"column": -1}, "files.scan.column"),
        ("scan", {"offset": [1.0, 2.0]}, "files.scan.offset holds 2 values; the study"),
    ],
)
def test_a_bad_table_is_refused(name, table, message):
    from piezojax.study.tables import validated

    files = {"scan": {"file": "scan.csv"}, name: {"file": "scan.csv"} | table}
    study = copy.deepcopy(STUDY)
    study["references"] |= {"files": files}
    if name != "other":
        study["references"]["tune"] = list(files)
    with pytest.raises(ValueError, match=message) as caught:
        validated(Study, study, "")
    assert "\n" not in str(caught.value)
