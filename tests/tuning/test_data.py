"""Signals and plants for tuning and evaluation."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from stand_ins import fit_of

from piezojax.identification.records.record import Record
from piezojax.identification.residual_record import ResidualRecord
from piezojax.solve.clock import Clock
from piezojax.study import Study, build
from piezojax.tuning import unexplained
from piezojax.tuning.data import make_data
from piezojax.tuning.evaluator import Evaluator
from piezojax.tuning.objective import FAILED_LOSS, Objective
from piezojax.tuning.runs import Signals
from piezojax.tuning.unexplained import residual_disturbances

STUDY = {
    "title": "a PID on a stage without dynamics",
    "rate": 20_000.0,
    "seed": 3,
    "plant": {"type": "Affine", "gain": 0.15},
    "actuator": {"lower": -20.0, "upper": 120.0},
    "sensor": {"noise_rms": 0.01},
    "controller": {"type": "PID", "proportional": 0.0, "integral": 300.0, "dt": 5e-5},
    "references": {
        "tune": ["SIN50", "CONST2"],
        "unseen": ["TRI50"],
        "duration": 0.02,
        "settle": 0.0,
    },
    "parameters": {"controller.integral": {"lower": 30.0, "upper": 3e3}},
}


def case_of(**tables):
    return build(Study.model_validate(STUDY | tables), "small.toml")


def apart(series):
    """Return whether all series (last dimension: time) are uncorrelated."""
    rows = np.asarray(series).reshape(-1, np.shape(series)[-1])
    related = np.corrcoef(rows) - np.eye(len(rows))
    return np.abs(related).max() < 5.0 / np.sqrt(rows.shape[1])


# Draws


@pytest.mark.parametrize("draws", [1, 3])
def test_holdout_and_tuning_have_different_draws(draws):
    """Both have as many draws as by default: one stream would repeat them."""
    data = make_data(
        case_of(
            objective={"noise_draws": draws},
            holdout_draws=draws,
            disturbance={"drift_rms": 0.1},
        )
    )
    assert data.tuning.noise.shape == (2, draws, 400)
    assert data.holdout.noise.shape == (3, draws, 400)
    for one, other in (
        (data.tuning.noise, data.holdout.noise),
        (data.tuning.disturbance, data.holdout.disturbance),
    ):
        steps = np.diff(np.concatenate([np.asarray(one), np.asarray(other)]), axis=-1)
        assert apart(steps)


def test_noise_is_of_unit_variance():
    noise = make_data(case_of(holdout_draws=64)).holdout.noise
    assert np.std(noise) == pytest.approx(1.0, rel=0.02)
    assert np.mean(noise) == pytest.approx(0.0, abs=0.02)


# Residual of a fitted plant


def fitted(residual):
    """Return the data of a case fitted to a record of 0, 1, 0, 1, ... um."""
    case = case_of()
    output = np.arange(400.0) % 2.0
    record = Record(output, output, case.study.dt)
    fit = fit_of(case.loop.plant, record, output - residual)
    return make_data(dataclasses.replace(case, fit=fit))


def test_training_and_validation_parts_disturb_different_runs():
    # the initial loading, the rest of the training part, the validation part
    residual = np.repeat([9.0, 1.0, -2.0], [1, 199, 200])
    data = fitted(residual)
    np.testing.assert_allclose(data.tuning.disturbance, np.full((2, 2, 400), 1.0))
    np.testing.assert_allclose(data.holdout.disturbance, np.full((3, 2, 400), -2.0))


REST, SLOW = np.zeros(400), 1e-9 * np.arange(400.0)
"""A constant reference, and a stage that hardly moves."""


def played(residual, reference=REST, moved=SLOW, part="validate"):
    """Return the disturbances of a fit with the residual ``residual``.

    The first has the largest deviation, the second the largest fast changes.
    """
    case = case_of()
    record = Record(np.arange(400.0), moved + residual, case.study.dt)
    fit = fit_of(case.loop.plant, record, moved)
    time_s = case.study.dt * np.arange(float(len(reference)))
    residual = ResidualRecord.of(fit)
    return residual_disturbances(residual, np.asarray(reference), time_s, part)


def test_a_short_residual_is_reflected():
    for found in played(np.arange(400.0)) - 200.0:
        expected = np.mod(found[0] + np.arange(400.0), 398.0)
        expected = np.minimum(expected, 398.0 - expected)
        np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize(("part", "first"), [("train", 0), ("validate", 200)])
def test_the_worst_stretches_are_the_disturbances(part, first, monkeypatch):
    """The largest deviation is in the middle, the fastest changes are at the end."""
    monkeypatch.setattr(unexplained, "FAST", 10)
    time = np.arange(200.0)
    swing = np.where(time > 150.0, np.sin(2.0 * np.pi * time / 10.0), 0.0)
    residual = np.zeros(400)
    residual[first : first + 200] = swing
    residual[first + 100 : first + 145] += 6.0 * np.sin(np.linspace(0.0, np.pi, 45))
    slow, fast = played(residual, np.zeros(45), part=part)
    assert np.ptp(slow) > 5.0
    assert np.ptp(fast) == pytest.approx(2.0, rel=0.1)


def test_a_residual_follows_the_path_of_a_fast_reference():
    # The stage of the record moves 1e-4 um a sample, slower than the reference.
    reference = np.asarray(make_data(case_of()).holdout.references)[0]
    way = np.cumsum(np.abs(np.diff(reference, prepend=reference[0]))) / 1e-4
    for found in played(np.arange(400.0), reference, 1e-4 * np.arange(400.0)) - 200.0:
        place = np.maximum(found[0] + np.arange(400.0), found[0] + way) % 398.0
        np.testing.assert_allclose(found, np.minimum(place, 398.0 - place), atol=1e-6)


# Perturbed plants

ENSEMBLE = {"spread": {"plant.gain": 0.3}, "tune": 2, "margins": 0, "holdout": 3}
STILL = {"tune": ["CONST2"], "duration": 0.02, "settle": 0.0}


@pytest.fixture(scope="module")
def still():
    """Return constant references of 2 um, stages of different gain, and no noise."""
    case = case_of(references=STILL, sensor={"noise_rms": 0.0}, ensemble=ENSEMBLE)
    stages = case.ensemble.stages("holdout")
    assert np.ptp(np.asarray(stages.plant.gain)) > 0.02
    return case, stages, make_data(case)


def test_a_perturbed_plant_starts_at_rest_in_the_evaluation(still):
    case, stages, data = still
    seen = Evaluator(Clock(), case).limited(case.loop, data.holdout, stages)
    np.testing.assert_allclose(seen.tracking.rms_error, 0.0, atol=1e-12)


def test_a_perturbed_plant_starts_at_rest_in_the_search(still):
    case, stages, data = still
    objective = objective_of(case, data.tuning, stages=stages)
    figures = objective.figures(case.space.start(case.loop)).tracking
    np.testing.assert_allclose(figures.rms_error, 0.0, atol=1e-12)


# Saturated runs


def objective_of(case, signals, **options):
    count = 1 if "stages" not in options else 3
    scale = jnp.ones((count, len(signals.references)))
    loop, space = case.loop, case.space
    return Objective(loop, space, signals, scale, jnp.asarray(100.0), 0, **options)


@pytest.mark.parametrize(
    ("heights", "lost"), [((1.0, 2.0), False), ((1.0, 500.0), True)]
)
def test_one_saturated_run_gives_an_infinite_error(heights, lost):
    """120 V reach 18 um: the actuator stays at its limit at 500 um, not at 2 um."""
    case = case_of()
    references = jnp.asarray(heights)[:, None] * jnp.ones(400)
    signals = Signals(references, jnp.zeros((2, 1, 400)))
    loss = objective_of(case, signals).loss(case.space.start(case.loop))
    assert bool(loss == FAILED_LOSS) is lost
