"""Files of frequency responses: analysers, MATLAB, Touchstone, and our own."""

import control
import numpy as np
import pytest
import scipy.stats
from scipy.io import loadmat, savemat

from piezojax.identification.records.response import FrequencyResponse
from piezojax.identification.records.response_file import read_response, read_responses
from piezojax.identification.records.saved_response import save_response

LINES = np.geomspace(10.0, 4000.0, 40)
VALUES = 0.1 / (1.0 + 2j * np.pi * LINES * 2e-4)


def measured(**more):
    random = np.random.default_rng(3)
    total = (0.01 * np.abs(VALUES)) ** 2 * random.uniform(0.5, 2.0, LINES.size)
    return FrequencyResponse(
        LINES,
        VALUES,
        "nm/V",
        variance=total,
        noise=0.3 * total,
        freedom=8.0,
        realisations=5,
        amplitude=0.25,
        held=5e-5,
        **more,
    )


def test_a_response_is_read_back_as_it_was_written(tmp_path):
    save_response(measured(), tmp_path / "r.csv")
    found = read_response(tmp_path / "r.csv")
    for name in ("frequency", "values", "variance", "noise", "distortion"):
        ours, theirs = getattr(found, name), getattr(measured(), name)
        np.testing.assert_allclose(ours, theirs, rtol=1e-8)
    assert (found.unit, found.freedom, found.realisations) == ("nm/V", 8.0, 5)
    assert (found.amplitude, found.held, found.resolution) == (0.25, 5e-5, 0.0)
    with pytest.raises(ValueError, match=r"is in nm/V, and the unit given is um/V"):
        read_response(tmp_path / "r.csv", unit="um/V")
    text = (tmp_path / "r.csv").read_text().replace('"freedom": 8.0', '"freedom": -8')
    (tmp_path / "r.csv").write_text(text)
    with pytest.raises(ValueError, match="freedom: Input should be greater than 0"):
        read_response(tmp_path / "r.csv")
    with pytest.raises(ValueError, match=r"the name must end in \.csv or \.mat"):
        save_response(measured(), tmp_path / "r.txt")


def test_matlab_and_python_control_take_a_response(tmp_path):
    save_response(measured(), tmp_path / "r.mat")
    inside = loadmat(tmp_path / "r.mat")
    assert inside["ResponseData"].shape == (1, 1, LINES.size)
    frd = control.FRD(inside["ResponseData"], 2.0 * np.pi * inside["Frequency"][:, 0])
    exact = control.frequency_response(control.tf([0.1], [2e-4, 1.0]), frd.omega)
    np.testing.assert_allclose(frd.complex, exact.complex, rtol=1e-9)
    found = read_response(tmp_path / "r.mat", unit="nm/V")
    np.testing.assert_allclose(found.values, VALUES)
    np.testing.assert_allclose(found.variance, measured().variance)


def test_a_matlab_file_keeps_all_properties(tmp_path):
    given = measured(coherence=np.linspace(0.5, 1.0, LINES.size), resolution=2.0)
    save_response(given, tmp_path / "r.mat")
    found = read_response(tmp_path / "r.mat")
    for name in ("frequency", "values", "variance", "noise", "coherence"):
        np.testing.assert_allclose(getattr(found, name), getattr(given, name))
    for name in ("unit", "freedom", "realisations", "amplitude", "held", "resolution"):
        assert getattr(found, name) == getattr(given, name)
    plain = FrequencyResponse(LINES, VALUES)
    save_response(plain, tmp_path / "plain.mat")
    again = read_response(tmp_path / "plain.mat")
    assert (again.held, again.freedom, again.unit) == (None, np.inf, "um/V")
    content = loadmat(tmp_path / "r.mat", appendmat=False)
    content = {name: content[name] for name in content if name[0] != "_"}
    savemat(tmp_path / "r.mat", content | {"Properties": '{"freedom": -8}'})
    with pytest.raises(ValueError, match="freedom: Input should be greater than 0"):
        read_response(tmp_path / "r.mat")
    savemat(tmp_path / "r.mat", content | {"Properties": "of another program"})
    assert read_response(tmp_path / "r.mat").held is None


@pytest.mark.parametrize(
    ("name", "factor"),
    [
        ("frequency_MHz", 1e-6),
        ("frequency_mHz", 1e3),
        ("frequency_kHz", 1e-3),
        ("f_GHz", 1e-9),
        ("FreqMHz", 1e-6),
        ("f [Hz]", 1.0),
        ("Frequency", 1.0),
        ("omega", 2 * np.pi),
        ("omega_krad/s", 2e-3 * np.pi),
        ("frequency_rad_s", 2 * np.pi),
    ],
)
def test_a_frequency_may_have_a_prefix(tmp_path, name, factor):
    write_table(tmp_path / "r.csv", name, factor * LINES)
    found = read_response(tmp_path / "r.csv")
    np.testing.assert_allclose(found.frequency, LINES)


@pytest.mark.parametrize("unit", ["mhz", "THz", "dHz"])
def test_a_frequency_of_an_unknown_unit_is_refused(tmp_path, unit):
    write_table(tmp_path / "r.csv", f"frequency_{unit}", LINES)
    with pytest.raises(ValueError, match=f"is in {unit}, an unknown unit of a freq"):
        read_response(tmp_path / "r.csv")


@pytest.mark.parametrize("unit", ["rpm", "1/s"])
def test_a_stated_unit_that_is_no_frequency_is_refused(tmp_path, unit):
    write_table(tmp_path / "r.csv", f"frequency [{unit}]", LINES)
    with pytest.raises(ValueError, match=f"is in {unit}, an unknown unit of a freq"):
        read_response(tmp_path / "r.csv")


def write_table(path, name, frequency):
    """Write a response with its frequencies in the column ``name``."""
    table = np.column_stack([frequency, VALUES.real, VALUES.imag])
    np.savetxt(path, table, "%.12g", ",", header=f"{name},real,imag", comments="")


@pytest.mark.parametrize(
    ("unit", "factor"),
    [("Hz", 1.0), ("rad/s", 2 * np.pi), ("rad/TimeUnit", 2 * np.pi), ("kHz", 1e-3)],
)
def test_an_frd_of_matlab_states_its_unit(tmp_path, unit, factor):
    content = {"ResponseData": VALUES[None, None], "Frequency": factor * LINES}
    savemat(tmp_path / "r.mat", content)
    with pytest.raises(ValueError, match="add a variable FrequencyUnit, 'Hz' or"):
        read_response(tmp_path / "r.mat")
    savemat(tmp_path / "r.mat", content | {"FrequencyUnit": unit})
    found = read_response(tmp_path / "r.mat")
    np.testing.assert_allclose(found.frequency, LINES)
    np.testing.assert_allclose(found.values, VALUES)


FORMS = {
    "DB": lambda g: (20.0 * np.log10(np.abs(g)), np.degrees(np.angle(g))),
    "MA": lambda g: (np.abs(g), np.degrees(np.angle(g))),
    "RI": lambda g: (g.real, g.imag),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("ports", [1, 2])
def test_touchstone(tmp_path, form, ports):
    pair = np.column_stack(FORMS[form](VALUES))
    other = np.full_like(pair, 0.5)
    columns = [pair] if ports == 1 else [other, pair, other, other]
    rows = np.column_stack([LINES / 1e3, *columns])
    head = f"! gain and phase\n# kHz S {form} R 50\n"
    lines = [" ".join(f"{x:.12g}" for x in row) + " ! line" for row in rows]
    path = tmp_path / f"r.s{ports}p"
    path.write_text(head + "\n".join(lines) + "\n")
    found = read_response(path)
    np.testing.assert_allclose(found.frequency, LINES)
    np.testing.assert_allclose(found.values, VALUES)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "# Hz Z RI R 50\n1 2 3\n",
            "line 1: option Z is not read; the line must be",
        ),
        ("# Hz S RI R 50\n1 2\n", "line 2 must hold 3 numbers; it is '1 2'"),
        ("# Hz S RI R 50\n1 2 x\n", "line 2 must hold 3 numbers"),
        ("[Version] 2.0\n", "line 1: only version 1 is read"),
        ("! nothing\n", "there are no lines of numbers in it"),
    ],
)
def test_touchstone_that_is_refused(tmp_path, text, message):
    (tmp_path / "r.s1p").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_response(tmp_path / "r.s1p")


ANALYSERS = {
    "Frequency (Hz);Gain: Magnitude (dB);Gain: Phase (°)": ";",  # Bode 100
    "# Frequency (Hz), Magnitude (dB), Phase (deg)": ",",  # Moku
    "Frequency(Hz)\tAmplitude(dB)\tPhase(deg)": "\t",
}


@pytest.mark.parametrize("head", ANALYSERS)
def test_tables_of_analysers(tmp_path, head):
    rows = np.column_stack([LINES, *FORMS["DB"](VALUES)])
    lines = [ANALYSERS[head].join(f"{x:.12g}" for x in row) for row in rows]
    text = "\n".join([head, *lines]) + "\n"
    (tmp_path / "r.csv").write_text(text, encoding="utf-8")
    found = read_response(tmp_path / "r.csv")
    np.testing.assert_allclose(found.frequency, LINES)
    np.testing.assert_allclose(found.values, VALUES)


def test_several_responses_in_a_file_are_paired_by_number(tmp_path):
    three = [VALUES * k for k in (1.0, 2.0, 3.0)]
    sizes = [np.abs(one) for one in three]
    turns = [np.degrees(np.angle(one * 1j**k)) for k, one in enumerate(three)]
    table = np.column_stack([LINES, *sizes, *turns[::-1]])
    head = "f_Hz,gain_1,gain_2,gain_3,phase_3_deg,phase_2_deg,phase_1_deg"
    np.savetxt(tmp_path / "r.csv", table, "%.12g", ",", header=head, comments="")
    found = read_responses(tmp_path / "r.csv")
    for k, (one, true) in enumerate(zip(found, three, strict=True)):
        np.testing.assert_allclose(one.values, true * 1j**k)
        assert one.source.endswith(f"gain_{k + 1}")
    with pytest.raises(ValueError, match="there are 3 responses in it; keep one"):
        read_response(tmp_path / "r.csv")


def test_a_record_over_time_is_pointed_to_the_method(tmp_path):
    table = np.random.default_rng(0).standard_normal((60, 2))
    head = "drive_V,displacement_um"
    np.savetxt(tmp_path / "r.csv", table, "%g", ",", header=head, comments="")
    with pytest.raises(ValueError, match="or give the --method for a record over time"):
        read_response(tmp_path / "r.csv")


def test_the_band_is_that_of_student():
    found = measured()
    magnitude, phase = found.band(0.9)
    quantile = scipy.stats.t.ppf(0.95, 8)
    np.testing.assert_allclose(magnitude, quantile * np.sqrt(found.variance / 2.0))
    np.testing.assert_allclose(np.sin(phase), magnitude / np.abs(VALUES))
    wide = FrequencyResponse(LINES, VALUES, variance=np.abs(VALUES) ** 2)
    assert np.all(wide.band()[1] == np.pi)
    with pytest.raises(ValueError, match="the variance of the response is unknown"):
        FrequencyResponse(LINES, VALUES).band()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"variance": -np.ones(40)}, "the variance must be a number of at least 0"),
        ({"variance": np.ones(39)}, "the variance must be a number of at least 0 for"),
        ({"noise": np.full(40, np.nan)}, "the noise must be a number of at least 0"),
        ({"freedom": 0.0}, "has 0 degrees of freedom; it must have more than 0"),
    ],
)
def test_variances_that_are_refused(more, message):
    with pytest.raises(ValueError, match=message):
        FrequencyResponse(LINES, VALUES, **more)
