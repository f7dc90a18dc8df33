"""Feedbacks as chains of biquads, with the difference equation of each by hand."""

import csv

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import sos2zpk

import piezojax as pj
from piezojax.catalog import CONTROLLERS
from piezojax.control import NV200, PID
from piezojax.core.serial import to_data
from piezojax.exporting.biquads import sections_of

DT = 5e-5
ABOUT = pj.About(
    rate_Hz=1.0 / DT,
    study="a study",
    judged=["fine"],
    plants=["gain +- 10 %"],
    actuator=to_data(pj.Saturation(-20.0, 130.0)),
    reference_ranges=[(0.0, 10.0)],
)
NOTCHED = NV200(
    *(0.02, 70.0, 1e-4),
    **{"avmin": -20.0, "avmax": 130.0, "posmin": 0.0, "posmax": 80.0, "scale": 0.9},
    **{"poslpon": 1, "notchon": 1, "notchf": 811.0, "notchb": 400.0},
)
FEEDBACKS = {
    "pid": PID(0.5, 3000.0, derivative=1e-4, derivative_filter=2e-4, dt=DT),
    "nv200": NOTCHED,
    "damping": CONTROLLERS["p753_pid"](),
}


def rows_of(path):
    lines = path.read_text().splitlines()
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    return [{key: float(value) for key, value in row.items()} for row in rows]


def chained(rows, signal):
    """Pass a signal through the sections, as the head of the file says."""
    for row in rows:
        x1 = x2 = y1 = y2 = 0.0
        outputs = []
        for x in signal:
            y = row["b0"] * x + row["b1"] * x1 + row["b2"] * x2
            y = y - row["a1"] * y1 - row["a2"] * y2
            x1, x2, y1, y2 = x, x1, y, y1
            outputs.append(y)
        signal = outputs
    return np.array(signal)


@pytest.mark.parametrize("name", FEEDBACKS)
def test_the_chain_equals_the_controller(name, tmp_path):
    controller = FEEDBACKS[name]
    (path,) = pj.export(controller, tmp_path / "x", to="biquads", about=ABOUT)
    error = 0.02 * np.random.default_rng(5).normal(size=300)

    def step(carry, e):
        state, applied = carry
        seen = pj.Observation(5.0, 5.0, 5.0 - e, applied)
        state, voltage = controller.step(state, seen)
        return (state, voltage), voltage

    rest = pj.Observation(5.0, 5.0, 5.0, jnp.asarray(55.0))
    start = controller.init(rest), jnp.asarray(55.0)
    voltage = np.asarray(jax.lax.scan(step, start, jnp.asarray(error))[1])
    found = 55.0 + chained(rows_of(path), error)
    np.testing.assert_allclose(found, voltage, atol=1e-8 * np.ptp(voltage))
    assert np.ptp(voltage) > 1e-3


def test_the_sections_of_a_notched_loop_are_minimal(tmp_path):
    (path,) = pj.export(NOTCHED, tmp_path / "x", to="biquads", about=ABOUT)
    # integral, derivative, low-pass of the position, and two poles of the notch
    sections = np.array([[*row.values()] for row in rows_of(path)])
    poles = sos2zpk(sections)[1]
    assert np.sum(np.abs(poles) > 1e-9) == 4
    np.testing.assert_allclose(max(poles.real), 1.0, atol=1e-12)
    assert np.all(sections[:, 3] == 1.0)


def test_samples_of_delay_are_kept():
    A = np.array([[0.9, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    b, c = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 2.0])
    sections = sections_of(A, b, c, 0.0)
    names = ("b0", "b1", "b2", "a0", "a1", "a2")
    rows = [dict(zip(names, section, strict=True)) for section in sections]
    impulse = chained(rows, [1.0, *np.zeros(6)])
    np.testing.assert_allclose(
        impulse, [0.0, 0.0, 0.0, *(2.0 * 0.9 ** np.arange(4))], atol=1e-15
    )


def test_the_head_spells_out_signs_rate_and_origin(tmp_path):
    about = ABOUT.model_copy(update={"unsafe": ["it rings"]})
    options = {"to": "biquads", "about": about}
    with pytest.raises(ValueError, match="an alarm: it rings"):
        pj.export(FEEDBACKS["pid"], tmp_path / "x", **options)
    texts = [
        pj.export(FEEDBACKS["pid"], tmp_path / folder, **options, accept_unsafe=True)[
            0
        ].read_text()
        for folder in "ab"
    ]
    assert texts[0] == texts[1]
    lines = texts[0].splitlines()
    assert lines[0] == "# UNSAFE: it rings"
    assert lines[1].startswith("# Feedback of PID as ")
    assert {
        "# Study: a study.",
        "# Sampling rate: 20000 Hz only.",
        "# Judged: fine.",
        "# Plants: gain +- 10 %.",
    } < set(lines)
    assert any("- a1 y1 - a2 y2 with a0 = 1" in line for line in lines)


@pytest.mark.parametrize(
    ("system", "axes", "message"),
    [
        (CONTROLLERS["p753_iterative_learning"](), 1, "learns or counts samples"),
        (CONTROLLERS["p753_repetitive"](), 1, "learns or counts samples"),
        (CONTROLLERS["p753_bang_bang"](), 1, "is not linear; biquads do not"),
        (CONTROLLERS["p558_pid"](), 3, "a controller of one axis"),
        (pj.dynamics.ARMA((0.9,), (0.1,)), 1, "a controller of one axis"),
    ],
)
def test_other_systems_are_refused(system, axes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        pj.export(
            *(system, tmp_path / "x"),
            to="biquads",
            about=ABOUT.model_copy(update={"reference_ranges": []}),
            limits=[(-20.0, 130.0)] * axes,
        )
    assert not (tmp_path / "x").exists()
