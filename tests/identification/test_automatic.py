"""Trials that choose the hysteresis of a default model: their records and rates."""

from types import SimpleNamespace

import numpy as np
import pytest

import piezojax.identification.automatic as automatic
from piezojax.core.about import About
from piezojax.dynamics import ARMA, Mode
from piezojax.identification.automatic import (
    DENSITY,
    EVERY,
    FROM_SEVERAL,
    SAMPLES,
    VARIATION,
    _slowed,
    _slowing,
)
from piezojax.identification.estimators.output_error import Optimum
from piezojax.identification.estimators.resonances import LinearDynamics
from piezojax.identification.estimators.structure import Structure
from piezojax.identification.held_dynamics import HeldDynamics
from piezojax.identification.records.record import Record
from piezojax.identification.second_sight import Seen

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


def several():
    return [record_of(CYCLES), record_of(0.9 * CYCLES)]


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
    known = dict(zip(EVERY, errors, strict=True))

    def seen_again(*_, **__):
        raise ValueError("plays do not fit")

    monkeypatch.setattr(automatic, "seen_again", seen_again)
    monkeypatch.setattr(automatic, "output_error", fitting(lambda name: known[name]))
    monkeypatch.setattr(automatic, "structure", named)
    assert automatic.hysteresis_for(several()).model == best


@pytest.mark.parametrize(("freedom", "best"), [(10.0, DENSITY), (50.0, CURVE)])
def test_weights_that_records_determine_count_against_a_density(
    freedom, best, monkeypatch
):
    """Of a hundred independent errors, as many as weights say nothing."""
    others = fitting(lambda _: 10.0)
    weights = SimpleNamespace(freedom=freedom)
    problem = SimpleNamespace(spread=lambda _: (5.0, 100.0))

    def output_error(shape, *_, **__):
        found = others(shape)
        if shape.system != DENSITY:
            return found
        return Optimum(problem, np.zeros((1, 0)), np.array([25.0]), True, weights)

    def seen_again(*_, **__):
        raise ValueError("plays do not fit")

    monkeypatch.setattr(automatic, "seen_again", seen_again)
    monkeypatch.setattr(automatic, "output_error", output_error)
    monkeypatch.setattr(automatic, "structure", named)
    assert automatic.hysteresis_for(several()).model == best


@pytest.mark.parametrize(
    ("first", "longer", "least"), [(12.0, 1.0, 1.0), (5.0, 30.0, 25.0)]
)
def test_longer_fits_decide_between_models_whose_first_fits_are_close(
    first, longer, least, monkeypatch
):
    """Frictions converge slowly; plays are too far off to be fitted again.

    A longer fit behind which worse dynamics show does not count.
    """
    errors = {name: [50.0] for name in EVERY}
    errors[CURVE], errors[FRICTIONS] = [9.9, 9.0], [first, longer]
    shown = LinearDynamics()

    def seen(*_, **__):
        return Seen(named(PLAYS), shown)

    def seen_behind(begun, chain, _):
        return Seen(named(chain), begun.shown)

    monkeypatch.setattr(automatic, "seen_again", seen)
    monkeypatch.setattr(automatic, "seen_behind", seen_behind)
    monkeypatch.setattr(
        automatic, "output_error", fitting(lambda name: errors[name].pop(0))
    )
    monkeypatch.setattr(automatic, "structure", named)
    chosen = automatic.hysteresis_for(several())
    assert chosen.model == FRICTIONS
    assert chosen.begun.fit.losses == [least]
    assert errors == {name: [] for name in EVERY}


def held(part):
    """Return linear dynamics that are held in a fit."""
    return HeldDynamics({"dynamics": part}, DT, None, About(), "model.json")


@pytest.mark.parametrize(
    ("dynamics", "slowed"),
    [
        (None, True),
        (held(Mode(800.0, 0.02, DT)), True),
        (held(ARMA((0.5,), (0.5,))), False),
    ],
)
def test_dynamics_of_one_rate_are_tried_at_that_rate(dynamics, slowed, monkeypatch):
    rates = []

    def error(name, record, dynamics):
        if dynamics is not None:
            dynamics.at(record.dt)  # raises ValueError at another rate
        rates.append(record.dt)
        return {PLAYS: 1.0}.get(name, 10.0)

    monkeypatch.setattr(automatic, "_error", error)
    chosen = automatic.hysteresis_for([record_of(CYCLES)], dynamics=dynamics)
    assert chosen.model == PLAYS
    assert np.all(np.array(rates) > DT) == slowed


@pytest.mark.parametrize("records", [[record_of(CYCLES)], several()])
def test_the_choice_fails_if_every_fit_fails(records, monkeypatch):
    def failed(*_, **__):
        raise ValueError("no start led to a finite simulation")

    monkeypatch.setattr(automatic, "seen_again", failed)
    monkeypatch.setattr(automatic, "output_error", failed)
    with pytest.raises(ValueError, match="no start led to a finite simulation"):
        automatic.hysteresis_for(records)


def test_a_model_whose_fit_fails_is_not_chosen(monkeypatch):
    def error(name, record, dynamics):
        if name == CURVE:
            raise ValueError("no start led to a finite simulation")
        return 10.0

    monkeypatch.setattr(automatic, "_error", error)
    assert automatic.hysteresis_for([record_of(CYCLES)]).model == PLAYS


def named(chain, *_, **__):
    """Return an empty structure that holds the name of its hysteresis."""
    return Structure(chain.partition("+")[0], None, np.zeros((1, 0)))


def fitting(error):
    """Return a fit whose ``error`` follows from the name of its structure."""

    def output_error(shape, *_, **__):
        found = error(shape.system)
        if found is None:
            raise ValueError("no start led to a finite simulation")
        return Optimum(None, None, np.array([found**2]), finished=True)

    return output_error
