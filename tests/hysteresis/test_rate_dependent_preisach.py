import jax
import numpy as np
import pytest
from oracles import preisach as oracle

from piezojax import (
    simulate,
)
from piezojax.hysteresis import (
    Preisach,
    RateDependentPreisach,
)

LOW, HIGH, LOWEST, REST = 0.0, 80.0, 0.4, 20.0
DT, RATE = 1e-3, 5e3
SLOW = np.tril([[0.3] * 4, [0.2] * 4, [0.5] * 4, [0.1] * 4])
FAST = np.tril([[0.1] * 4, [0.4] * 4, [0.2] * 4, [0.3] * 4])


def model(rate=RATE, rest=REST):
    return RateDependentPreisach(
        Preisach(SLOW, LOW, HIGH, LOWEST, rest), FAST, rate, DT
    )


@jax.jit
def response(system, inputs):
    return simulate(system, inputs, system.init(inputs[0]))[1]


def test_the_output_equals_relays_with_rate_dependent_weights():
    # multiples of 5 V; the thresholds of the relays lie between them
    x = 5.0 * np.random.default_rng(1).integers(-2, 19, 100)
    rate = np.diff(x, prepend=x[0]) / DT / RATE
    share = rate**2 / (1.0 + rate**2)
    assert share.min() == 0.0
    assert share.max() > 0.8
    slow, fast = (oracle.along(w, LOW, HIGH, 4, x, REST) for w in (SLOW, FAST))
    expected = LOWEST + (1.0 - share) * slow + share * fast
    np.testing.assert_allclose(response(model(), x), expected, rtol=0, atol=1e-12)


def test_slow_and_fast_inputs_have_the_two_densities():
    x = np.random.default_rng(2).uniform(LOW, HIGH, 100)
    for rate, weights in ((1e12, SLOW), (1e-6, FAST)):
        plain = response(Preisach(weights, LOW, HIGH, LOWEST, REST), x)
        found = response(model(rate), x)
        moving = np.diff(x, prepend=x[0]) != 0.0
        np.testing.assert_allclose(found[moving], plain[moving], rtol=0, atol=1e-9)


def test_at_rest_the_slow_density_applies():
    system = model()
    state = system.init(33.0)
    after, output = system.step(state, 33.0)
    np.testing.assert_array_equal(after, state)
    np.testing.assert_allclose(output, system.slow.step(state, 33.0)[1], rtol=0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fast_weights": np.eye(3)}, "fast_weights have 3 cells per side; .* have 4"),
        ({"fast_weights": -np.eye(4)}, "fast_weights in um is"),
        ({"rate": 0.0}, "rate in V/s is 0; it must be finite and above 0"),
        ({"dt": 0.0}, "dt in s is 0"),
    ],
)
def test_bad_parameters(changes, message):
    good = {
        "slow": Preisach(SLOW, LOW, HIGH),
        "fast_weights": FAST,
        "rate": RATE,
        "dt": DT,
    }
    with pytest.raises(ValueError, match=message):
        RateDependentPreisach(**(good | changes))
