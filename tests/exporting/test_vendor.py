"""Files of vendors: read back without the package, compared, refused out of range."""

import configparser
import csv
import dataclasses
import json
import re
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vendor_devices import JENA, RANGE

import piezojax as pj
from piezojax.control import E727, NV200, PyRPL, Servo, Stabilizer
from piezojax.exporting import device_values

ABOUT = pj.About(
    study="a study",
    seed=3,
    judged=["tuned loop: sensitivity peak 1.5"],
    plants=["gain +- 10 %"],
)
SPAN = {"scale": 2.5, "lower": -20.0, "upper": 130.0}
PI = E727(
    *(0.0123456789, 2e-4, 1.5e-7),
    **SPAN,
    **{"notch_frequency_1": 811.4, "notch_rejection_1": 0.05, "notch_method": 1},
)
WIRES = {"sensor_gain": 0.1, "amplifier_gain": 15.0, "offset": 55.0}
QUARTIQ = Stabilizer(
    -0.4, 300.0, d=2e-6, limit_d=20.0, minimum=-3.0, maximum=6.0, **WIRES
)
DEVICES = {"nv200": JENA, "e727": PI, "stabilizer": QUARTIQ}
INI = """[Device Parameters]
sr = 50.0
kp = 0.000
ki = 70.000
pcf = 0.5634,0,0
acserno = 12345
desc = TRITOR 100%
[Meta Data]
export_timestamp = 2026-01-19_10:00:00
"""


def exported(system, folder, about=ABOUT, **options):
    """Export a device; return the paths by suffix."""
    files = pj.export(system, folder, to="vendor", about=about, **options)
    return {path.suffix: path for path in files}


def body(path):
    return [x for x in path.read_text().splitlines() if x and not x.startswith("#")]


# Read back


def test_an_nv200_file_holds_the_values_as_rounded(tmp_path):
    # The library nv200 reads its file with a configparser as it comes.
    parser = configparser.ConfigParser()
    parser.read(exported(JENA, tmp_path / "x")[".ini"], encoding="utf-8")
    found = dict(parser["Device Parameters"])
    assert found.pop("pcf") == "0.563,0.000,0.000"
    assert found == {
        **{"kp": "0.020", "ki": "70.000", "kd": "0.003", "sr": "0.0000008"},
        **{"setlpf": "700", "setlpon": "0", "poslpf": "1234.568", "poslpon": "1"},
        **{"notchf": "811", "notchb": "400", "notchon": "1"},
    }
    # PiSoWorks takes these for integers, and the loop was simulated with them.
    typed = JENA.typed()
    for key, text in found.items():
        assert float(text) == pytest.approx(float(getattr(typed, key)), rel=1e-12)
    assert parser.sections() == ["Device Parameters"]
    assert list(found).index("notchf") < list(found).index("notchb")


def spa(path):
    """Return values by number of parameter, from commands SPA as in the manual."""
    found = {}
    for line in body(path):
        item, number, value = re.fullmatch(
            r"SPA (\d) (0x\w{8}) ([\d.]+)", line
        ).groups()
        assert item == "1"
        found[int(number, 16)] = float(value)
    return found


def test_an_e727_file_holds_the_parameters_by_number(tmp_path):
    files = exported(PI, tmp_path / "x")
    found = spa(files[".txt"])
    assert found == {
        **{0x07000300: 0.0123456789, 0x07000301: 2e-4, 0x07000302: 1.5e-7},
        **{0x08000100: 811.4, 0x08000200: 0.05, 0x08000300: 1.0, 0x08000600: 1.0},
        **{0x08000101: 1000.0, 0x08000201: 1.0, 0x08000301: 1.0, 0x05000000: 0.0},
    }
    rows = list(csv.DictReader(body(files[".csv"])))
    table = {row["parameter"]: row for row in rows}
    assert table["1 0x07000301"]["value"] == "0.0002"
    assert (table["1 0x07000301"]["unit"], table["1 0x08000100"]["unit"]) == ("s", "Hz")
    assert {int(key.split()[1], 16) for key in table} == set(found)


def test_what_an_e727_file_leaves_out(tmp_path):
    device = E727(0.1, 1e-3, **SPAN, filter_type=1, filter_frequency=900.0)
    text = exported(device, tmp_path / "a")[".txt"].read_text()
    assert "SPA 1 0x05000001 900\n" in text
    assert "SPA 1 0x07000302 0\n" in text
    assert "The manual asks for D > 0" in text
    assert "SPA 1 0x07000200" not in text
    slow = E727(0.1, 1e-3, **SPAN, slew_rate=2000.0)
    text = exported(slow, tmp_path / "b")[".txt"].read_text()
    assert "SPA 1 0x07000200 2000\n" in text
    assert "SPA 1 0x05000001" not in text
    assert "The unit of the slew rate is not in the manual" in text
    assert "Structure of the PID: ASSUMED, P multiplies all terms" in text
    stated = dataclasses.replace(slow, structure="parallel")
    text = exported(stated, tmp_path / "c")[".txt"].read_text()
    assert "Structure of the PID: parallel, as in the study." in text


@pytest.mark.parametrize(
    ("rejection", "accepted"),
    [(0.5, 0.5), (0.98, 0.98), (0.985, 0.98), (0.995, 1.0), (1.0, 1.0)],
)
def test_a_rejection_that_the_device_refuses_is_rounded(rejection, accepted, tmp_path):
    device = changed(PI, notch_rejection_1=rejection, notch_rejection_2=rejection)
    found = spa(exported(device, tmp_path / "x")[".txt"])
    assert (found[0x08000200], found[0x08000201]) == (accepted, accepted)
    # The loop is simulated with the value of the file.
    as_written = changed(PI, notch_rejection_1=accepted, notch_rejection_2=accepted)
    for mine, own in zip(
        jax.tree.leaves(device.resolved()),
        jax.tree.leaves(as_written.resolved()),
        strict=True,
    ):
        assert mine == own
    slope = jax.grad(
        lambda r: changed(PI, notch_rejection_1=r).typed().notch_rejection_1
    )
    assert slope(rejection) == 1.0


def settings(path):
    return dict(line.split("=", 1) for line in body(path))


def test_a_stabilizer_file_has_the_signs_of_textbooks(tmp_path):
    found = settings(exported(QUARTIQ, tmp_path / "x")[".conf"])
    assert json.loads(found["/ch/0/biquad/0/typ"]) == "Ba"
    (b0, b1, b2), (a0, a1, a2) = json.loads(found["/ch/0/biquad/0/repr/Ba/ba"])
    ends = [float(found[f"/ch/0/biquad/0/repr/Ba/{end}"]) for end in ("min", "max")]
    assert (a0, ends) == (1.0, [-3.0, 6.0])
    measured = 12.0 + np.cumsum(np.random.default_rng(1).normal(size=300) * 0.05)

    def step(state, now):
        return QUARTIQ.step(state, pj.Observation(12.0, 12.0, now, 55.0))

    state = QUARTIQ.init(pj.Observation(12.0, 12.0, 12.0, 55.0))
    voltage = jax.lax.scan(step, state, jnp.asarray(measured))[1]
    # y = b.x - a.y in V; x is the reading, u the share of the set point.
    u, (x1, x2), (y1, y2), outputs = -(b0 + b1 + b2) * 1.2, (1.2, 1.2), (0.0, 0.0), []
    for x in 0.1 * measured:
        y = np.clip(b0 * x + b1 * x1 + b2 * x2 - a1 * y1 - a2 * y2 + u, *ends)
        (x1, x2), (y1, y2) = (x, x1), (y, y1)
        outputs.append(y)
    np.testing.assert_allclose(55.0 + 15.0 * np.array(outputs), voltage, atol=2e-3)
    assert np.ptp(outputs) > 0.1


@pytest.mark.parametrize("name", DEVICES)
def test_the_same_device_gives_the_same_text(name, tmp_path):
    one, two = (exported(DEVICES[name], tmp_path / folder) for folder in "ab")
    assert [path.read_text() for path in one.values()] == [
        path.read_text() for path in two.values()
    ]


# Origin


@pytest.mark.parametrize("name", DEVICES)
def test_every_file_names_its_origin(name, tmp_path):
    for path in exported(DEVICES[name], tmp_path / "x").values():
        lines = path.read_text().splitlines()
        version = f"exported by piezojax {pj.__version__}."
        assert lines[0] == f"# Parameters of {type(DEVICES[name]).__name__}, {version}"
        assert {
            "# Study: a study, seed 3.",
            "# Judged: tuned loop: sensitivity peak 1.5.",
            "# Plants: gain +- 10 %.",
        } < set(lines)


@pytest.mark.parametrize("name", DEVICES)
def test_unsafe_gains_are_refused_or_say_so_first(name, tmp_path):
    about = ABOUT.model_copy(update={"unsafe": ["it rings"]})
    with pytest.raises(
        ValueError, match="an alarm: it rings; to export it all the same"
    ):
        exported(DEVICES[name], tmp_path / "x", about)
    with pytest.raises(ValueError, match="no study has judged the stability"):
        exported(DEVICES[name], tmp_path / "x", pj.About())
    assert not (tmp_path / "x").exists()
    for path in exported(
        DEVICES[name], tmp_path / "x", about, accept_unsafe=True
    ).values():
        assert path.read_text().startswith("# UNSAFE: it rings\n")


def test_a_scale_that_is_not_measured_is_named(tmp_path):
    assumed = exported(NV200(ki=70.0, **RANGE), tmp_path / "a")[".ini"].read_text()
    assert "Scale of the gains: ASSUMED" in assumed
    assert "PiSoWorks may load 0 as on: check setlpon, poslpon, notchon." in assumed
    entered = exported(JENA, tmp_path / "b")[".ini"].read_text()
    assert "Scale of the gains: 0.9 V/um for 1, as entered in the study." in entered
    assert "PiSoWorks cuts pcf to whole numbers" in entered


# A saved file


def test_keys_of_the_saved_file_are_kept(tmp_path):
    saved = tmp_path / "actuator.ini"
    saved.write_text(INI)
    files = exported(JENA, tmp_path / "x", before=saved)
    assert files[".backup"].name == "actuator.ini.backup"
    assert files[".backup"].read_bytes() == saved.read_bytes()
    parser = configparser.ConfigParser(interpolation=None)
    parser.read(files[".ini"], encoding="utf-8")
    found = parser["Device Parameters"]
    assert (found["acserno"], found["desc"]) == ("12345", "TRITOR 100%")
    assert (found["kp"], found["sr"]) == ("0.020", "0.0000008")
    assert parser["Meta Data"]["export_timestamp"] == "2026-01-19_10:00:00"
    assert "Kept from the saved file: acserno, desc." in files[".ini"].read_text()
    rows = {row.parameter: row for row in device_values(JENA, saved)}
    assert (rows["kp"].saved, rows["kp"].value) == ("0.000", "0.020")
    assert rows["notchf"].saved == ""
    # The written file is a saved file too.
    again = exported(JENA, tmp_path / "y", before=files[".ini"])
    assert body(again[".ini"]) == body(files[".ini"])
    assert all(row.saved == row.value for row in device_values(JENA, files[".ini"]))


def test_a_saved_closed_loop_is_pointed_out(tmp_path):
    saved = tmp_path / "actuator.ini"
    saved.write_text(INI.replace("sr =", "cl = 1\nsr ="))
    text = exported(JENA, tmp_path / "x", before=saved)[".ini"].read_text()
    assert "The kept cl is not 0: it may close the loop." in text
    assert "\ncl = 1\n" in text


@pytest.mark.parametrize("name", ["e727", "stabilizer"])
def test_an_exported_file_is_a_saved_file(name, tmp_path):
    device, suffix = DEVICES[name], {"e727": ".txt", "stabilizer": ".conf"}[name]
    path = exported(device, tmp_path / "x")[suffix]
    assert all(row.saved == row.value for row in device_values(device, path))


def test_answers_of_an_e727_are_read(tmp_path):
    saved = tmp_path / "answers.txt"
    saved.write_text("1 0x07000300=0.0200 \n1 0x07000301=3e-4\nSPA 1 134217984 900\n")
    rows = {row.parameter: row.saved for row in device_values(PI, saved)}
    assert rows["1 0x07000300"] == "0.0200"
    assert rows["1 0x07000301"] == "3e-4"
    assert rows["1 0x08000100"] == "900"  # PIPython sends decimal numbers
    assert rows["1 0x07000302"] == ""


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("nv200", "[Other]\nkp = 1\n", r"it has no \[Device Parameters\]"),
        ("nv200", "kp = 1\n", r"saved.txt: .*no section headers"),
        ("e727", "MOV 1 5.0\n", "no parameters of an E-727"),
        ("stabilizer", "p = 1\n", "no settings of a Stabilizer"),
        ("nv200", b"[Device Parameters]\ndesc = \xff\n", "saved.txt: .*utf-8"),
    ],
)
def test_a_saved_file_of_another_kind_is_refused(name, text, message, tmp_path):
    saved = tmp_path / "saved.txt"
    saved.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ValueError, match=message):
        exported(DEVICES[name], tmp_path / "x", before=saved)
    assert not (tmp_path / "x").exists()


# Refused


def changed(device, **values):
    """Return a device with values that its constructor would refuse."""
    for name, value in values.items():
        device = eqx.tree_at(
            lambda d, n=name: getattr(d, n), device, jnp.asarray(value)
        )
    return device


@pytest.mark.parametrize(
    ("device", "message"),
    [
        (
            changed(JENA, ki=2e4),
            "ki in 1/s is 20000; it must be finite and at least 0 and at most 10000",
        ),
        (changed(JENA, pcf_x=1.2), "pcf_x is 1.2; .* at least 0 and at most 1$"),
        (
            changed(JENA, pcf_v=-1.0),
            "pcf_v in s is -1; .* at least 0 and at most 10000",
        ),
        (
            changed(JENA, notchf=2e4),
            "notchf in Hz is 20000; .* at least 1 and at most 9999",
        ),
        (changed(JENA, notchb=1700.0), "notchb is 1700 and 2 notchf is 1622.8"),
        (
            changed(PI, notch_rejection_1=1.01),
            r"notch_rejection_1 is 1.01; it must be .* at least 0 and at most 1",
        ),
        (
            changed(PI, notch_frequency_2=9.5e3),
            r"notch_frequency_2 .*is 9500; it must be .* above 0 and at most 9000",
        ),
        (
            changed(QUARTIQ, maximum=12.0),
            r"maximum .*in V is 12; .* at least -10.24 and at most 10.24",
        ),
    ],
)
def test_a_value_out_of_range_is_refused_with_the_range(device, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        exported(device, tmp_path / "x")
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    "system",
    [
        PyRPL(0.1, 20.0, sensor_gain=0.1, amplifier_gain=15.0, dt=5e-5),
        Servo(0.3, 500.0, lower=0.0, upper=100.0, dt=5e-5),
        pj.control.PID(0.5, 3000.0, dt=5e-5),
        pj.dynamics.ARMA((0.9,), (0.1,)),
    ],
)
def test_a_system_without_a_file_is_refused(system, tmp_path):
    with pytest.raises(
        ValueError, match="no file of a vendor; E727, NV200, Stabilizer have one"
    ):
        exported(system, tmp_path / "x")


def test_a_folder_in_use_and_a_saved_file_of_c_are_refused(tmp_path):
    exported(JENA, tmp_path / "x")
    with pytest.raises(ValueError, match="already holds results; name a new folder"):
        exported(JENA, tmp_path / "x")
    with pytest.raises(ValueError, match="it needs to='vendor'"):
        pj.export(JENA, tmp_path / "y", before=Path("a.ini"), about=ABOUT)
