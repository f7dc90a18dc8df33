"""Signals and plants for tuning and evaluation."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from stand_ins import fit_of

from piezojax.core.paths import replace
from piezojax.identification.records.record import Record
from piezojax.identification.residual_record import ResidualRecord, Stretch
from piezojax.signals.missing_hysteresis import missing_hysteresis
from piezojax.solve.clock import Clock
from piezojax.study import Study, build
from piezojax.tuning import unexplained
from piezojax.tuning.data import judging, make_data
from piezojax.tuning.evaluator import Evaluator
from piezojax.tuning.objective import FAILED_LOSS, Objective
from piezojax.tuning.runs import Signals
from piezojax.tuning.unexplained import (
    Suppression,
    gain_error,
    residual_disturbances,
    suppression_of,
)

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


def fitted(residual, **tables):
    """Return the data of a case fitted to a record of 0, 1, 0, 1, ... um."""
    case = case_of(**tables)
    output = np.arange(400.0) % 2.0
    record = Record(output, output, case.study.dt)
    fit = fit_of(case.loop.plant, record, output - residual)
    return make_data(dataclasses.replace(case, fit=fit))


BEGUN = np.asarray(case_of().references)
BEGUN = BEGUN - BEGUN[:, :1]
WRONG = np.stack([BEGUN, -BEGUN], axis=1)
"""Errors of a gain that is wrong by 100 %, as that of a model that explains nothing."""


def test_training_and_validation_parts_disturb_different_runs():
    # the initial loading, the rest of the training part, the validation part
    residual = np.repeat([9.0, 1.0, -2.0], [1, 199, 200])
    data = fitted(residual)
    np.testing.assert_allclose(data.tuning.disturbance, 1.0 + WRONG[:2])
    np.testing.assert_allclose(data.holdout.disturbance, -2.0 + WRONG)


def test_an_assumed_hysteresis_disturbs_half_of_the_runs():
    assumed = {"disturbance": {"hysteresis": 0.1}}
    case = case_of(**assumed, objective={"noise_draws": 3})
    data, expected = make_data(case), missing_hysteresis(case.references, 0.1)
    assert np.ptp(expected[0]) > 0.1
    assert data.tuning.noise.shape == (2, 6, 400)
    for signals in (data.tuning, data.holdout):
        for disturbance, deviations in zip(signals.disturbance, expected, strict=False):
            draws = len(disturbance) // 2
            np.testing.assert_array_equal(disturbance[:draws], [deviations] * draws)
            np.testing.assert_array_equal(disturbance[draws:], 0.0)
    # beside a residual
    data = fitted(np.repeat([9.0, 1.0, -2.0], [1, 199, 200]), **assumed)
    both = np.stack([expected, np.zeros_like(expected)], axis=1)
    np.testing.assert_allclose(data.tuning.disturbance, 1.0 + both[:2] + WRONG[:2])
    np.testing.assert_allclose(data.holdout.disturbance, -2.0 + both + WRONG)


@pytest.mark.parametrize("share", [0.03, -0.2, 3.0])
def test_a_wrong_gain_of_the_model_is_found_from_its_residual(share):
    """The record has large motions, the reference small ones around another place."""
    time = np.arange(1000.0)
    simulated = np.c_[40.0 * np.sin(time / 50.0), 7.0 * np.cos(time / 50.0)]
    simulated = simulated[: 2 * round(50.0 * np.pi)]  # a whole period
    stretch = Stretch(share * simulated, simulated)
    none = Stretch(np.zeros_like(simulated), simulated)
    residual = ResidualRecord(1e-3, {"train": (none,), "validate": (stretch,)})
    references = np.stack([5.0 + np.sin(time / 30.0), 9.0 * np.cos(time / 10.0)], -1)
    found = gain_error(residual, references[None], "validate")[0]
    largest = min(abs(share), 1.0)
    np.testing.assert_allclose(found, largest * (references - references[0]), rtol=1e-3)
    # one axis
    stretch = Stretch(stretch.residual[:, :1], simulated[:, :1])
    residual = ResidualRecord(1e-3, {"train": (stretch,)})
    single = gain_error(residual, references[None, :, 0], "train")
    np.testing.assert_allclose(single[0], found[:, 0])


REST, SLOW = np.zeros(400), 1e-9 * np.arange(400.0)
"""A constant reference, and a stage that hardly moves."""


def played(residual, reference=REST, moved=SLOW, part="validate", loop=None):
    """Return the disturbances of a fit with the residual ``residual``.

    The first has the largest deviation, the second the largest fast changes; with
    ``loop``, the last has the largest error through it.
    """
    case = case_of()
    record = Record(np.arange(400.0), moved + residual, case.study.dt)
    fit = fit_of(case.loop.plant, record, moved)
    time_s = case.study.dt * np.arange(float(len(reference)))
    residual = ResidualRecord.of(fit)
    return residual_disturbances(residual, np.asarray(reference), time_s, part, loop)


def test_a_loop_is_judged_where_the_residual_harms_it_most():
    """A band that the loop passes lies between a large slow part and small fast one."""
    time = np.arange(200.0)
    residual = np.zeros(400)
    residual[200:260] = 10.0 * np.sin(np.linspace(0.0, np.pi, 60))
    residual[260:320] = 3.0 * np.sin(2.0 * np.pi * time[:60] / 12.0)
    residual[320:380] = 2.0 * np.sin(2.0 * np.pi * time[:60] / 4.0)
    # It passes only what changes over six samples: a window times a sine of 12 samples.
    band = np.r_[0.0, np.sin(2.0 * np.pi * np.arange(1.0, 12.0) / 12.0)] / 6.0
    first = 12
    chosen = played(residual, np.zeros(48), loop=Suppression(band, first))

    def error(stretch):
        passed = [
            sum(band[i] * stretch[k - i] for i in range(12)) for k in range(first, 48)
        ]
        return np.sqrt(np.mean(np.square(passed)))

    assert np.ptp(chosen[-1]) == pytest.approx(6.0, rel=0.1)
    assert error(chosen[-1]) == pytest.approx(3.0 / np.sqrt(2.0), rel=0.1)
    for other in [*chosen, *played(residual, np.zeros(48))]:
        assert error(other) <= error(chosen[-1]) + 1e-12


@pytest.mark.parametrize(
    ("response", "least", "most"),
    [
        (np.r_[1.0, np.zeros(399)], 4.5, 5.5),  # open loop: the offset counts
        (np.r_[1.0, -0.2 * 0.8 ** np.arange(399.0)], 0.0, 0.9),  # it decays
    ],
)
def test_an_offset_counts_as_far_as_the_loop_leaves_it(response, least, most):
    residual = 5.0 + 0.5 * np.sin(np.arange(400.0) / 60.0)
    loop = Suppression(response, 100)
    (*_, worst) = played(residual, np.zeros(400), loop=loop)
    assert least <= loop.error(worst) <= most


def integrator(gain):
    """Return the loop of the study with this integral gain, times its sample time."""
    case = case_of()
    return case.study.dt, replace(
        case.loop, {"controller.integral": gain / 5e-5 / 0.15}
    )


def test_the_suppression_is_the_sensitivity_of_the_loop():
    """S of y(k+1) = y(k) + g e(k) + d(k+1) - d(k), by its recursion."""
    dt, loop = integrator(0.3)
    found = suppression_of(loop, 2.0, 400, 0, dt).response
    output, displaced = np.zeros(400), np.r_[1.0, np.zeros(399)]
    voltage = 0.0
    for k in range(400):
        output[k] = voltage + displaced[k]
        voltage -= 0.3 * output[k]
    np.testing.assert_allclose(found, output, atol=1e-9)


def test_an_unstable_loop_has_no_suppression():
    dt, loop = integrator(2.5)
    assert suppression_of(loop, 2.0, 400, 0, dt) is None


def test_the_holdout_is_the_worst_for_the_judged_loop():
    case = case_of()
    rng = np.random.default_rng(4)
    moved = np.cumsum(rng.standard_normal(2000)) * 1e-6
    residual = np.convolve(rng.standard_normal(2000), np.ones(20) / 20.0, "same")
    record = Record(np.arange(2000.0), moved + residual, case.study.dt)
    case = dataclasses.replace(case, fit=fit_of(case.loop.plant, record, moved))
    plain, judged = make_data(case), judging(make_data(case), case, case.loop)
    np.testing.assert_array_equal(plain.holdout.noise, judged.holdout.noise)
    np.testing.assert_array_equal(plain.tuning.disturbance, judged.tuning.disturbance)
    reference = case.margin_reference
    loop = suppression_of(case.loop, reference, 400, 0, case.study.dt)
    for one, other in zip(
        np.asarray(plain.holdout.disturbance),
        np.asarray(judged.holdout.disturbance),
        strict=True,
    ):
        assert loop.error(other[-1]) >= max(loop.error(each) for each in one) - 1e-12
    assert not np.array_equal(plain.holdout.disturbance, judged.holdout.disturbance)


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
