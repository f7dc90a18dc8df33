"""Periodic records: transfer matrix, noise, and the fitted model."""

import numpy as np
import pytest
from oracles import state_space as oracle
from scipy import signal

from piezojax import (
    Record,
)
from piezojax.identification.estimators.frequency import (
    empirical_response,
    periodic_errors,
)
from piezojax.identification.estimators.response_fit import fit_response

PERIOD, DT, NOISE = 256, 1e-3, 0.02
LINES = np.arange(1, 100)


def truth(inputs=2, outputs=3):
    """Return a stable system: two resonances and a real pole, with feedthrough."""
    poles = [0.97 * np.exp(0.6j), 0.95 * np.exp(1.5j)]
    blocks = [[[p.real, -p.imag], [p.imag, p.real]] for p in poles]
    A = np.zeros((5, 5))
    A[:2, :2], A[2:4, 2:4], A[4, 4] = *blocks, -0.7
    draw = np.random.default_rng(1).standard_normal
    return A, draw((5, inputs)), draw((outputs, 5)), 0.1 * draw((outputs, inputs))


def multisine(seed):
    """Return two channels with random phases on LINES."""
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, (LINES.size, 2))
    spectrum = np.zeros((PERIOD // 2 + 1, 2), complex)
    spectrum[LINES] = np.exp(1j * phases)
    return np.fft.irfft(spectrum, PERIOD, axis=0) * np.sqrt(PERIOD)


def measured(seed, noise=NOISE, periods=4, wait=4):
    matrices = truth()
    inputs = np.tile(multisine(seed), (wait + periods, 1))
    outputs = oracle.simulate(*matrices, inputs, np.zeros(5))
    outputs += noise * np.random.default_rng(100 + seed).standard_normal(outputs.shape)
    keep = slice(wait * PERIOD, None)
    return Record(inputs[keep], outputs[keep], DT, source=f"draw {seed}", period=PERIOD)


def exact(frequency):
    A, B, C, D = truth()
    z = np.exp(2j * np.pi * DT * frequency)
    return np.array([C @ np.linalg.solve(v * np.eye(5) - A, B) + D for v in z])


def test_without_noise_the_response_is_exact():
    found = empirical_response([measured(0, 0.0), measured(1, 0.0)])
    np.testing.assert_allclose(found.frequency, LINES / (PERIOD * DT), rtol=1e-12)
    np.testing.assert_allclose(found.response, exact(found.frequency), atol=1e-5)
    assert found.variance.max() < 1e-9


def test_as_many_records_as_inputs_give_the_ratio_of_spectra():
    records = [measured(0), measured(1)]
    U, Y = (
        np.stack([np.fft.rfft(x.reshape(4, PERIOD, -1).mean(0), axis=0) for x in side])
        for side in zip(*((r.inputs, r.outputs) for r in records), strict=True)
    )
    expected = [Y[:, k].T @ np.linalg.inv(U[:, k].T) for k in LINES]
    found = empirical_response(records, [1.0, 7.0])
    np.testing.assert_allclose(found.response, expected, rtol=1e-7, atol=1e-9)


def test_the_variance_equals_that_over_noise_draws():
    quotients = []
    for draw in range(30):
        records = [measured(0), measured(1), measured(2)]
        noise = np.random.default_rng(1000 + draw).standard_normal
        records = [
            Record(
                r.inputs, r.outputs + NOISE * noise(r.outputs.shape), DT, period=PERIOD
            )
            for r in records
        ]
        quotients.append(empirical_response(records, [1.0, 2.0, 0.5]))
    scatter = np.var([q.response for q in quotients], axis=0, ddof=1)
    # Each record already has noise, so half of the variance is that of the added noise.
    predicted = np.mean([q.variance for q in quotients], axis=0) / 2.0
    assert np.median(scatter / predicted) == pytest.approx(1.0, abs=0.1)
    assert np.mean(scatter) == pytest.approx(np.mean(predicted), rel=0.1)


def test_weights_favour_the_better_record():
    clean, noisy = [measured(0, 0.0), measured(1, 0.0)], [measured(2), measured(3)]
    even = empirical_response([*clean, *noisy])
    favoured = empirical_response([*clean, *noisy], [1e4, 1e4, 1.0, 1.0])
    true = exact(even.frequency)
    error = [np.linalg.norm(r.response - true) for r in (even, favoured)]
    assert error[1] < 0.1 * error[0]


def test_input_power_converts_a_response_error_to_an_output_error():
    records = [measured(seed, 0.0) for seed in range(3)]
    found = empirical_response(records)
    change = 0.3 * found.response
    predicted = 2.0 * np.einsum(
        "lij,ljk,lik->", change, found.power, change.conj()
    ).real  # fmt: skip
    # An error of 30 % of the response is 30 % of the output in each record.
    left = sum(np.sum(np.mean((0.3 * r.outputs) ** 2, axis=0)) for r in records)
    assert predicted == pytest.approx(left, rel=1e-6)


@pytest.fixture(scope="module")
def fit():
    return fit_response(
        empirical_response([measured(seed) for seed in range(4)]), 5, rows=6
    )


def test_a_known_model_is_found(fit):
    expected = np.sort_complex(np.linalg.eigvals(truth()[0]))
    np.testing.assert_allclose(np.sort_complex(fit.model.poles()), expected, atol=2e-3)
    frequency = np.linspace(1.0, 480.0, 200)
    found = np.asarray(fit.model.frequency_response(frequency))
    true = exact(frequency)
    assert np.linalg.norm(found - true) < 0.005 * np.linalg.norm(true)
    assert fit.moved == 0


def test_the_descent_lowers_the_cost_to_the_noise(fit):
    assert np.all(np.diff(fit.costs) < 0.0)
    # averages of 4 periods; 2 x 99 of 256 noise lines are in the band of the fit
    left = 4 * 3 * NOISE**2 / 4 * (2 * LINES.size / PERIOD)
    # 4 records of 2 inputs: half of their noise is already in the response.
    assert fit.costs[-1] == pytest.approx(left / 2, rel=0.15)


def test_singular_values_drop_after_the_order(fit):
    ratios = fit.singular_values[1:] / fit.singular_values[:-1]
    assert np.argmin(ratios[:12]) == 4


def test_periodic_errors_equal_those_of_scipy(fit):
    records = [measured(7), measured(8)]
    model = [np.asarray(getattr(fit.model, name)) for name in "ABCD"]
    found = periodic_errors(fit.model, records)
    assert found.shape == (2, 4, 3)
    for record, errors in zip(records, found, strict=True):
        inputs = np.vstack([record.inputs[:PERIOD], record.inputs])
        _, outputs, _ = signal.dlsim((*model, DT), inputs)
        error = (outputs[PERIOD:] - record.outputs).reshape(4, PERIOD, 3)
        np.testing.assert_allclose(errors, np.sqrt(np.mean(error**2, axis=1)))
    assert np.mean(found) == pytest.approx(NOISE, rel=0.05)


@pytest.mark.parametrize("order", [1, 7])
def test_any_order_gives_a_stable_model_of_that_order(order):
    data = empirical_response([measured(seed) for seed in range(2)])
    fit = fit_response(data, order, rows=6, steps=2)
    assert fit.model.order == order
    assert np.abs(fit.model.poles()).max() < 1.0


# Refused input


def record(**changes):
    draw = np.random.default_rng(0).standard_normal
    plain = {
        "inputs": draw((200, 1)),
        "outputs": draw((200, 1)),
        "dt": DT,
        "source": "lab",
        "period": 100,
    }
    return Record(**(plain | changes))


@pytest.mark.parametrize(
    ("records", "weights", "message"),
    [
        ([], None, "there are no records"),
        ([record(period=None)], None, "lab: the record needs a period, in samples"),
        ([record(period=101)], None, "200 samples hold less than two periods of 101"),
        ([record(), record(period=50)], None, "records differ in .period, sample time"),
        ([record(), record(dt=2e-3)], None, "records differ in"),
        ([record(inputs=np.eye(200)[:, :2])], None, "1 records for 2 inputs; there"),
        ([record()], [0.0], "weights are .0.0.; they must be 1 positive numbers"),
        ([record()], [1.0, 1.0], "they must be 1 positive numbers"),
    ],
)
def test_bad_records_are_refused(records, weights, message):
    with pytest.raises(ValueError, match=message):
        empirical_response(records, weights)


def test_dependent_inputs_are_refused():
    with pytest.raises(ValueError, match=r"inputs are not independent at 3\.9.* Hz"):
        empirical_response([measured(0), measured(0)])


@pytest.mark.parametrize("order", [0, 18])
def test_bad_orders_are_refused(order):
    data = empirical_response([measured(0), measured(1)])
    with pytest.raises(ValueError, match=rf"order is {order}; .* must lie in 1\.\.17"):
        fit_response(data, order, rows=6)


def test_too_few_lines_are_refused():
    data = empirical_response([measured(0), measured(1)])
    message = "99 lines are too few for 80 block rows; take 79 or fewer"
    with pytest.raises(ValueError, match=message):
        fit_response(data, 5, rows=80)
