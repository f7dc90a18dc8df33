"""Fits of several records hold parameters that these do not determine."""

import jax.numpy as jnp
import numpy as np
import pytest
from oracles import hysteresis as oracle

from piezojax import Record
from piezojax.identification.chain import structure
from piezojax.identification.estimators import error_problem
from piezojax.identification.estimators import output_error as fits
from piezojax.identification.estimators.error_problem import at_starts, problem_of
from piezojax.identification.estimators.free_runs import starts_of
from piezojax.identification.estimators.standard_errors import values_and_errors
from piezojax.identification.estimators.structure import Prior

DT, SAMPLES, NOISE = 1e-3, 400, 2e-2
QUIET = 2e-3
MODEL = "prandtl_ishlinskii+exponential_creep+lag"
VAGUE = [*(f"hysteresis.weights.{i}" for i in range(30))]
VAGUE += [f"creep.gains.{i}" for i in range(4)]
TYPICAL = 0.2 / 21
"""Distance of a weight from its first guess, in mean slopes: a fifth over 21 plays."""


def response(u):
    """Return the motion of four plays without creep, virgin at 0 V."""
    path = np.append(0.0, u)
    motion = 0.08 * path
    for threshold, weight in ((5.0, 0.01), (12.0, 0.004), (25.0, 0.012), (40.0, 0.006)):
        motion = motion + weight * oracle.play(path, threshold, 0.0)
    return np.append(motion[1], motion[1:-1])  # a voltage acts on the next sample


def record_of(height, seed, noise=NOISE):
    """Return the record of a swing over the range and small cycles after it."""
    time = DT * np.arange(SAMPLES)
    u = 50.0 + height * np.sin(2.0 * np.pi * 8.0 * time)
    u[:100] = 50.0 + 45.0 * np.sin(2.0 * np.pi * 10.0 * time[:100])
    errors = noise * np.random.default_rng(seed).standard_normal(SAMPLES)
    return Record(u, response(u) + errors, DT, source=f"{height} V")


@pytest.fixture(scope="module")
def records():
    return [record_of(8.0, 1), record_of(14.0, 2)]


@pytest.fixture(scope="module")
def shape(records):
    return structure(MODEL, records[0], beside=records[1:])


def test_the_terms_of_sums_are_vague(shape):
    assert list(shape.vague) == VAGUE
    assert structure("coleman_hodgdon+lag", record_of(8.0, 1)).vague == {}


def problem_at_first_guess(shape, records):
    part, fitted = slice(0, SAMPLES), shape.without(shape.own)
    problem = problem_of(fitted, records, part)
    system = problem.space.put(problem.system, jnp.asarray(fitted.starts[0]))
    return fitted, at_starts(problem, starts_of(system, records, part)[0])


def test_the_weight_is_that_of_one_independent_sample(shape, records, monkeypatch):
    fitted, problem = problem_at_first_guess(shape, records)
    time = np.arange(SAMPLES)
    sines = np.stack([0.3 * np.sin(2.0 * np.pi * k * time / SAMPLES) for k in (3, 50)])
    monkeypatch.setattr(error_problem, "_errors", lambda problem, unit: sines)
    found = fits._first_guess(fitted, problem, fitted.starts[0])
    np.testing.assert_array_equal(found.known, fitted.starts[0])
    # A sine has one line: two independent numbers, its sine and its cosine.
    rms, independent = 0.3 / np.sqrt(2.0), 2 * 2
    # Typical distances as shares of the bounds: weights from 0 to 1 slope, gains +-0.1.
    spread = np.array([TYPICAL] * 30 + [0.01 / 0.2] * 4)
    held = [path in VAGUE for path in fitted.space.paths]
    np.testing.assert_allclose(
        found.weights[held], rms / (spread * np.sqrt(independent))
    )
    assert not found.weights[np.logical_not(held)].any()
    white = np.random.default_rng(0).standard_normal((2, SAMPLES))
    monkeypatch.setattr(error_problem, "_errors", lambda problem, unit: white)
    found = fits._first_guess(fitted, problem, fitted.starts[0])
    # The lines of white noise differ by chance: half as many count.
    assert found.weights.max() == pytest.approx(
        1.0 / (TYPICAL * np.sqrt(SAMPLES)), rel=0.1
    )


def test_a_prior_never_grows():
    spread = np.array([0.5, np.inf])
    none, first, later = (Prior(np.zeros(2), spread, s) for s in (0.0, 1.5, 2.5))
    np.testing.assert_array_equal(first.weights, [3.0, 0.0])
    np.testing.assert_array_equal(fits._lighter(none, later).weights, later.weights)
    np.testing.assert_array_equal(fits._lighter(first, later).weights, first.weights)
    np.testing.assert_array_equal(fits._lighter(later, first).weights, first.weights)


@pytest.fixture(scope="module")
def optimum(shape, records):
    return fits.output_error(shape, records, slice(0, SAMPLES), steps=40)


def distance(optimum, shape):
    """Return the largest distance of a gain from its first guess, in the box.

    The two slowest exponentials, of 0.19 and 0.8 s, take longer than the cycles.
    """
    fitted = shape.without(shape.own)
    gains = [path in VAGUE[-2:] for path in fitted.space.paths]
    return np.abs(optimum.units[0] - fitted.starts[0])[gains].max()


def test_gains_of_creep_that_is_not_seen_stay_near_the_first_guess(
    optimum, shape, records
):
    free = fits.output_error(
        shape._replace(vague={}), records, slice(0, SAMPLES), steps=40
    )
    assert 5.0 * distance(optimum, shape) < distance(free, shape)
    assert optimum.losses[0] < 1.2 * free.losses[0]


def test_the_prior_follows_the_errors_until_they_settle():
    records = [record_of(8.0, 1, QUIET), record_of(14.0, 2, QUIET)]
    shape, part = structure(MODEL, records[0], beside=records[1:]), slice(0, SAMPLES)
    # The errors of the first fit are far above the noise: their prior is too heavy.
    early, settled = (
        fits.output_error(shape, records, part, steps=40, **passes).losses[0]
        for passes in ({"passes": 3}, {})
    )
    assert settled < 0.5 * early


def test_the_errors_are_those_of_the_records_alone(optimum):
    assert not np.asarray(optimum.problem.prior.weights).any()
    _, errors = values_and_errors(optimum)
    paths = optimum.problem.space.paths
    found = dict(zip(paths, errors, strict=True))
    # Without the prior the records tell less than it assumes about some gains.
    widths = np.asarray(optimum.problem.space.upper - optimum.problem.space.lower)
    assumed = 0.02 * widths[paths.index("creep.gains.3")]
    assert found["creep.gains.3"] is None or found["creep.gains.3"] > assumed
