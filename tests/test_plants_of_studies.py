"""Plants that a study fits or loads: several records, options, residuals."""

import copy
import dataclasses
import hashlib
import json
import tomllib

import numpy as np
import pytest

import piezojax as pj
from piezojax.analysis.stability import stability_reports
from piezojax.core.serial import read_about
from piezojax.identification import read_record
from piezojax.identification.estimators.estimate import Options
from piezojax.identification.estimators.modal_model import ModalFit, ModalValue
from piezojax.identification.residual_record import (
    ResidualRecord,
    Stretch,
    load_residual,
    residual_path,
)
from piezojax.report.fit_pictures import write_model
from piezojax.study import (
    Study,
    as_toml,
    build,
    contents_of,
    sha256_of,
    study_schema,
)
from piezojax.study.stage_tables import AxesTable
from piezojax.study.study_file import _FILES
from piezojax.tuning.data import make_data
from piezojax.tuning.make_result import _hysteresis_notes, _residual_notes
from piezojax.tuning.response_margins import margins_on_response
from piezojax.tuning.tuner import _model_alarms
from piezojax.tuning.unexplained import residual_disturbances

RATE, PERIOD = 1000.0, 200
TABLE = {
    "record": ["a.csv", "b.csv"],
    "model": "state_space",
    "method": "frequency_response",
    "time": "time_s",
    "input": "drive_V",
    "output": "moved_um",
    "resample": RATE,
    "period": PERIOD,
    "order": 1,
}
STUDY = {
    "title": "a lag from two records",
    "rate": RATE,
    "plant": TABLE,
    "actuator": {"lower": -20.0, "upper": 120.0},
    "controller": {"type": "PID", "proportional": 0.1, "integral": 1.0, "dt": 1e-3},
    "references": {"tune": ["SIN5"], "duration": 0.4, "settle": 0.1},
    "tune": ["controller.integral"],
}


def study_of(**tables):
    return Study.model_validate(copy.deepcopy(STUDY) | tables)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Records of a lag at 2 kHz, which are resampled to the rate of the study."""
    folder = tmp_path_factory.mktemp("records")
    for name, seed, length in (("a", 0, 6), ("b", 1, 4)):
        random = np.random.default_rng(seed)
        lines = random.standard_normal(31) + 1j * random.standard_normal(31)
        lines[0] = 0.0
        drive = np.tile(100.0 * np.fft.irfft(lines, 2 * PERIOD), length)
        moved = np.zeros(drive.size)
        for k in range(1, drive.size):
            moved[k] = 0.95 * moved[k - 1] + 0.02 * drive[k - 1]
        moved += 0.01 * random.standard_normal(drive.size)
        time = np.arange(drive.size) / (2.0 * RATE)
        np.savetxt(
            folder / f"{name}.csv",
            np.c_[time, drive, moved],
            delimiter=",",
            header="time_s,drive_V,moved_um",
            comments="",
        )
    return folder


@pytest.fixture(scope="module")
def case(folder):
    return build(study_of(), folder / "study.toml")


def test_a_study_fits_what_identify_fits(folder, case):
    columns = {"time": "time_s", "input": "drive_V", "output": "moved_um"}
    records = [
        read_record(folder / f"{n}.csv", **columns, resample=RATE, period=PERIOD)
        for n in "ab"
    ]
    direct = pj.identify(
        records, "state_space", method="frequency_response", options=Options(order=1)
    )
    assert len(case.fit.records) == 2
    assert case.fit.records[0].period == PERIOD
    for path in ("dynamics.A1.0", "calibration.offset"):
        if path in pj.core.paths.parameters(direct.system):
            assert pj.core.paths.get(case.loop.plant, path) == pytest.approx(
                pj.core.paths.get(direct.system, path)
            )
    assert case.fit.report.validation.rmse == direct.report.validation.rmse
    assert case.fit.report.validation.rmse < 0.1


def test_a_study_keeps_its_records_and_its_hash_in_another_folder():
    study = study_of()
    moved = study_of(**tomllib.loads(as_toml(study, lambda file: f"../{file}")))
    assert moved.plant["record"] == ["../a.csv", "../b.csv"]
    assert sha256_of(moved, ()) == sha256_of(study, ())
    renamed = study_of(**tomllib.loads(as_toml(study, lambda file: f"{file}_2")))
    assert sha256_of(renamed, ()) != sha256_of(study, ())


def test_the_hash_of_a_study_follows_the_content_of_its_files(tmp_path):
    study = study_of()
    for name in ("a.csv", "b.csv"):
        (tmp_path / name).write_text(name, encoding="utf-8")
    contents = contents_of(study, tmp_path)
    expected = [
        hashlib.sha256(name.encode()).hexdigest() for name in ("a.csv", "b.csv")
    ]
    assert contents == tuple(expected)
    first = sha256_of(study, contents)
    (tmp_path / "b.csv").write_text("longer", encoding="utf-8")
    assert sha256_of(study, contents_of(study, tmp_path)) != first
    (tmp_path / "b.csv").unlink()
    assert contents_of(study, tmp_path) == (expected[0], "")


def texts_in(content):
    if isinstance(content, dict | list):
        inner = content.values() if isinstance(content, dict) else content
        return [text for each in inner for text in texts_in(each)]
    return [content] if isinstance(content, str) else []


@pytest.mark.parametrize(
    "plant",
    [
        {"record": ["d/a", "d/b"], "check": ["d/c"]},
        {"records": "d/a", "check": "d/b"},
        {"records": ["d/a"]},
        {"response": "d/a"},
        {"file": "d/a"},
    ],
)
def test_every_file_of_a_study_is_renamed(plant):
    file = {"file": "d/x", "column": "z"}
    references = STUDY["references"] | {"tune": ["ref"], "files": {"ref": file}}
    study = study_of(
        plant=plant,
        controller={"file": "d/x"},
        references=references,
        sensor={"measured_noise": file},
        disturbance={"output": file, "input": file},
        ensemble={"standard_errors": "d/x"},
        beside={"other": {"controller": {"file": "d/x"}}},
    )
    found = texts_in(tomllib.loads(as_toml(study, lambda name: f"../{name}")))
    assert sum("d/" in text for text in found) == 7 + len(texts_in(plant))
    assert not [text for text in found if text.startswith("d/")]
    inner = study_of(**tomllib.loads(as_toml(study, lambda name: f"e/{name}")))
    assert sha256_of(inner, ()) == sha256_of(study, ())


def test_no_field_of_a_study_with_a_file_is_forgotten():
    def paths_in(table):
        for key, each in table.get("properties", {}).items():
            if '"format": "path"' in json.dumps(each):
                yield key

    schema = study_schema()
    found = {key for t in (schema, *schema["$defs"].values()) for key in paths_in(t)}
    assert found == _FILES


def test_the_residual_is_that_of_every_record(case):
    found = ResidualRecord.of(case.fit)
    assert [len(one.residual) for one in found.parts["train"]] == [600, 600]
    # The shorter record has fewer samples to validate on.
    assert [len(one.residual) for one in found.parts["validate"]] == [600, 200]
    record, run = case.fit.records[1], case.fit.simulations[1]
    np.testing.assert_array_equal(
        found.parts["validate"][1].residual, (record.outputs - run)[600:]
    )


def test_a_saved_plant_keeps_its_residual(folder, case, tmp_path):
    write_model(case.fit, tmp_path)
    model = tmp_path / "model.json"
    assert residual_path(model).name == "model.residual.npz"
    study = study_of(plant={"file": "model.json"})
    loaded = build(study, tmp_path / "study.toml")
    # The disturbances are those of the plant fitted in a study.
    fitted, saved = make_data(case), make_data(loaded)
    assert np.abs(fitted.tuning.disturbance).max() > 0.005
    for part in ("tuning", "holdout"):
        np.testing.assert_allclose(
            getattr(saved, part).disturbance, getattr(fitted, part).disturbance
        )
    (note,) = _residual_notes(loaded)
    assert "this residual is a disturbance of the loop" in note
    rmse = case.fit.report.validation.rmse
    assert f"leaves {rmse:.3g} um rms of its record" in note
    residual_path(model).unlink()
    without = build(study, tmp_path / "study.toml")
    assert make_data(without).tuning.disturbance is None
    (note,) = _residual_notes(without)
    assert "the file of that residual is not beside the model" in note
    assert "\n" not in note


def test_the_note_on_the_residual_has_the_unit_of_each_axis(case):
    axes = AxesTable(names=("x", "tilt"), units=("um", "urad"))
    several = dataclasses.replace(
        case,
        fit=None,
        study=case.study.model_copy(update={"axes": axes}),
        plant_about=case.plant_about.model_copy(update={"residual_rms": [0.125, 2.5]}),
    )
    (note,) = _residual_notes(several)
    assert "leaves 0.125 um, 2.5 urad rms of its record unexplained" in note


def test_gains_carry_the_alarms_of_their_plant(case):
    about = case.plant_about.model_copy(
        update={"unsafe": ["the input is a time"], "error_bound": None}
    )
    fitted = dataclasses.replace(case, plant_about=about)
    stability = stability_reports({"after": case.loop}, case.margin_reference)
    first, second = _model_alarms(fitted, case.study.limits, stability)
    assert first == "the input is a time"
    assert "gives no bound on the error" in second
    # A study may accept a plant from a file; its gains are not safer than the plant.
    loaded = dataclasses.replace(fitted, fit=None)
    assert _model_alarms(loaded, case.study.limits, stability) == [first]


def test_a_residual_of_another_model_is_refused(case, tmp_path):
    write_model(case.fit, tmp_path)
    model = tmp_path / "model.json"
    about = read_about(model)
    other = about.model_copy(update={"residual_rms": [2.0 * about.residual_rms[0]]})
    with pytest.raises(ValueError, match=r"model.residual.npz is the residual of ano"):
        load_residual(model, other)
    for content in (b"", b"no archive"):
        residual_path(model).write_bytes(content)
        with pytest.raises(ValueError, match="is not the residual of a model") as found:
            load_residual(model, about)
        assert "\n" not in str(found.value)
    np.savez(residual_path(model), dt=1e-3, train_0_residual=np.zeros((5, 1)))
    with pytest.raises(ValueError, match="is not the residual of a model"):
        load_residual(model, about)
    with pytest.raises(ValueError, match=r"^plant.file: .*is not the residual"):
        build(study_of(plant={"file": "model.json"}), tmp_path / "study.toml")


def test_several_axes_play_their_residuals_together():
    """Both axes come from the same samples, wherever the stretch begins."""
    time = np.arange(1000.0)
    moved = np.stack([1e-9 * time, 1e-9 * time], axis=1)
    residual = np.stack([time, -2.0 * time], axis=1)
    both = (Stretch(residual, moved),)
    record = ResidualRecord(1e-3, {"train": both, "validate": both})
    found = residual_disturbances(
        record, np.zeros((400, 2)), 1e-3 * np.arange(400.0), "validate"
    )
    assert found.shape == (2, 400, 2)
    np.testing.assert_allclose(found[..., 1], -2.0 * found[..., 0], atol=1e-9)
    alone = dataclasses.replace(
        record, parts={"validate": (Stretch(residual[:, :1], moved[:, :1]),)}
    )
    single = residual_disturbances(
        alone, np.zeros(400), 1e-3 * np.arange(400.0), "validate"
    )
    np.testing.assert_allclose(single, found[..., 0])


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"record": []}, "plant.record: Tuple should have at least 1 item"),
        ({"among": ["duhem"]}, 'plant: among and test need model = "all"'),
        ({"model": "all"}, 'plant: method needs one model; model = "all" uses'),
        (
            {"period": 1},
            "plant.period is 1: Input should be greater than or eq",
        ),
        ({"order": 0}, "plant.order is 0: Input should be greater"),
        ({"resample": 500.0}, "rate is 1000 Hz, but plant.record was made for 500 Hz"),
        ({"record": ["a.csv", "none.csv"]}, "none.csv: No such file"),
        ({"method": "subspce"}, "method 'subspce' is unknown"),
        ({"catalog": "p753_dob"}, "plant has the keys"),
    ],
)
def test_a_bad_plant_is_one_line(folder, table, message):
    with pytest.raises(ValueError, match=message) as caught:
        build(study_of(plant=TABLE | table), folder / "study.toml")
    assert "\n" not in str(caught.value)


# A plant from a frequency response


def response_file(folder):
    """A mode at 100 Hz with a delay, in nm/V; return the lines and um/V."""
    frequency = np.geomspace(5.0, 480.0, 120)
    s, w = 2j * np.pi * frequency, 2.0 * np.pi * 100.0
    values = 0.1 * w**2 / (s**2 + 0.04 * w * s + w**2) * np.exp(-3e-4 * s)
    np.savetxt(
        folder / "bench.csv",
        np.c_[frequency, 1e3 * np.abs(values), np.degrees(np.angle(values))],
        delimiter=",",
        header="frequency_Hz,magnitude,phase_deg",
        comments="",
    )
    return frequency, values


def wrong_fit(response, held=None, most=0):
    """Stand for a fit of the mode, with a gain that is 10 % too large."""
    assert (held, response.unit) == (None, "um/V")
    return ModalFit(
        frequency=(ModalValue(100.0, 1.0),),
        damping=(ModalValue(0.02, 1e-3),),
        gain=(ModalValue(0.11, 1e-3),),
        share=(),
        static_gain=ModalValue(0.11, 1e-3),
        lag=None,
        delay=ModalValue(3e-4, 1e-6),
        fitted=1.1 * response.values,
        deviation=1e-3 * np.abs(response.values),
        excess=None,
        searched=response.frequency.size,
        held=held,
    )


def test_a_plant_from_a_response(tmp_path, monkeypatch):
    # The fit takes long, and has tests of its own.
    monkeypatch.setattr("piezojax.identification.response_model.modal_fit", wrong_fit)
    frequency, values = response_file(tmp_path)
    study = study_of(plant={"response": "bench.csv", "unit": "nm/V"})
    case = build(study, tmp_path / "study.toml")
    assert case.plant_about.error_bound is not None
    assert case.plant_about.rate_Hz == RATE
    assert float(case.loop.plant.parts[0].gain) == pytest.approx(0.11)
    assert any("hysteresis and creep are not in the model" in n for n in case.notes)
    # C(jw) P_measured(jw), with a PI in closed form and the hold of the converter.
    reports = stability_reports({"after": case.loop}, 5.0, 1e-3)
    ratio = case.response.response.values / case.response.fit.fitted
    loop = next(iter(reports.loops["after"].values()))
    angle = 2.0 * np.pi * frequency * 1e-3
    delay = np.exp(-1j * angle)
    controller = 0.1 + 1e-3 / (1.0 - delay)
    expected = controller * values * (1.0 - delay) / (1j * angle)
    low = frequency < 80.0  # the sampling folds what lies above
    np.testing.assert_allclose(
        (loop.response(angle) * ratio)[low], expected[low], rtol=0.03
    )
    found = margins_on_response(case, reports)
    assert set(found) == {"after"}
    assert found["after"].lines == 120
    peak = np.max(1.0 / np.abs(1.0 + loop.response(angle) * ratio))
    assert found["after"].sensitivity_peak == pytest.approx(peak)


def test_a_plant_from_a_response_is_assumed_to_lack_hysteresis(tmp_path, monkeypatch):
    monkeypatch.setattr("piezojax.identification.response_model.modal_fit", wrong_fit)
    response_file(tmp_path)
    table = {"response": "bench.csv", "unit": "nm/V"}
    fitted = build(study_of(plant=table), tmp_path / "study.toml")
    path = tmp_path / "model.json"
    pj.save(fitted.loop.plant, path, about=fitted.plant_about)
    loaded = build(study_of(plant={"file": path.name}), tmp_path / "study.toml")
    for case in (fitted, loaded):
        assert case.assumed_hysteresis == 0.15
        (note,) = _hysteresis_notes(case)
        assert "a loop whose width is 15 % of its height" in note
        assert "limits on margins are also checked at its largest gain" in note
        assert "steps are simulated without it" in note
        assert make_data(case).tuning.disturbance is not None
    off = study_of(plant=table, disturbance={"hysteresis": 0.0})
    case = build(off, tmp_path / "study.toml")
    assert case.assumed_hysteresis == 0.0
    (note,) = _hysteresis_notes(case)
    assert "the errors hold for a stage without hysteresis" in note
    assert make_data(case).tuning.disturbance is None


def test_other_plants_lack_hysteresis_only_if_the_study_says_so(case, tmp_path):
    assert case.assumed_hysteresis == 0.0
    assert _hysteresis_notes(case) == []
    plant = {"type": "Affine", "gain": 0.15}
    for width in (0.0, 0.2):
        study = study_of(plant=plant, disturbance={"hysteresis": width})
        found = build(study, tmp_path / "study.toml")
        assert found.assumed_hysteresis == width
        assert len(_hysteresis_notes(found)) == (width > 0.0)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (
            {"unit": "V/um"},
            "plant.response: its unit is 'V/um'; it must be a leng",
        ),
        ({"response": "none.csv"}, "plant.response: record .*none.csv: No such file"),
        (
            {"hold": True},
            "plant.hold is unknown; allowed are response, held, unit",
        ),
        ({"record": "a.csv"}, "plant has the keys response, record; it must have exac"),
    ],
)
def test_a_bad_response_is_one_line(tmp_path, table, message):
    response_file(tmp_path)
    plant = {"response": "bench.csv"} | table
    with pytest.raises(ValueError, match=message) as caught:
        build(study_of(plant=plant), tmp_path / "study.toml")
    assert "\n" not in str(caught.value)
