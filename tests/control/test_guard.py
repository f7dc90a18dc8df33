"""The guard of a controller against a loop in NumPy, and what it may never let pass."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import piezojax as pj
from piezojax.control import Guard
from piezojax.control.guard import REASONS
from piezojax.core.feedback import Observation

DT = 1e-3
LIMITS = {
    "lower": -5.0,
    "upper": 100.0,
    "slew": 2000.0,  # V/s: 2 V per sample
    "largest_error": 4.0,
    "retreat": 3.0,
    "patience": 3,
    "unseen": 6.0,
}


class Told(pj.System):
    """A controller whose command is the next reference."""

    def init(self, input):
        return ()

    def step(self, state, seen):
        return state, seen.next_reference


def guarded(**changed):
    return Guard(Told(), **(LIMITS | changed), dt=DT)


@jax.jit
def run(guard, reference, wanted, measured, applied):
    """Return commands and reasons; the guard starts at rest at the first samples."""

    def step(state, row):
        state, command = guard.step(state, Observation(*row))
        return state, (command, state.reason)

    start = guard.init(Observation(reference[0], wanted[0], measured[0], applied))
    rows = reference, wanted, measured, jnp.full(len(wanted), applied)
    return jax.lax.scan(step, start, rows)[1]


def expected(limits, reference, wanted, measured, applied):
    """Return the commands and the reasons by the rules, one sample after another."""
    commands, reasons = [], []
    last, seen, reason = applied, measured[0], 0
    far = railed = slewing = 0
    unseen = 0.0
    for r, w, y in zip(reference, wanted, measured, strict=True):
        lost = np.isnan(y)
        stuck = unseen > limits["unseen"]
        reading = seen if lost else y
        far = far + 1 if abs(r - reading) > limits["largest_error"] else 0
        outside = w <= limits["lower"] or w >= limits["upper"]
        railed = railed + 1 if outside else 0
        most = limits["slew"] * DT
        slewing = slewing + 1 if abs(w - last) > most else 0
        if not reason:
            if lost:
                reason = 1
            elif stuck:
                reason = 2
            elif np.isnan(w):
                reason = 3
            elif far >= limits["patience"]:
                reason = 4
            elif railed >= limits["patience"]:
                reason = 5
            elif slewing >= limits["patience"]:
                reason = 6
        target = limits["retreat"] if reason else w
        command = last + min(max(target - last, -most), most)
        command = min(max(command, limits["lower"]), limits["upper"])
        unseen = unseen + abs(command - last) if reading == seen else 0.0
        last, seen = command, reading
        commands.append(command)
        reasons.append(reason)
    return np.array(commands), np.array(reasons)


def signals(seed, samples=120):
    """Return reference, wanted command and reading, with faults at random times."""
    random = np.random.default_rng(seed)
    wanted = 50.0 + np.cumsum(random.uniform(-1.9, 1.9, samples))
    reference = random.normal(0.0, 1.0, samples)
    measured = reference + random.normal(0.0, 0.5, samples)
    at = int(random.integers(40, samples))
    kind = seed % 6
    if kind == 0:
        measured[at] = np.nan
    elif kind == 1:
        measured[at:] = measured[at]
    elif kind == 2:
        wanted[at] = np.nan
    elif kind == 3:
        measured[at:] += 20.0
    elif kind == 4:
        wanted[at:] = 300.0
    else:
        wanted[at:] += np.where(np.arange(samples - at) % 2, 30.0, -30.0)
    return reference, wanted, measured


@pytest.mark.parametrize("seed", range(24))
def test_commands_and_reasons_are_those_of_the_rules(seed):
    found = run(guarded(), *signals(seed), 50.0)
    for mine, oracle in zip(found, expected(LIMITS, *signals(seed), 50.0), strict=True):
        np.testing.assert_allclose(mine, oracle, rtol=0.0, atol=1e-12)
    assert len(REASONS) == 7


@pytest.mark.parametrize(
    ("seed", "reason"), [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 6)]
)
def test_each_fault_ends_at_the_retreat(seed, reason):
    commands, reasons = run(guarded(), *signals(seed), 50.0)
    assert reasons[-1] == reason
    first = int(np.argmax(np.asarray(reasons) > 0))
    way = np.diff(np.asarray(commands)[first - 1 :])
    assert np.all(np.abs(way) <= LIMITS["slew"] * DT * (1 + 1e-12))
    assert np.all(way * np.sign(LIMITS["retreat"] - commands[first - 1]) >= 0.0)
    assert np.all(np.asarray(reasons)[first:] == reason)


def test_a_healthy_run_passes_unchanged():
    reference = np.linspace(0.0, 1.0, 200)
    wanted = 50.0 + 20.0 * np.sin(np.arange(200) / 30.0)
    commands, reasons = run(guarded(), reference, wanted, reference + 1e-3, 50.0)
    np.testing.assert_allclose(commands, wanted, rtol=0.0, atol=1e-12)
    assert not np.any(reasons)


def test_a_short_excess_is_no_fault():
    reference, wanted = np.zeros(100), np.full(100, 50.0)
    measured = 0.1 * np.arange(100.0) % 0.7
    measured[50 : 50 + LIMITS["patience"] - 1] += 20.0
    assert not np.any(run(guarded(), reference, wanted, measured, 50.0)[1])


class Repeating(Told):
    """A controller whose command is the reading, also that of its start."""

    def init(self, input):
        return input.measured

    def step(self, state, seen):
        return seen.measured, state + seen.measured


@pytest.mark.parametrize("reading", [np.nan, np.inf])
def test_the_controller_starts_at_the_reference_if_the_reading_is_no_number(reading):
    guard = Guard(Repeating(), **LIMITS, dt=DT)
    missed = Observation(*map(jnp.asarray, (2.0, 2.0, reading, 4.0)))
    state = guard.init(missed)
    assert (state.controller, state.measured) == (2.0, 2.0)
    state, _ = guard.step(state, missed)
    assert (state.controller, state.measured, state.reason) == (2.0, 2.0, 1)


@given(
    wanted=st.lists(
        st.floats(allow_nan=True, allow_infinity=True, width=32),
        min_size=30,
        max_size=30,
    ),
    measured=st.lists(
        st.floats(allow_nan=True, allow_infinity=True, width=32),
        min_size=30,
        max_size=30,
    ),
)
def test_no_limit_is_ever_crossed(wanted, measured):
    commands, _ = run(
        guarded(), jnp.zeros(30), jnp.array(wanted), jnp.array(measured), 50.0
    )
    commands = np.asarray(commands)
    assert np.all(np.isfinite(commands))
    assert np.all((commands >= LIMITS["lower"]) & (commands <= LIMITS["upper"]))
    way = np.abs(np.diff(np.r_[50.0, commands]))
    assert np.all(way <= LIMITS["slew"] * DT * (1 + 1e-9))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"lower": 200.0}, "lower is 200 and upper is 100; lower must be below upper"),
        (
            {"retreat": 150.0},
            "retreat is 150 and upper is 100; retreat must be at most",
        ),
        ({"retreat": -9.0}, "lower is -5 and retreat is -9; lower must be at most"),
        ({"slew": 0.0}, "slew in V/s is 0; it must be finite and above 0"),
    ],
)
def test_limits_that_contradict_each_other_are_refused(changed, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        guarded(**changed)
