"""The scale of the gains of a device, from a text record of its own loop."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from oracles import vendor_loops

from piezojax import Record
from piezojax.cli.identify import main
from piezojax.identification.device_scale import device_scale

DT, SAMPLES = 5e-5, 6144
NV = {"kp": 0.06, "ki": 70.0, "kd": 2e-6}
SCALE = 1.7


def recorded(loop, digits, lag=0, noise=0.0):
    """Return error and voltage as text of three decimals, in a loop of 500 Hz."""
    random = np.random.default_rng(0)
    w = 2.0 * np.pi * 500.0 * DT
    keep, y, u = np.exp(-w), 40.0, 60.0
    rows = []
    for k in range(SAMPLES):
        r = 40.0 + (2.0 if (k // 512) % 2 else 0.0)
        seen = y + noise * random.standard_normal()
        u = loop.step(r, seen)
        rows.append((r - seen, u))
        y = keep * y + (1.0 - keep) * u / 1.5
    error, voltage = np.round(np.array(rows), digits).T
    return Record(error[: SAMPLES - lag], voltage_lagged(voltage, lag), DT, "um", "V")


def voltage_lagged(voltage, lag):
    return np.r_[np.full(lag, voltage[0]), voltage][: SAMPLES - lag]


def nv200(integration="rectangular", scale=SCALE, **typed):
    gains = NV | typed
    return vendor_loops.NV200(
        40.0, 40.0, 60.0, scale=scale, integration=integration, **gains
    )


@pytest.mark.parametrize("integration", ["rectangular", "trapezoidal", "half"])
@pytest.mark.parametrize("lag", [0, 2])
def test_the_scale_of_an_nv200_from_three_decimals(integration, lag):
    typed, scale = {"kp": 6.0, "ki": 7000.0, "kd": 0.001}, 0.017
    record = recorded(nv200(integration, scale, **typed), 3, lag)
    found = device_scale("nv200", record, typed)
    assert found.option == {"integration": integration}
    assert found.lag == lag
    half = 0.5 if integration == "half" else 1.0
    assert found.scale.value == pytest.approx(scale, rel=1e-4)
    assert found.integral.value == pytest.approx(half * scale * 7000.0, rel=1e-4)
    assert found.proportional.value == pytest.approx(scale * 6.0, rel=0.01)
    assert found.derivative.value == pytest.approx(scale * 0.001, rel=0.01)
    assert found.notes == []


def test_gains_without_a_scale_are_within_their_tolerances():
    """kp and kd are within 1 %, ki within 1e-4, even with wrong given gains."""
    record = recorded(nv200(kp=0.06, kd=1e-5), 3)
    found = device_scale("nv200", record, {"kp": 0.06, "ki": 70.0, "kd": 0.0})
    assert found.integral.value == pytest.approx(SCALE * 70.0, rel=1e-4)
    assert found.proportional.value == pytest.approx(SCALE * 0.06, rel=0.01)
    assert found.derivative.value == pytest.approx(SCALE * 1e-5, rel=0.01)


def test_an_integral_alone_does_not_determine_the_integration_rule():
    record = recorded(nv200(kp=0.0, kd=0.0), 3)
    found = device_scale("nv200", record, {"kp": 0.0, "ki": 70.0, "kd": 0.0})
    assert found.option == {"integration": "rectangular"}
    (note,) = found.notes
    assert note.startswith("integration may also be half: to distinguish them, rec")


@pytest.mark.parametrize("structure", ["series", "parallel"])
def test_the_structure_of_an_e727_is_found(structure):
    typed = {"proportional": 0.1, "integral_time": 2e-3, "derivative_time": 1e-5}
    if structure == "parallel":
        typed |= {"integral_time": 2e-2, "derivative_time": 1e-6}
    given = dict(zip("PID", typed.values(), strict=True))
    loop = vendor_loops.E727(40.0, 40.0, 60.0, scale=2.2, structure=structure, **given)
    found = device_scale("e727", recorded(loop, 3), typed)
    assert found.option == {"structure": structure}
    assert found.scale.value == pytest.approx(2.2, rel=1e-3)


def test_noise_widens_the_standard_errors():
    typed = {"kp": 0.06, "ki": 70.0, "kd": 0.0}
    quiet, loud = (
        device_scale("nv200", recorded(nv200(kd=0.0), digits), typed).scale
        for digits in (4, 2)
    )
    assert loud.standard_error > 5.0 * quiet.standard_error
    assert abs(loud.value - SCALE) < 6.0 * loud.standard_error


def test_the_command_prints_and_writes_the_scale(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    record = recorded(nv200(kd=0.0), 3)
    table = np.column_stack([record.inputs, record.outputs])
    np.savetxt("loop.csv", table, "%.3f", ",", header="error_um,voltage_V", comments="")
    line = "loop.csv --rate 20000 --controller nv200 --gain kp=0.06 --gain ki=70"
    done = CliRunner().invoke(main, [*line.split(), "--out", "found"])
    assert done.exit_code == 0, done.output
    assert "nv200, integration rectangular" in done.output
    assert "results in found" in done.output
    written = json.loads((tmp_path / "found" / "scale.json").read_text())
    assert written["scale"]["value"] == pytest.approx(SCALE, rel=1e-4)
    wrong = CliRunner().invoke(main, [*line.split()[:-1], "ki:70"])
    assert wrong.exit_code != 0
    assert "'ki:70' must be a name and a number, as in ki=70" in wrong.output


RECORD = recorded(nv200(), 3)


@pytest.mark.parametrize(
    ("device", "record", "typed", "message"),
    [
        ("nv400", RECORD, NV, "device is 'nv400'; it must be one of nv200, e727"),
        ("nv200", RECORD, {"P": 1.0}, "gains P: nv200 has the gains kp, ki, kd"),
        ("nv200", RECORD, {"kp": 0.0}, "all gains are 0: record with at least one"),
        ("nv200", RECORD, {"ki": 300.0, "kp": 0.06}, "the gains ki 300, kp 0.06 leave"),
        ("e727", RECORD, {"integral_time": 0.01}, "give proportional: every gain of"),
        (
            "nv200",
            Record(-RECORD.inputs, RECORD.outputs, DT, "um", "V"),
            NV,
            "the error must be the setpoint less the position",
        ),
        (
            "nv200",
            Record(RECORD.inputs, RECORD.outputs, 1e-4, "um", "V"),
            NV,
            "rate of 10000 Hz, nv200 runs at 20000 Hz: record every sample",
        ),
        (
            "nv200",
            Record(RECORD.inputs, RECORD.outputs, DT, "V", "V"),
            NV,
            "the error of .* in V; it must be one in um",
        ),
        (
            "nv200",
            Record(RECORD.inputs, RECORD.inputs[::-1], DT, "um", "V"),
            NV,
            "leaves .* V rms: switch notch, low-passes and feedforward off",
        ),
    ],
)
def test_unsuitable_records_are_refused(device, record, typed, message):
    with pytest.raises(ValueError, match=message):
        device_scale(device, record, typed)
