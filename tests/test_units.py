"""Units and sampling rates are saved in the files, and studies check them."""

import json
import tomllib

import numpy as np
import pytest
import tomli_w

import piezojax as pj
from piezojax.core.conversion import factor, replaced
from piezojax.core.serial import read_about
from piezojax.identification import Record, identify
from piezojax.study import Study, build

DT = 1e-3
RANDOM = np.random.default_rng(2)


def moved(drive):
    """Return the displacement (um) of a lag of 3 ms behind a gain, 0.2 um/V."""
    pole, y, found = np.exp(-1.0 / 3.0), 0.0, []
    for u in drive:
        found.append(y)
        y = pole * y + (1.0 - pole) * 0.2 * u
    return np.array(found)


DRIVE = np.repeat(RANDOM.uniform(0.0, 90.0, 60), 10)
STUDY = {
    "title": "an integral controller on a fitted lag",
    "rate": 1.0 / DT,
    "actuator": {"lower": -20.0, "upper": 120.0},
    "controller": {"type": "PID", "proportional": 0.0, "integral": 20.0, "dt": DT},
    "references": {"tune": ["SIN5"], "duration": 0.4, "settle": 0.1},
    "parameters": {"controller.integral": {"lower": 10.0, "upper": 90.0}},
    "optimiser": {"method": "bfgs", "starts": 1, "candidates": 1, "steps": 1},
}


def record_in(volts, lengths, folder):
    """Write the record with the columns in these units, and return its name."""
    scale = {"V": 1.0, "mV": 1e3, "um": 1.0, "nm": 1e3, "counts": 7.0}
    columns = [DRIVE * scale[volts], moved(DRIVE) * scale[lengths]]
    rows = np.column_stack([DT * np.arange(DRIVE.size), *columns])
    header = f"time_s,drive_{volts},position_{lengths}"
    name = f"{volts}_{lengths}.csv"
    np.savetxt(folder / name, rows, delimiter=",", header=header, comments="")
    return name


def case_of(folder, plant, **changes):
    study = Study.model_validate(STUDY | {"plant": plant} | changes)
    return build(study, folder / "stage.toml")


def plant_of(name, model="arma"):
    return {"record": name, "model": model, "time": 0, "input": 1, "output": 2}


def gain_of(plant):
    return float(pj.core.system.rest_output(plant, 10.0)) / 10.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("units")


def test_a_record_in_other_units_is_converted(folder):
    plain = case_of(folder, plant_of(record_in("V", "um", folder)))
    other = case_of(folder, plant_of(record_in("mV", "nm", folder)))
    assert 0.1 < gain_of(plain.loop.plant) < 0.3
    found, expected = gain_of(other.loop.plant), gain_of(plain.loop.plant)
    assert found == pytest.approx(expected, rel=1e-6)
    assert other.fit.report.train.unit == "um"
    assert other.plant_about.units == {"input": "V", "output": "um"}


def test_a_unit_that_cannot_be_converted_is_refused(folder):
    name = record_in("V", "counts", folder)
    with pytest.raises(ValueError, match=r"V_counts.csv is in counts, and um is"):
        case_of(folder, plant_of(name))


def test_a_record_at_another_rate_is_refused(folder):
    name = record_in("V", "um", folder)
    with pytest.raises(ValueError, match=r"rate is 2000 Hz, but plant.record was made"):
        case_of(
            folder,
            plant_of(name),
            rate=2000.0,
            controller=STUDY["controller"] | {"dt": 5e-4},
        )


def test_a_fitted_plant_is_checked_on_other_records(folder):
    first, other = (record_in(*units, folder) for units in (("V", "um"), ("mV", "nm")))
    case = case_of(folder, plant_of(first) | {"check": other})
    assert case.plant_about.checked == [other]
    assert case.plant_about.unsafe == []
    assert case_of(folder, plant_of(first)).plant_about.checked == []


def test_a_check_may_have_other_columns(folder):
    first = record_in("V", "um", folder)
    rows = np.loadtxt(folder / first, delimiter=",", skiprows=1)
    rows[:, 0] *= 1e3
    header = "Time (ms),Command (V),z (um)"
    np.savetxt(folder / "own.csv", rows, delimiter=",", header=header, comments="")
    named = {"time": "time_s", "input": "drive_V", "output": "position_um"}
    case = case_of(folder, plant_of(first) | named | {"check": "own.csv"})
    assert case.plant_about.checked == ["own.csv"]
    assert case.plant_about.unsafe == []
    assert (
        "plant.check: own.csv has other columns; taken: time 'Time (ms)', input "
        "'Command (V)', output 'z (um)'"
    ) in case.notes


def test_a_record_of_another_stage_is_an_alarm_of_the_model(folder):
    first, name = record_in("V", "um", folder), "other.csv"
    rows = np.loadtxt(folder / first, delimiter=",", skiprows=1)
    rows[:, 2] *= 0.5
    header = "time_s,drive_V,position_um"
    np.savetxt(folder / name, rows, delimiter=",", header=header, comments="")
    case = case_of(folder, plant_of(first) | {"check": [first, name]})
    assert case.plant_about.checked == [first, name]
    assert case.fit.report.alarms == []
    assert any(
        alarm.startswith("other.csv: the model does not hold")
        for alarm in case.plant_about.unsafe
    )


def test_a_check_at_another_rate_or_unit_is_refused(folder):
    first, name = record_in("V", "um", folder), "slower.csv"
    rows = np.loadtxt(folder / first, delimiter=",", skiprows=1)
    rows[:, 0] *= 2.0
    header = "time_s,drive_V,position_um"
    np.savetxt(folder / name, rows, delimiter=",", header=header, comments="")
    with pytest.raises(ValueError, match=r"plant.check was made for 500 Hz"):
        case_of(folder, plant_of(first) | {"check": name})
    counts = record_in("V", "counts", folder)
    with pytest.raises(ValueError, match=r"plant.check: the output of V_counts.csv"):
        case_of(folder, plant_of(first) | {"check": counts})


def fitted(volts="V", lengths="um"):
    scale = {"V": 1.0, "mV": 1e3, "um": 1.0, "nm": 1e3}
    record = Record(
        DRIVE * scale[volts],
        moved(DRIVE) * scale[lengths],
        DT,
        volts,
        lengths,
        source="bench.csv",
    )
    return identify(record, "coleman_hodgdon+lag")


@pytest.fixture(scope="module")
def models(folder):
    """Files of models in V and um, and in mV and nm."""
    found = {}
    for units in (("V", "um"), ("mV", "nm")):
        fit = fitted(*units)
        found[units] = f"model_{units[0]}.json"
        pj.save(fit.system, folder / found[units], fit.about)
    return found


def test_a_model_has_the_units_of_channels_and_parameters(models, folder):
    for (volts, lengths), name in models.items():
        plain = json.loads((folder / name).read_text(encoding="utf-8"))
        about = plain["about"]
        assert about["units"] == {"input": volts, "output": lengths}
        expected = {
            "hysteresis.a": f"{lengths}/{volts}^2",
            "hysteresis.b": f"{lengths}/{volts}",
            "hysteresis.c": f"1/{volts}",
            "lag.time_constant": "s",
        }
        assert expected.items() <= about["parameter_units"].items()
        assert set(about["parameter_units"]) == set(
            pj.core.paths.parameters(pj.load(folder / name, accept_unsafe=True))
        )
        assert (about["rate_Hz"], about["record"]) == (1000.0, "bench.csv")
        assert about["piezojax"] == pj.__version__


def test_a_model_in_other_units_or_at_another_rate_is_refused(models, folder):
    def plant(units):
        return {"file": models[units], "accept_unsafe": True}

    assert case_of(folder, plant(("V", "um"))).plant_about.rate_Hz == 1000.0
    with pytest.raises(ValueError, match=r"plant.file: its input is in mV.*needs V: "):
        case_of(folder, plant(("mV", "nm")))
    with pytest.raises(ValueError, match=r"500 Hz, but plant.file was made for"):
        case_of(
            folder,
            plant(("V", "um")),
            rate=500.0,
            controller=STUDY["controller"] | {"dt": 2e-3},
        )


def test_gains_have_units_and_a_study_checks_them(folder):
    lag = {"type": "FirstOrderLag", "time_constant": 3e-3, "dt": DT}
    outcome = pj.tune(case_of(folder, lag, seed=4))
    pj.save(outcome.controller, folder / "gains.toml", outcome.about)
    about = read_about(folder / "gains.toml")
    assert about.units == {"measured": "um", "command": "V"}
    assert about.parameter_units["proportional"] == "V/um"
    assert about.parameter_units["integral"] == "V/(um s)"
    assert about.parameter_units["anti_windup"] == "1/s"
    assert set(about.parameter_units) == set(
        pj.core.paths.parameters(outcome.controller)
    )
    assert (about.study, about.seed, about.rate_Hz) == ("stage", 4, 1000.0)

    def refused(name, value):
        plain = tomllib.loads((folder / "gains.toml").read_text(encoding="utf-8"))
        plain["about"][name] = value
        (folder / "other.toml").write_text(tomli_w.dumps(plain), encoding="utf-8")
        given = {"file": "other.toml", "accept_unsafe": True}
        with pytest.raises(ValueError, match=r"controller.file") as caught:
            case_of(folder, lag, controller=given)
        return str(caught.value)

    text = refused("units", {"measured": "nm", "command": "V"})
    assert "its measured is in nm, and the study needs um: tune it again" in text
    text = refused("rate_Hz", 2000.0)
    assert text == "rate is 1000 Hz, but controller.file was made for 2000 Hz"


@pytest.mark.parametrize(
    ("unit", "wanted", "expected"),
    [
        ("mV", "V", 1e-3),
        ("kV", "V", 1e3),
        ("nm", "um", 1e-3),
        ("mm", "um", 1e3),
        ("mrad", "urad", 1e3),
        ("um", "um", 1.0),
        ("um", "nm", 1e3),
        ("mV", "kV", 1e-6),
        ("nm", "V", None),
        ("counts", "um", None),
    ],
)
def test_factors(unit, wanted, expected):
    assert factor(unit, wanted) == expected


def test_units_are_replaced_as_whole_words():
    units = {"V": "mV", "um": "nm"}
    assert replaced("um/V^2", units) == "nm/mV^2"
    assert replaced("1/(um s)", units) == "1/(nm s)"
    assert replaced("kV", units) == "kV"
