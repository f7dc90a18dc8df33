"""Output of a chain of parts, against a loop over samples."""

import jax.numpy as jnp
import numpy as np
from oracles import hysteresis as oracle

from piezojax import (
    Record,
)
from piezojax.core.paths import replace
from piezojax.identification import free_run
from piezojax.identification.chain import structure

DT = 0.02
SAMPLES = 1000


def excitation():
    """Return six tones over a decade and a half, then 4 s of rest."""
    time = DT * np.arange(SAMPLES)
    level = np.select([time < 5.0, time < 10.0], [1.0, 0.6], 0.8)
    u = 50.0 - 50.0 * level * np.cos(2.0 * np.pi * (0.2 + 0.06 * time) * time)
    u[800:] = u[800]
    u[0] = 0.0
    return u


INPUT = excitation()


def test_the_chain_equals_the_equations_of_its_parts():
    # plays with the thresholds of the fit, increased by the rate; one damped spring
    weights, growth, stiffness, time_constant = np.full(10, 0.004), 0.04, 12.0, 2.0
    shape = structure(
        "rate_dependent_prandtl_ishlinskii+spring_damper_creep",
        Record(INPUT, 0.12 * INPUT, DT),
    )
    thresholds = 0.5 * np.ptp(INPUT) / 11.0 * np.arange(1, 11)
    plays = oracle.rate_dependent_plays(INPUT, thresholds, growth, DT, 0.0)
    slow, y = 0.0, [0.0]
    for f in 0.08 * INPUT + plays @ weights:
        slow += (1.0 - np.exp(-DT / time_constant)) * (f / stiffness - slow)
        y.append(f + slow)
    truth = {
        "hysteresis.polynomial.0": 0.08,
        **{f"hysteresis.weights.{i}": w for i, w in enumerate(weights)},
        "hysteresis.growth": growth,
        "hysteresis.rest_input": 0.0,
        "creep.stiffness.0": stiffness,
        "creep.damping.0": stiffness * time_constant,
        "creep.stiffness.1": np.inf,
        "creep.stiffness.2": np.inf,
        "calibration.offset": 0.0,
    }
    system = replace(shape.system, truth)
    found = free_run(system, jnp.asarray(INPUT), 0.0)
    np.testing.assert_allclose(found, y[:-1], atol=1e-9)
    assert set(truth) <= set(shape.space.paths)
