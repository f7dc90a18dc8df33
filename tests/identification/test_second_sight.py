"""Dynamics behind a fitted hysteresis, of stages that share no code with ours."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from oracles import forty_stages
from oracles.stages import Parameters, Stage

from piezojax.core.paths import get
from piezojax.core.progress import Silent
from piezojax.identification import second_sight
from piezojax.identification.chain import dynamics_of, structure
from piezojax.identification.estimators.resonances import dynamics_behind
from piezojax.identification.records.record import Record
from piezojax.identification.second_sight import seen_again

RATE, SLOW = 10e3, 0.42e-3
MODES = np.array([[571.0, 0.059, 0.947], [1452.0, 0.0083, 0.053]])


def stage():
    """Return frictions, two modes, a slow sensor and a delay of a sample."""
    table = np.array([[0.126, 0.002, 1.666], [0.349, 0.068, 1.293]])
    return Stage(
        Parameters(
            name="frictions", rate=RATE, lower=-20.0, upper=120.0, stroke=40.0,
            memory=4, table=table, modes=MODES,
            creep=forty_stages.logarithmic_creep(0.005),
            bend=0.0, sensor_lag=SLOW, delay=1.0, bits=18, noise=5e-3, slew=1e6,
            ramp=0.0, walk=0.0, zero=0.0,
        )
    )  # fmt: skip


def record_of(frequency, seed):
    one = stage()
    time = np.arange(2000) / RATE
    u = 40.0 + 14.0 * (time > 0.02)
    u += 45.0 * np.sin(2.0 * np.pi * frequency * np.maximum(time - 0.1, 0.0))
    first = one.reset(float(u[0]), seed)
    y = np.append(first, one.respond(u)[0][:-1])
    return Record(u, y, 1.0 / RATE, source=f"{frequency} Hz")


@pytest.fixture(scope="module")
def records():
    return [record_of(20.0, 1), record_of(40.0, 2)]


def front_of(record):
    """Return the output of the frictions alone, in um."""
    path = np.concatenate([np.linspace(0.0, record.input[0], 200), record.input])
    one = stage()
    found = one._remembered(path)[200:]
    return found * record.span / np.ptp(found)


def test_a_weak_mode_hidden_by_plays_shows_behind_the_hysteresis(records):
    record = records[0]
    assert len(dynamics_of(record).modes) == 1
    found = dynamics_behind(front_of(record), record.output, record.dt)
    assert [mode.frequency for mode in found.modes] == pytest.approx(MODES[:, 0], 2e-3)
    assert [mode.damping for mode in found.modes] == pytest.approx(MODES[:, 1], 0.1)
    assert [mode.share for mode in found.modes] == pytest.approx(MODES[:, 2], abs=0.01)
    assert found.lags == pytest.approx([SLOW], 0.1)
    assert found.delay == pytest.approx(1.0 / RATE, abs=0.3 / RATE)


def test_a_front_without_dynamics_behind_it_shows_no_mode(records):
    front = front_of(records[0])
    noise = 5e-3 * np.random.default_rng(3).standard_normal(front.size)
    assert not dynamics_behind(front, np.append(0.0, front[:-1]) + noise, 1e-4).modes


def test_a_short_record_shows_nothing():
    assert dynamics_behind(np.arange(100.0), np.arange(100.0), 1e-4).delay is None


def test_a_second_look_gives_the_structure_both_modes(records):
    part = slice(0, records[0].samples)
    once = structure("coleman_hodgdon+modes+delay", records[0], beside=records[1:])
    assert "dynamics.frequency.1" not in once.space.paths
    seen = seen_again("coleman_hodgdon+modes+delay", records, part, Silent(), looks=1)
    assert "dynamics.frequency.1" in seen.structure.space.paths
    assert [m.frequency for m in seen.shown.modes] == pytest.approx(MODES[:, 0], 0.01)
    assert len(seen.structure.starts) == 1
    guess = structure(
        "coleman_hodgdon+modes+delay", records[0], beside=records[1:], shown=seen.shown
    ).starts[0]
    np.testing.assert_array_equal(seen.structure.guess, guess)


def test_a_second_look_gives_the_structure_the_slew_rate(records, monkeypatch):
    # tests/dynamics/test_slew.py has the search itself.
    monkeypatch.setattr(second_sight, "slew_behind", lambda *_: 1.23e5)
    part, model = slice(0, records[0].samples), "dahl_frictions+modes+delay+slew"
    seen = seen_again(model, records, part, Silent(), looks=1)
    assert seen.shown.slew == 1.23e5
    shape = seen.structure
    started = shape.space.put(shape.system, jnp.asarray(shape.starts[0]))
    assert get(started, "drive.rate") == pytest.approx(1.23e5)
    # A part without a found delay has half a sample; the stage has one.
    assert get(started, "delay.delay") == pytest.approx(seen.shown.delay, rel=1e-6)
    dynamics = [shape.space.paths.index(path) for path in shape.dynamics]
    np.testing.assert_allclose(shape.starts[0][dynamics], shape.guess[dynamics])


def test_several_records_begin_with_a_stage_without_power(records):
    first, second = records
    for model in (
        "dahl_frictions+lag",
        "coleman_hodgdon+lag",
        "prandtl_ishlinskii+lag",
    ):
        shape = structure(model, first, beside=[second])
        rests = [path for path in shape.own if "rest_" in path]
        assert rests
        assert all(float(get(shape.system, path)) == 0.0 for path in rests)
        alone = structure(model, first).system
        assert float(get(alone, "hysteresis.rest_input")) == first.input[0]


def test_starts_that_differ_only_in_the_state_before_a_record_are_one(records):
    shape = structure("dahl_frictions+lag", records[0])
    assert len(shape.starts) > len(shape.without(shape.own).starts) == 1


def test_a_weak_mode_shows_at_a_high_rate_behind_a_slow_sensor():
    # Least squares in the coefficients of this order do not determine them.
    modes = np.array([[503.0, 0.0093, 1.05], [846.0, 0.027, -0.05]])
    changed = {"rate": 20e3, "modes": modes, "sensor_lag": 9.3e-4, "slew": 1e9}
    one = Stage(dataclasses.replace(stage().parameters, **changed))
    random = np.random.default_rng(1)
    heights = random.uniform(-10.0, 110.0, 20)
    u = np.repeat(heights, random.integers(400, 2400, 20))
    y = np.append(one.reset(float(u[0]), 1), one.respond(u)[0][:-1])
    path = np.concatenate([np.linspace(0.0, u[0], 200), u])
    front = one._remembered(path)[200:]
    found = dynamics_behind(front * np.ptp(y) / np.ptp(front), y, 1.0 / 20e3)
    assert [mode.frequency for mode in found.modes] == pytest.approx(modes[:, 0], 5e-3)
    assert [mode.share for mode in found.modes] == pytest.approx(modes[:, 2], abs=0.01)
