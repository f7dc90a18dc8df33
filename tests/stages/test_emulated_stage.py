"""An emulated stage: its runs, its clock, its faults, and its end in a safe state."""

import re
import threading
import time

import numpy as np
import pytest
from stages.stage_in_tests import DT, LIMITS, REFERENCE, SAFE, lag, stage

from piezojax.stages import Fault, Stage, StoppedError
from piezojax.stages.emulated import APPROACH, BLOCK


def by_hand(reference, proportional, integral, draws):
    """Return readings and voltages of the run, in a loop that shares no code.

    The stage approaches the beginning of the reference from 0 and rests there before.
    """
    count = round(APPROACH / DT)
    share = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, count + 1) / count)
    begin = np.r_[reference[0] * share, np.full(count, reference[0])]
    whole = np.r_[begin, np.full(-len(begin) % BLOCK, begin[-1]), reference]
    x = y = u = summed = 0.0
    readings, voltages = [], []
    decay = np.exp(-DT / 5e-3)
    for k, r in enumerate(whole):
        reading = y + 1e-3 * draws[k]
        summed += integral * DT * (r - reading)
        wanted = proportional * (r - reading) + summed
        most = LIMITS.slew * DT
        u = np.clip(u + np.clip(wanted - u, -most, most), -10.0, 110.0)
        x = decay * x + (1.0 - decay) * u
        y = 0.1 * x
        readings.append(reading)
        voltages.append(u)
    return np.array(readings[-len(reference) :]), np.array(voltages[-len(reference) :])


def test_a_stage_satisfies_the_protocol():
    assert isinstance(stage(), Stage)


def test_a_run_is_that_of_a_loop_by_hand():
    record = stage(plant=lag(), seed=4).run(
        REFERENCE, {"proportional": 2.0, "integral": 900.0}
    )
    random = np.random.default_rng(4)
    draws = []
    # Of each block first the noise, then the drift is drawn.
    for _ in range(6 + 2):
        draws.append(random.standard_normal(BLOCK))
        random.standard_normal(BLOCK)
    measured, voltage = by_hand(REFERENCE, 2.0, 900.0, np.concatenate(draws))
    np.testing.assert_allclose(record.output, measured, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(record.input, voltage, rtol=0.0, atol=1e-7)
    np.testing.assert_array_equal(record.reference, REFERENCE)


def test_gains_stay_until_others_are_set():
    one = stage()
    one.run(REFERENCE, {"integral": 700.0})
    assert one.gains()["integral"] == 700.0
    one.apply({"integral": 300.0})
    assert one.gains()["integral"] == 300.0
    one.safe()
    assert one.gains() | SAFE == one.gains()


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (Fault("dropout", 500), "the reading is not a number"),
        (Fault("stuck", 500, 400), "the sensor is stuck"),
        (Fault("plant", 500, plant=lag(-0.1)), "the tracking error is too large"),
        (Fault("plant", 500, plant=lag(1e-3)), "the voltage stays at a limit"),
    ],
)
def test_a_fault_stops_the_run_and_the_stage_retreats(fault, reason):
    one = stage(faults=[fault])
    with pytest.raises(StoppedError, match=re.escape(reason)) as stop:
        one.run(REFERENCE, {"integral": 700.0})
    assert 500 < len(stop.value.measured) <= len(REFERENCE)
    assert one.voltage == pytest.approx(LIMITS.retreat, abs=1e-9)
    assert one.gains()["integral"] == SAFE["integral"]
    steps = np.abs(np.diff(stop.value.voltage))
    assert steps.max() <= LIMITS.slew * DT * (1 + 1e-9)


def test_a_stopped_stage_runs_again():
    one = stage(faults=[Fault("dropout", 500)])
    with pytest.raises(StoppedError):
        one.run(REFERENCE, {})
    record = one.run(REFERENCE, {"integral": 700.0})
    assert np.abs(record.output - REFERENCE)[200:].max() < 0.6


def test_unstable_gains_are_stopped_in_time():
    one = stage()
    with pytest.raises(StoppedError) as stop:
        one.run(REFERENCE, {"proportional": 300.0})
    assert stop.value.voltage.max() <= LIMITS.upper
    assert stop.value.voltage.min() >= LIMITS.lower
    assert one.voltage == pytest.approx(LIMITS.retreat, abs=1e-9)


def test_safe_stops_a_run_from_another_thread():
    one = stage(speed=1.0)
    asked = threading.Timer(0.6, one.safe)
    asked.start()
    begin = time.monotonic()
    with pytest.raises(StoppedError, match="it was asked to stop"):
        one.run(np.tile(REFERENCE, 20), {})
    assert time.monotonic() - begin < 15.0
    asked.join()
    assert one.voltage == pytest.approx(LIMITS.retreat, abs=1e-9)


def test_safe_stops_a_run_that_is_about_to_begin():
    one = stage()
    asked, check = threading.Thread(target=one.safe), one._check

    def check_and_ask(gains):
        asked.start()
        assert one._stop.wait(5.0)
        check(gains)

    one._check = check_and_ask
    with pytest.raises(StoppedError, match="it was asked to stop"):
        one.run(REFERENCE, {})
    asked.join()
    assert one.gains() | SAFE == one.gains()
    one._check = check
    assert one.run(REFERENCE, {}).samples == len(REFERENCE)


def test_no_request_to_stop_ends_another_one():
    one, seen = stage(), []
    one._retreat = lambda: seen.append(one._stop.is_set())
    threads = [threading.Thread(target=one.safe) for _ in range(2)]
    with one._one_at_a_time:
        for thread in threads:
            thread.start()
        time.sleep(0.1)
    for thread in threads:
        thread.join()
    assert seen == [True, True]
    assert not one._stop.is_set()


def test_time_goes_on_between_runs():
    now = iter([0.0, 0.0, 0.3])
    one = stage(drift=0.5, clock=lambda: next(now))
    one.apply({})
    before = one._state
    one.apply({})  # 0.3 s later
    assert one._state.displacement != before.displacement


@pytest.mark.parametrize(
    ("gains", "message"),
    [
        ({"nothing": 1.0}, "no parameter 'nothing'"),
        ({"integral": float("nan")}, "gains.integral is nan; it must be a number"),
    ],
)
def test_gains_that_the_controller_cannot_have_are_refused(gains, message):
    one = stage()
    with pytest.raises(ValueError, match=re.escape(message)):
        one.run(REFERENCE, gains)
    assert one.gains()["integral"] == SAFE["integral"]


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        (np.array([0.0, np.nan]), "reference must be a row of numbers"),
        (np.array([]), "reference has 0 samples; give at least one, in um"),
    ],
)
def test_a_reference_that_is_no_row_of_numbers_is_refused(reference, message):
    with pytest.raises(ValueError, match=message):
        stage().run(reference, {})
