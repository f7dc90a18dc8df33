"""Hysteresis and logarithmic creep, separated in records made without the package."""

import jax.numpy as jnp
import numpy as np
import pytest
from oracles import hysteresis as oracle

from piezojax import (
    Record,
    identify,
)
from piezojax.identification import free_run

DT = 0.2
HYSTERESIS = (0.0077, 0.1167, -0.0487)
PER_DECADE, FASTEST = 0.02, 0.1
"""Creep of a step h of the hysteresis: 0.02 h log10(1 + t / 0.1 s)."""
NOISE = 2e-3
MODEL = "coleman_hodgdon+logarithmic_creep"
TRAIN, SAMPLES = 800, 1200
HELD = slice(830, 1200)  # the last hold, which no fit uses


def made(u, seed):
    """Return noise-free output, its hysteresis, and the record, from rest at 0 V."""
    h = oracle.exact(u, *HYSTERESIS)
    steps = np.diff(h, prepend=0.0)
    time = DT * np.arange(1, u.size + 1)
    # Each step of h at sample j creeps from then on: the law as a sum over all steps.
    creep = np.convolve(steps, PER_DECADE * np.log10(1.0 + time / FASTEST))[: u.size]
    y = np.concatenate([[0.0], (h + creep)[:-1]])  # u(k) acts on y(k+1)
    noise = NOISE * np.random.default_rng(seed).standard_normal(u.size)
    return y, h, Record(u, y + noise, DT, source=f"made {seed}")


def reached(targets):
    """Return voltages from 0 V to each target in turn, at most 3 V per sample."""
    u = [0.0]
    for target in targets[1:]:
        u.append(u[-1] + np.clip(target - u[-1], -3.0, 3.0))
    return np.array(u)


def step_and_hold():
    return reached(np.repeat([60.0, 20.0, 80.0, 35.0, 70.0, 70.0], 200))


def random_walk_and_hold():
    walk = np.random.default_rng(8).normal(size=SAMPLES).cumsum()
    targets = 45.0 + 35.0 * np.sin(0.08 * walk)
    targets[300:420] = targets[300]
    targets[TRAIN:] = 15.0
    return reached(targets)


INPUTS = {"steps": step_and_hold(), "walk": random_walk_and_hold()}
TRUTH = {name: made(u, seed) for seed, (name, u) in enumerate(INPUTS.items())}


@pytest.fixture(scope="module")
def fit():
    records = [record for _, _, record in TRUTH.values()]
    return identify(
        records, MODEL, train=slice(0, TRAIN), validate=slice(TRAIN, SAMPLES)
    )


def test_the_hysteresis_is_recovered(fit):
    hysteresis = fit.system.parts[0]
    found = free_run(hysteresis, jnp.asarray(INPUTS["walk"]), 0.0)[1:]
    h = TRUTH["walk"][1][:-1]
    # The laws divide a step differently in its first second, so the scale is free.
    scale = np.polyfit(found, h, 1)[0]
    assert scale == pytest.approx(1.0, abs=0.03)
    assert np.std(scale * np.asarray(found) - h) < 0.003 * np.ptp(h)
    for path, value in zip("abc", HYSTERESIS, strict=True):
        found = fit.report.parameters[f"hysteresis.{path}"].value
        assert found == pytest.approx(value, rel=0.05)


def test_the_creep_is_recovered(fit):
    found = fit.report.parameters["creep.gain_per_decade"].value
    assert found == pytest.approx(PER_DECADE, rel=0.05)


@pytest.mark.parametrize("row", [0, 1], ids=INPUTS)
def test_an_unseen_hold_is_predicted_within_a_twentieth_of_its_creep(fit, row):
    y = list(TRUTH.values())[row][0][HELD]
    found = fit.simulations[row][HELD, 0]
    creep = abs(y[-1] - y[0])
    assert creep > 10.0 * NOISE
    assert np.max(np.abs((found - found[0]) - (y - y[0]))) < 0.05 * creep


def test_without_the_creep_part_the_hold_is_not_predicted(fit):
    y = TRUTH["walk"][0][HELD]
    found = free_run(fit.system.parts[0], jnp.asarray(INPUTS["walk"]), 0.0)[HELD]
    assert abs(found[-1] - found[0]) < 0.05 * abs(y[-1] - y[0])
    assert fit.report.validation.rmse == pytest.approx(NOISE, rel=0.25)
