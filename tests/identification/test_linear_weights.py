"""Preisach weights in chains of any parts, against relays in a NumPy loop."""

import itertools
import re

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.preisach import Lines

from piezojax.core.paths import get, replace
from piezojax.core.space import squash, unsquash
from piezojax.hysteresis import preisach
from piezojax.identification import Options, identify
from piezojax.identification.chain import structure
from piezojax.identification.estimators.approach import TURNS
from piezojax.identification.estimators.error_problem import at_starts, problem_of
from piezojax.identification.estimators.free_runs import starts_of
from piezojax.identification.estimators.linear_start import Start
from piezojax.identification.estimators.linear_weights import (
    likeliest_scale,
    with_weights,
)
from piezojax.identification.estimators.output_error import output_error
from piezojax.identification.estimators.standard_errors import values_and_errors
from piezojax.identification.methods import weights_warning
from piezojax.identification.records.record import Record

# The programs run long: a density has hundreds of weights.
pytestmark = pytest.mark.usefixtures("optimised")

DT, SAMPLES, NOISE, LAG = 1e-3, 600, 2e-3, 4e-3
MODEL = "preisach+lag"
CELLS, LOW, HIGH = 12, 0.0, 100.0


@pytest.fixture(scope="module", autouse=True)
def coarser():
    """Fit 24 cells per side instead of 36: half as many weights as by default."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(preisach, "CELLS", 24)
        yield


def density():
    """Return rough weights (um), the more of them the nearer to the diagonal."""
    random = np.random.default_rng(4)
    places = np.arange(CELLS)
    apart = (places[:, None] - places) / CELLS
    weights = np.tril(random.gamma(2.0, size=(CELLS, CELLS)) * np.exp(-3.0 * apart))
    np.fill_diagonal(weights, 10.0)
    return 12.0 * weights / weights.sum()


def drive(kind):
    """Return the input of a record: swings of changing height, or steps."""
    time = DT * np.arange(SAMPLES)
    random = np.random.default_rng(7)
    if kind == "steps":
        return np.repeat(random.uniform(12.0, 88.0, SAMPLES // 30), 30)
    height = np.repeat(random.uniform(8.0, 42.0, SAMPLES // 50), 50)
    height[100:150] = 42.0
    return 50.0 - height * np.cos(2.0 * np.pi * float(kind) * time)


def record_of(kind, levels, zero, seed):
    """Return a record of relays and a lag after a motion from 0 V over ``levels``."""
    u = drive(kind)
    ends = (0.0, *levels, u[0])
    before = np.concatenate(
        [np.linspace(*pair, 300) for pair in itertools.pairwise(ends)]
    )
    path = np.concatenate([before, u])
    relays = Lines(density(), LOW, HIGH, 0.0)
    motion = np.empty(path.size)
    for k, each in enumerate(path):
        motion[k] = relays.output(each)
        relays.w = relays.moved(each)
    share, tip = 1.0 - np.exp(-DT / LAG), [motion[0]]
    for each in motion[:-1]:
        tip.append(tip[-1] + share * (each - tip[-1]))
    y = np.array(tip)[before.size :]
    noise = NOISE * np.random.default_rng(seed).standard_normal(SAMPLES)
    return Record(u, y + zero + noise, DT, source=kind)


PAST = {"10": (90.0, 20.0), "6": (60.0, 4.0, 70.0), "steps": (30.0, 95.0)}


@pytest.fixture(scope="module")
def records():
    return [
        record_of(kind, past, zero, seed)
        for seed, (zero, (kind, past)) in enumerate(
            zip((1.0, -2.0, 3.0), PAST.items(), strict=True)
        )
    ]


def fitted(records):
    shape = structure(MODEL, records[0], beside=records[1:])
    whole = slice(0, SAMPLES)
    return output_error(shape, records, whole, steps=24, passes=4)


def test_two_records_determine_a_density_and_the_lag_behind_it(records):
    found = fitted(records[:2])
    weights = np.asarray(found.system.parts[0].weights)
    assert (weights >= 0.0).all()
    assert not np.triu(weights, 1).any()
    (warning,) = weights_warning(found)
    known, count = map(int, re.findall(r"\d+", warning))
    assert count == len(weights) * (len(weights) + 1) // 2
    assert 10 < known < count // 2
    (lag,), (error,) = values_and_errors(found)
    assert lag == pytest.approx(LAG, rel=0.01)
    assert lag == pytest.approx(LAG, abs=5.0 * error)
    # The turning points of the third record are others.
    _, (run,), _ = starts_of(found.system, records[2:], slice(0, SAMPLES))
    error = np.std(run[:, 0] - records[2].output)
    assert error < 0.003 * np.ptp(records[2].output)


def test_the_weights_that_the_records_determine_count_as_parameters(records):
    fit = identify(records[:1], MODEL, options=Options(steps=2))
    (text,) = [text for text in fit.report.warnings if "weights of the hys" in text]
    known, _ = map(int, re.findall(r"\d+", text))
    assert fit.count == len(fit.report.parameters) + known


def test_one_record_has_a_past_too(records):
    found = fitted(records[:1])
    _, (run,), _ = starts_of(found.system, records[:1], slice(0, SAMPLES))
    assert np.std(run[:, 0] - records[0].output) < 2.0 * NOISE
    (lag,), _ = values_and_errors(found)
    assert lag == pytest.approx(LAG, rel=0.02)


@pytest.mark.parametrize(("guess", "steps", "off"), [(0.05, 24, 0.01), (0.95, 8, 0.05)])
def test_a_poor_first_guess_of_the_dynamics_does_not_spoil_the_weights(
    records, guess, steps, off
):
    # With whitened errors the first guess of the dynamics is tried again in the end.
    shape = structure(MODEL, records[0], beside=records[1:2])
    assert shape.dynamics == ("lag.time_constant",)
    starts = shape.starts.copy()
    starts[:, shape.space.paths.index("lag.time_constant")] = guess
    shape = shape._replace(starts=starts, whitening=(1.0, -0.9))
    found = output_error(shape, records[:2], slice(0, SAMPLES), steps=steps, passes=3)
    (lag,), _ = values_and_errors(found)
    assert lag == pytest.approx(LAG, rel=off)


@pytest.fixture(scope="module")
def problem(records):
    shape = structure(MODEL, records[0], beside=records[1:2])
    shape = shape.without(shape.own)
    whole = slice(0, SAMPLES)
    ends = jnp.array([5.0, 95.0])
    # At rest, with so large a variance that the state of the lag is not corrected: its
    # effect depends on the weights and the lag, and is not differentiated.
    found = [
        Start(jnp.full(TURNS, r.input[0]), ends, jnp.asarray(1e9)) for r in records[:2]
    ]
    return shape, at_starts(problem_of(shape, records[:2], whole), found)


def free(shape):
    return unsquash(jnp.asarray(shape.starts[0]))


def test_the_gradient_is_that_of_the_loss_with_the_best_weights(problem):
    shape, known = problem
    at = free(shape)
    fit = with_weights(known, shape.linear, at)
    step = 1e-4
    points = jnp.stack([at, at - step, at + step])
    loss, gradient, curvature = fit.normal_equations(points)
    slope = (loss[2] - loss[1]) / (2.0 * step)
    assert gradient[0, 0] == pytest.approx(slope, rel=1e-5)
    bend = (gradient[2, 0] - gradient[1, 0]) / (2.0 * step)
    # Gauss-Newton leaves out the second derivative of the errors.
    assert curvature[0, 0, 0] == pytest.approx(bend, rel=0.3)


def test_weights_that_change_too_make_a_parameter_less_certain(problem):
    shape, known = problem
    at = free(shape)
    fit = with_weights(known, shape.linear, at)
    held = fit._replace(above=np.zeros_like(fit.above), inverse=np.zeros((0, 0)))
    joint, fixed = (each.normal_equations(at[None])[2][0, 0, 0] for each in (fit, held))
    assert 0.0 < joint < 0.9 * fixed


def test_best_weights_leave_no_better_ones_nearby(problem):
    shape, known = problem
    at = free(shape)
    fit = with_weights(known, shape.linear, at)
    errors = np.asarray(fit.problem.residuals(squash(at)))
    rough = fit.smoothing @ (shape.linear.least + fit.above)
    slope = fit.factor.T @ (fit.basis.T @ errors) + fit.smoothing.T @ rough
    # A weight at its bound would have to fall, the others are stationary.
    assert (slope[fit.above == 0.0] > -1e-9).all()
    assert np.abs(slope[fit.above > 0.0]).max() < 1e-9
    loss, _, _ = fit.normal_equations(at[None])
    assert loss[0] == pytest.approx(0.5 * (errors @ errors + rough @ rough))


def test_only_weights_that_the_errors_determine_count(problem):
    shape, known = problem
    at = free(shape)
    fit = with_weights(known, shape.linear, at)
    # Under a heavy prior the diagonal is constant, and so is the rest.
    assert fit.best_at(at, 1e3).freedom == pytest.approx(2.0, abs=0.01)
    light = fit.best_at(at, 1e-3 * fit.scale)
    assert 2.0 < fit.freedom < light.freedom <= np.count_nonzero(light.above)


@pytest.mark.parametrize("rough", [0.1, 3.0])
def test_the_likeliest_prior_is_the_one_that_the_weights_were_drawn_from(rough):
    random = np.random.default_rng(11)
    rows, count, deviation = 400, 60, 0.5
    weights = np.cumsum(rough * random.standard_normal(count))
    effects = random.standard_normal((rows, count))
    wanted = effects @ weights + deviation * random.standard_normal(rows)
    found = likeliest_scale(
        effects / np.sqrt(rows),
        np.diff(np.eye(count), axis=0),
        wanted / np.sqrt(rows),
        np.geomspace(1e-4, 1e2, 200),
        float(rows),
    )
    # Sixty draws tell their deviation to about 10 %.
    assert found == pytest.approx(deviation / rough / np.sqrt(rows), rel=0.3)


def test_a_poor_first_guess_does_not_make_the_prior_heavier(problem):
    shape, known = problem
    at = free(shape)
    first = with_weights(known, shape.linear, at)
    again = with_weights(first.problem, shape.linear, at)
    assert first.scale == pytest.approx(again.scale, rel=0.3)


def test_an_effect_is_the_change_of_the_errors_by_one_weight(problem):
    shape, known = problem
    at = free(shape)
    fit = with_weights(known, shape.linear, at)
    path, count = shape.linear.path, len(shape.linear.least)
    effects = fit.basis @ fit.factor
    before = np.asarray(fit.problem.residuals(squash(at)))
    for weight in (0, 1, count // 2, count - 1):
        weights = np.array(get(fit.problem.system, path))
        weights[tuple(axis[weight] for axis in shape.linear.places)] += 1.0
        system = replace(fit.problem.system, {path: jnp.asarray(weights)})
        changed = eqx.tree_at(lambda p: p.system, fit.problem, system)
        effect = np.asarray(changed.residuals(squash(at))) - before
        # The last two are of the states of the lag, which change with the weight.
        np.testing.assert_allclose(effects[:-2, weight], effect[:-2], atol=1e-6)


def test_one_in_several_errors_stands_for_the_others(problem):
    shape, known = problem
    unit = jnp.asarray(shape.starts[0])
    every, some = (float(np.sum(known.residuals(unit, n) ** 2)) for n in (1, 4))
    assert some == pytest.approx(every, rel=0.05)
