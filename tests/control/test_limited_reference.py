"""A controller with a limited slew of its reference against a NumPy loop."""

import jax
import numpy as np
import pytest
from oracles import control as oracle

from piezojax.control import PID, LimitedReference
from piezojax.core.feedback import Observation

DT, SLEW = 1e-3, 40.0
GAINS = {"P": 0.5, "I": 30.0, "D": 0.0, "derivative_filter": 1e-2, "anti_windup": 50.0}
MEASURED = np.random.default_rng(4).normal(size=300)


def pid():
    return PID(*GAINS.values(), dt=DT)


@jax.jit
def run(controller, reference):
    """Return the commands of ``controller``, which are applied without limits."""

    def step(state, input):
        inner, applied = state
        reference, following, measured = input
        seen = Observation(reference, following, measured, applied)
        inner, command = controller.step(inner, seen)
        return (inner, command), command

    start = controller.init(Observation(*[reference[0]] * 3, 0.0))
    signals = reference[:-1], reference[1:], MEASURED[: len(reference) - 1]
    return jax.lax.scan(step, (start, 0.0), signals)[1]


def limited(reference):
    """Return ``reference`` with changes of at most SLEW DT per sample."""
    found = [reference[0]]
    for wanted in reference[1:]:
        found.append(found[-1] + np.clip(wanted - found[-1], -SLEW * DT, SLEW * DT))
    return np.array(found)


def test_the_controller_sees_jumps_as_ramps():
    wanted = np.r_[np.full(20, 1.0), np.full(150, 3.0), np.full(100, 2.5)]
    seen = limited(wanted)
    # The ramp takes 2 um / (40 um/s) = 50 samples.
    assert seen[19] == 1.0 < seen[20] < seen[68] < 3.0 == pytest.approx(seen[70])
    plain, expected, before = oracle.PID(GAINS, 1.0 / DT), [], seen[0]
    for k in range(len(seen) - 1):
        expected.append(plain.step(MEASURED[k], None, seen[k], before))
        plain.applied(expected[-1])
        before = seen[k]
    found = run(LimitedReference(pid(), SLEW, DT), wanted)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-10)


def test_references_below_the_slew_pass_as_they_are():
    reference = 2.0 * np.sin(0.9 * SLEW / 2.0 * DT * np.arange(300))
    found = run(LimitedReference(pid(), SLEW, DT), reference)
    np.testing.assert_array_equal(found, run(pid(), reference))


def test_a_slew_of_zero_is_refused():
    with pytest.raises(ValueError, match="slew"):
        LimitedReference(pid(), 0.0, DT)
