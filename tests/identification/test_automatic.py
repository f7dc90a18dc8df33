"""Trials that choose the hysteresis of a default model: their records and rates."""

import numpy as np
import pytest

from piezojax.identification.automatic import SAMPLES, VARIATION, _slowed, _slowing
from piezojax.identification.records.record import Record

DT = 5e-5
TIME = DT * np.arange(40_000)
CYCLES = 50.0 - 40.0 * np.cos(2.0 * np.pi * 5.0 * TIME)


def record_of(input):
    """Return the record of a stage that only delays by one sample."""
    return Record(input, np.append(input[0], input[:-1]), DT, source="made up")


def test_a_record_of_slow_cycles_is_tried_at_a_lower_rate():
    assert _slowing(record_of(CYCLES)) == CYCLES.size // SAMPLES


@pytest.mark.parametrize(
    ("frequency", "height"), [(600.0, 2.0), (1000.0, 1.0), (4000.0, 0.5)]
)
def test_a_lower_rate_keeps_the_fast_motion_of_the_input(frequency, height):
    fast = height * np.sin(2.0 * np.pi * frequency * TIME)
    record = record_of(CYCLES + np.where(TIME > 1.0, fast, 0.0))
    every = _slowing(record)
    assert every < CYCLES.size // SAMPLES
    slowed, whole = (
        np.abs(np.diff(each.input)).sum() for each in (_slowed(record, every), record)
    )
    assert slowed > VARIATION * whole


@pytest.mark.parametrize("every", [1, 2, 7, 10])
def test_the_delay_remains_one_sample_of_the_record(every):
    record = _slowed(record_of(CYCLES), every)
    inside = slice(50, -50)
    # The output follows the input by one sample, as in the loop.
    later = record.output[1:][inside] - record.input[:-1][inside]
    assert np.abs(later).max() < 2e-3
    assert record.dt == every * DT
