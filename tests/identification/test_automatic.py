"""Trials that choose the hysteresis of a default model: their records and rates."""

from types import SimpleNamespace

import numpy as np
import pytest

import piezojax.identification.automatic as automatic
from piezojax.identification.automatic import (
    DENSITY,
    FROM_SEVERAL,
    SAMPLES,
    VARIATION,
    _slowed,
    _slowing,
)
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


CURVE, PLAYS, FRICTIONS = FROM_SEVERAL


@pytest.mark.parametrize(
    ("errors", "best"),
    [
        ((10.0, 8.1, 9.0, 8.05), CURVE),
        ((10.0, 7.0, 7.5, 5.7), PLAYS),
        ((10.0, 7.5, 7.0, 5.7), FRICTIONS),
        ((10.0, 7.5, 7.0, 5.5), DENSITY),
        ((10.0, 7.5, None, 7.0), PLAYS),
        ((10.0, None, None, None), CURVE),
    ],
)
def test_a_hysteresis_of_more_parameters_must_be_clearly_better(
    errors, best, monkeypatch
):
    """The ``errors`` of the short fits are given; None if one fails."""
    known = dict(zip((*FROM_SEVERAL, DENSITY), errors, strict=True))

    def output_error(name, *_, **__):
        if known[name] is None:
            raise ValueError("no start led to a finite simulation")
        return SimpleNamespace(losses=[known[name] ** 2])

    def seen_again(*_, **__):
        raise ValueError("plays do not fit")

    monkeypatch.setattr(automatic, "seen_again", seen_again)
    monkeypatch.setattr(automatic, "output_error", output_error)
    monkeypatch.setattr(
        automatic, "structure", lambda chain, *_, **__: chain.partition("+")[0]
    )
    records = [record_of(CYCLES), record_of(0.9 * CYCLES)]
    assert automatic.hysteresis_for(records).model == best
