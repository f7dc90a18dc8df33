"""Plays that are wider than the cycles of the records, and move only beyond them."""

import itertools

import numpy as np
import pytest
from oracles import hysteresis as oracle

import piezojax as pj
from piezojax.identification.chain import structure

DT, SAMPLES, NOISE = 1e-3, 600, 2e-3
MODEL = "prandtl_ishlinskii+lag"
PLAYS = ((8.0, 0.02), (20.0, 0.01), (32.0, 0.02), (44.0, 0.08))
"""Half-widths (V) and slopes (um/V): the last one never moves in a cycle of 80 V."""


def record_of(levels, zero, seed):
    """Return a record after a motion from 0 V over ``levels``: small, then all.

    The input reaches first 70 and 30 V, then 90 and 10 V.
    """
    time = DT * np.arange(SAMPLES)
    height = np.where(time < 0.3, 20.0, 40.0)
    u = 50.0 - height * np.cos(2.0 * np.pi * 10.0 * time)
    ends = (0.0, *levels, u[0])
    before = np.concatenate(
        [np.linspace(*pair, 200) for pair in itertools.pairwise(ends)]
    )
    path = np.concatenate([before, u])
    motion = 0.2 * path + sum(w * oracle.play(path, r, 0.0) for r, w in PLAYS)
    y = motion[before.size - 1 : -1]  # a voltage acts on the next sample
    noise = NOISE * np.random.default_rng(seed).standard_normal(SAMPLES)
    return pj.Record(u, y + zero + noise, DT, source=str(levels))


@pytest.fixture(scope="module")
def records():
    return [record_of((-5.0,), 3.0, 1), record_of((30.0, 105.0), -2.0, 2)]


def test_only_records_with_motions_before_them_have_wide_plays(records):
    one = structure(MODEL, records[0]).system.parts[0]
    several = structure(MODEL, records[0], beside=records[1:]).system.parts[0]
    assert max(one.thresholds) < 0.5 * 80.0
    # Motions before the records may have been 1.4 times as wide as those in them.
    assert 0.6 * 80.0 < max(several.thresholds) < 0.7 * 80.0
    # Those of several records are half as far apart.
    np.testing.assert_allclose(one.thresholds, several.thresholds[1:21:2])
    np.testing.assert_allclose(np.sum(one.weights), np.sum(several.weights[:21]))


def test_a_play_that_moves_once_in_each_record_is_found(records):
    third = record_of((80.0, 20.0, 102.0), 1.0, 3)
    whole = slice(0, SAMPLES)
    fit = pj.identify(records, MODEL, train=whole, validate=whole)
    hysteresis = fit.system.parts[0]
    wide = sum(
        w
        for r, w in zip(hysteresis.thresholds, hysteresis.weights, strict=True)
        if r > 40.0
    )
    assert wide == pytest.approx(0.08, rel=0.3)
    # The first cycles do not tell the state of the wide plays from the zero.
    found = pj.validate(fit.system, fit.about, third, estimate=slice(0, 450))
    (check,) = found.report.records
    assert check.percent_of_span < 0.3
