"""Linear models for python-control, MATLAB and Octave."""

import re

import control
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.io import loadmat

import piezojax as pj
from piezojax.core.serial import to_data
from piezojax.exporting import from_control, to_control

DT = 5e-5
ABOUT = pj.About(
    rate_Hz=1.0 / DT,
    study="a study",
    judged=["fine"],
    actuator=to_data(pj.Saturation(0.0, 100.0)),
    reference_ranges=[(0.0, 10.0)],
)
LAG = pj.dynamics.ARMA((1.5, -0.6), (0.03, 0.04, 0.01))
PID = pj.control.PID(0.5, 3000.0, derivative=1e-4, derivative_filter=2e-4, dt=DT)


def test_a_plant_has_the_response_of_python_control(tmp_path):
    (path,) = pj.export(LAG, tmp_path / "x", to="mat", about=ABOUT)
    found = loadmat(path, simplify_cells=True)
    assert found["Ts"] == DT
    numerator, denominator = [0.03, 0.04, 0.01], [1.0, -1.5, 0.6]
    wanted = control.tf(numerator, denominator, DT)(
        np.exp(2j * np.pi * found["frequency_Hz"] * DT)
    )
    np.testing.assert_allclose(
        np.squeeze(found["response"]), wanted, rtol=1e-9, atol=1e-15
    )
    matrices = loadmat(path)
    model = control.ss(*(matrices[key] for key in "ABCD"), DT)
    np.testing.assert_allclose(
        model(np.exp(1j)), control.tf(numerator, denominator, DT)(np.exp(1j)), rtol=1e-9
    )


def test_a_controller_has_the_names_and_gains_of_its_signals(tmp_path):
    (path,) = pj.export(PID, tmp_path / "x", to="mat", about=ABOUT)
    found = loadmat(path, simplify_cells=True)
    assert list(found["inputs"]) == ["reference", "next_reference", "measured"]
    response = found["response"]
    reference, following, measured = response
    np.testing.assert_allclose(reference, -measured, rtol=1e-9)
    np.testing.assert_allclose(following, 0.0, atol=1e-12)
    # The PID of the sampled signals: forward Euler for I, a filtered difference for D.
    z = np.exp(2j * np.pi * found["frequency_Hz"] * DT)
    share = DT / (DT + 2e-4)
    derivative = 1e-4 * share * (1 - 1 / z) / DT / (1 - (1 - share) / z)
    wanted = 0.5 + 3000.0 * DT / (1 - 1 / z) + derivative
    np.testing.assert_allclose(reference, wanted, rtol=1e-9)


def test_the_function_of_octave_holds_the_same_numbers(tmp_path):
    (path,) = pj.export(LAG, tmp_path / "x", to="octave", about=ABOUT, name="lag")
    text = path.read_text()
    assert text.startswith("function sys = lag()\n")
    assert "% Study: a study." in text
    matrices = {}
    for key, rows in re.findall(r"^([ABCD]) = \[(.*)\];$", text, re.MULTILINE):
        matrices[key] = np.array([row.split() for row in rows.split(";")], float)
    model = control.ss(*(matrices[key] for key in "ABCD"), DT)
    z = np.exp(0.3j)
    wanted = (0.03 + 0.04 / z + 0.01 / z**2) / (1 - 1.5 / z + 0.6 / z**2)
    np.testing.assert_allclose(model(z), wanted, rtol=1e-12)
    assert f"sys = ss(A, B, C, D, {DT!r});" in text
    assert "sys.InputName = {'input'};" in text


def test_unsafe_gains_say_so_first(tmp_path):
    about = ABOUT.model_copy(
        update={"unsafe": ["it rings"], "plants": ["gain +- 10 %"]}
    )
    options = {"about": about, "accept_unsafe": True}
    (path,) = pj.export(PID, tmp_path / "m", to="octave", **options)
    assert path.read_text().startswith("% UNSAFE: it rings\nfunction sys = ")
    (path,) = pj.export(PID, tmp_path / "x", to="mat", **options)
    origin = loadmat(path, simplify_cells=True)["origin"].splitlines()
    assert origin[0] == "UNSAFE: it rings"
    assert {"Study: a study.", "Judged: fine.", "Plants: gain +- 10 %."} < set(origin)


def test_models_go_to_python_control_and_back():
    model = pj.dynamics.linearise(LAG, 0.0, dt=DT)
    there = to_control(model)
    assert there.dt == DT
    back = from_control(there)
    for key in "ABCD":
        np.testing.assert_array_equal(getattr(back, key), getattr(model, key))
    transfer = control.tf([0.2, 0.1], [1.0, -0.5], DT)
    step = pj.simulate(from_control(transfer), jnp.ones((50, 1)))[1][:, 0]
    wanted = control.forced_response(transfer, inputs=np.ones(50)).outputs
    np.testing.assert_allclose(step, wanted, rtol=1e-12)


def test_a_system_in_continuous_time_is_refused():
    with pytest.raises(ValueError, match=r"sampling time is 0; a discrete-time system"):
        from_control(control.tf([1.0], [1.0, 1.0]))


def test_a_system_without_a_rate_is_refused(tmp_path):
    with pytest.raises(ValueError, match="the sample time is not known"):
        pj.export(LAG, tmp_path / "x", to="mat")
    assert not (tmp_path / "x").exists()
