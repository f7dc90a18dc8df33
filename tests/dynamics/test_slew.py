"""The slew limit of an amplifier: its mean over a sample, and its search."""

import numpy as np
import pytest
import scipy.signal
from oracles import excitation, forty_stages
from oracles import hysteresis as oracle

from piezojax import Record, simulate
from piezojax.control.design_model import design_model
from piezojax.core.system import Affine, series
from piezojax.dynamics import AmplifierSlew, FirstOrderLag
from piezojax.hysteresis import PrandtlIshlinskii
from piezojax.identification.chain import (
    by_evidence,
    dynamics_of,
    dynamics_parts,
    extent_of,
    structure,
)
from piezojax.identification.estimators.estimate import FittedParameter
from piezojax.identification.estimators.resonances import slew_behind
from piezojax.identification.estimators.slew_rate import few_steps
from piezojax.identification.methods import slew_warning

DT, RATE = 1e-4, 1e5
FINE = 1000


def mean_voltages(u, rate, dt=DT):
    """Return the mean over each sample of a voltage stepped in FINE parts of it."""
    v, found = u[0], []
    for wanted in u:
        path = v + np.sign(wanted - v) * rate * dt * (np.arange(FINE) + 0.5) / FINE
        low, high = sorted((v, wanted))
        found.append(np.clip(path, low, high).mean())
        v += np.clip(wanted - v, -rate * dt, rate * dt)
    return np.array(found)


def test_the_mean_voltage_of_each_sample():
    u = np.array([20.0, 20.0, 26.0, 26.0, 80.0, 75.0, 75.0, 0.0, 9.0, 20.0, 20.0])
    u = np.repeat(u, 2)
    part = AmplifierSlew(RATE, DT)
    _, found = simulate(part, u, part.init(u[0]))
    np.testing.assert_allclose(found, mean_voltages(u, RATE), atol=0.02)
    assert np.max(np.abs(np.diff(found))) <= RATE * DT + 1e-9


def test_a_rate_below_zero():
    with pytest.raises(ValueError, match="rate"):
        AmplifierSlew(-1.0, DT)


def stage(u, rate, frequency=600.0, damping=0.02):
    """Return readings of a mode behind a slew limit, with 2 nm of noise."""
    v = u if rate is None else mean_voltages(u, rate)
    w = 2.0 * np.pi * frequency
    mode = ([0.1 * w**2], [1.0, 2.0 * damping * w, w**2])
    b, a, _ = scipy.signal.cont2discrete(mode, DT)
    y = 0.1 * v[0] + scipy.signal.lfilter(b[0], a, v - v[0])
    return y + 2e-3 * np.random.default_rng(1).standard_normal(u.size)


STEPS = np.repeat(np.random.default_rng(0).uniform(10.0, 90.0, 14), 150)


def test_a_record_with_steps_shows_slew_rate_and_mode():
    record = Record(STEPS, stage(STEPS, 4e4), DT)
    found = dynamics_of(record)
    assert found.slew == pytest.approx(4e4, rel=0.05)
    assert found.modes[0].frequency == pytest.approx(600.0, rel=1e-3)
    assert found.modes[0].damping == pytest.approx(0.02, rel=0.05)
    assert str(found).endswith(f"a slew rate of {found.slew:.3g} V/s")
    commanded = Record(STEPS, stage(STEPS, 4e4), DT, input_units="um")
    assert str(dynamics_of(commanded)).endswith(" um/s")
    assert dynamics_parts(record).endswith("+slew")
    # The part acts first, wherever the name of the chain has it.
    shape = structure(f"prandtl_ishlinskii+{dynamics_parts(record)}", record)
    assert shape.system.names[:2] == ("drive", "hysteresis")
    assert "drive.rate" in shape.space.paths


def test_a_fast_amplifier_shows_no_slew_rate():
    assert dynamics_of(Record(STEPS, stage(STEPS, None), DT)).slew is None


def chirp(amplitude, start=5.0, stop=4e3, samples=8000):
    """Return slow cycles, then a logarithmic chirp (Hz) of ``amplitude`` in V."""
    slow = 50.0 - 45.0 * np.cos(2.0 * np.pi * 6.0 * DT * np.arange(5000))
    time, ratio = np.arange(samples) * DT, np.log(stop / start) / (samples * DT)
    phase = 2.0 * np.pi * start * np.expm1(ratio * time) / ratio
    ramp = np.linspace(slow[-1], 50.0, 200)
    return np.concatenate([slow, ramp, 50.0 + amplitude * np.sin(phase)])


def test_a_chirp_that_is_too_fast_for_the_amplifier_shows_its_slew_rate():
    u = chirp(2.0)
    found = dynamics_of(Record(u, stage(u, 3e3), DT))
    assert found.slew == pytest.approx(3e3, rel=0.1)
    assert dynamics_parts(Record(u, stage(u, 3e3), DT)).endswith("+slew")


def test_a_chirp_that_the_amplifier_follows_shows_no_slew_rate():
    for amplitude, rate in ((2.0, None), (0.05, 3e3)):
        u = chirp(amplitude)
        assert dynamics_of(Record(u, stage(u, rate), DT)).slew is None


def test_modes_that_the_simple_model_lacks_are_no_slew_rate():
    # Its error falls to 0.7 of itself with a slew rate; that of the full model rises.
    other = forty_stages.stage(15)
    voltages, readings = excitation.record(other)
    half = voltages.size // 2
    assert dynamics_of(Record(voltages[:half], readings[:half], other.dt)).slew is None


SINE = 50.0 + 30.0 * np.sin(2.0 * np.pi * 20.0 * DT * np.arange(2000))


@pytest.mark.parametrize(
    ("input", "expected"),
    [
        (SINE, 0.0),
        (np.concatenate([np.full(200, 38.0), SINE]), 12.0),
        # A step in the middle of a fast motion.
        (SINE + 25.0 * (np.arange(2000) > 700), 25.0),
        (np.repeat([0.0, 80.0, 20.0], 300), 80.0),
        (STEPS, 0.0),  # enough of them for a search
        (np.random.default_rng(3).uniform(0.0, 100.0, 500), 0.0),
        (np.full(100, 5.0), 0.0),
    ],
)
def test_steps_too_few_to_show_a_slew_rate(input, expected):
    assert few_steps(input) == pytest.approx(expected, abs=1.0)


def test_a_single_step_leaves_delay_and_slew_rate_free():
    u = np.concatenate([np.full(300, 38.0), SINE])
    record = Record(u, stage(u, 4e4), DT)
    shown = dynamics_of(record)
    assert shown.slew is None
    assert dynamics_parts(record) == "mode+delay+slew"
    shape = structure(f"prandtl_ishlinskii+{dynamics_parts(record)}", record)
    ranges = shape.space.ranges()
    rate, delay = ranges["drive.rate"], ranges["delay.delay"]
    assert rate.lower < 4e4 < rate.upper
    # The ramp of 12 V takes 3 samples: its mean is not in the delay of a record of
    # steps, but in that of this one.
    assert delay.lower <= max(0.0, shown.delay - 2.0 * DT) + 1e-12
    assert delay.upper >= shown.delay + 2.0 * DT - 1e-12


def test_a_record_beside_it_tells_that_a_slew_rate_may_be_hidden():
    moving = Record(SINE, stage(SINE, 4e4), DT)
    wide = np.concatenate([np.full(300, 25.0), 50.0 + 1.5 * (SINE - 50.0)])
    stepped = Record(wide, stage(wide, 4e4), DT)
    assert "slew" not in dynamics_parts(moving)
    first, *beside = by_evidence([moving, stepped], slice(0, wide.size))
    # The sine alone shows no resonance.
    assert first.input.size == wide.size
    assert dynamics_parts(first, beside).endswith("delay+slew")
    assert extent_of(moving, [stepped]).jump == pytest.approx(25.0)
    assert extent_of(moving, [stepped]).high == pytest.approx(95.0, abs=0.1)
    shape = structure("prandtl_ishlinskii+lag", moving, beside=[stepped])
    assert shape.system.parts[0].thresholds[-1] == pytest.approx(45.0 * 30 / 22, 0.01)


def test_steps_among_several_records_leave_room_for_a_slew_rate():
    # It may show only behind the fitted hysteresis.
    stepped, moving = (Record(u, stage(u, None), DT) for u in (STEPS, SINE))
    assert "slew" not in dynamics_parts(stepped)
    assert dynamics_parts(stepped, [moving]) == "modes+delay+slew"


def test_a_slew_rate_shows_behind_the_hysteresis():
    u = np.repeat(np.random.default_rng(3).uniform(10.0, 90.0, 14), 150)

    def front_of(input):
        narrow, wide = (oracle.play(input, r, input[0]) for r in (10.0, 25.0))
        return 0.05 * input + 0.57 * narrow + 0.95 * wide

    y = stage(front_of(mean_voltages(u, 8e4)), None)
    # Steps of equal height move the stage by different amounts.
    assert dynamics_of(Record(u, y, DT)).slew > 2.0 * 8e4
    assert slew_behind(front_of, u, y, DT) == pytest.approx(8e4, rel=0.05)
    fast = stage(front_of(u), None)
    assert slew_behind(front_of, u, fast, DT) is None


def test_few_steps_leave_a_slew_rate_that_is_a_guess():
    wide = np.concatenate([np.full(300, 25.0), SINE])
    few, many = (Record(u, stage(u, 4e4), DT) for u in (wide, STEPS))
    fitted = {"drive.rate": FittedParameter(value=3e4, standard_error=50.0)}
    (warning,) = slew_warning(fitted, [few])
    assert "3e+04 V/s" in warning
    assert "is a guess" in warning
    assert slew_warning(fitted, [many, few]) == []
    assert slew_warning({}, [few]) == []


def test_a_design_leaves_the_slew_limit_out():
    parts = {
        "hysteresis": PrandtlIshlinskii((0.1,), (5.0,), (0.02,)),
        "lag": FirstOrderLag(1e-3, DT),
        "calibration": Affine(1.0, 2.0),
    }
    with_slew = series(drive=AmplifierSlew(RATE, DT), **parts)
    expected = design_model(series(**parts), DT, (0.0, 100.0))
    found = design_model(with_slew, DT, (0.0, 100.0))
    assert found.rest == pytest.approx(float(expected.rest))
    assert found.gain() == pytest.approx(float(expected.gain()))
    for name in ("autoregressive", "moving"):
        np.testing.assert_allclose(
            getattr(found.dynamics, name), getattr(expected.dynamics, name), rtol=1e-9
        )
