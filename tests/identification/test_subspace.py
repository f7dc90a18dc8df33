"""Chapter 6: the Hankel-Toeplitz regression, its prior and the realisation."""

import numpy as np
import pytest
from oracles import state_space as oracle
from scipy import linalg

from piezojax import (
    Record,
)
from piezojax.catalog import p558
from piezojax.dynamics import stacked
from piezojax.identification.estimators import subspace

DT = p558.DT
SAMPLES = 5000
P = 20


def matrices(model):
    return tuple(np.asarray(getattr(model, name)) for name in "ABCD")


def chirp(channel):
    """Return a chirp of 1 to 100 Hz in 10 s: 20 um around 20 um, or 200 urad."""
    time = np.arange(SAMPLES) * DT
    wave = np.sin(2.0 * np.pi * (time + 99.0 / 20.0 * time**2))
    return 20.0 + 20.0 * wave if channel == 0 else 200.0 * wave


def measured(model, input, seed=None):
    A, B, C, D = matrices(model)
    rest = np.linalg.solve(np.eye(len(A)) - A, B[:, 0] * input[0])
    outputs = oracle.simulate(A, B, C, D, input[:, None], rest)
    if seed is not None:
        noise = np.random.default_rng(seed).standard_normal(outputs.shape)
        outputs = outputs + noise * p558.NOISE_RMS
    return Record(input, outputs, model.dt, "um", p558.UNITS, source="made up")


def true_markov(model, count):
    return oracle.markov(*matrices(model)[:3], count)


def distance(found, true):
    return np.linalg.norm(found - true) / np.linalg.norm(true)


def rows(seed=0, count=400):
    draw = np.random.default_rng(seed).standard_normal
    X, theta = draw((count, 7)), draw((3, 7))
    return X, X @ theta.T + 0.1 * draw((count, 3)), theta


def test_rows_hold_past_input_past_output_and_coming_input():
    input, outputs = np.arange(9.0), np.arange(18.0).reshape(9, 2) + 100.0
    X, Y = subspace.regression(input, outputs, 2)
    assert X.shape == (6, 8)
    assert Y.shape == (6, 4)
    for row, k in enumerate(range(2, 8)):
        expected = [
            *input[k - 2 : k], *outputs[k - 2 : k].ravel(), *input[k : k + 2]
        ]  # fmt: skip
        np.testing.assert_array_equal(X[row], expected)
        np.testing.assert_array_equal(Y[row], outputs[k : k + 2].ravel())


def test_the_regression_holds_for_a_model_without_noise():
    model = p558.channels("7")[0]
    record = measured(model, np.random.default_rng(1).standard_normal(600))
    X, Y = subspace.regression(record.input, record.outputs, 8)
    theta = subspace.least_squares(X, Y)
    np.testing.assert_allclose(X @ theta.T, Y, atol=1e-9)
    found = subspace.markov_parameters(theta, 8)
    np.testing.assert_allclose(found, true_markov(model, 23)[:, :, 0], atol=1e-8)


@pytest.mark.parametrize(("variance", "prior"), [(1.0, 10.0), (0.01, 1.0), (5.0, 0.1)])
def test_the_recursion_equals_ridge_regression(variance, prior):
    X, Y, _ = rows()
    theta, P = subspace.recursive(X, Y, variance, prior)
    at_once = subspace.maximum_a_posteriori(X, Y, variance, prior)
    np.testing.assert_allclose(theta, at_once, rtol=0, atol=1e-10)
    # Bayes: the covariance after all rows is the inverse of the information.
    information = np.eye(7) / prior + X.T @ X / variance
    np.testing.assert_allclose(P, np.linalg.inv(information), rtol=0, atol=1e-10)


def test_ridge_regression_equals_least_squares_with_prior_rows():
    X, Y, _ = rows()
    more = np.vstack([X, np.sqrt(0.5 / 2.0) * np.eye(7)])
    expected = linalg.lstsq(more, np.vstack([Y, np.zeros((7, 3))]))[0].T
    found = subspace.maximum_a_posteriori(X, Y, 0.5, 2.0)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)


def test_the_weight_of_the_prior_falls_with_more_rows():
    errors = []
    for count in (20, 200, 2000):
        X, Y, theta = rows(count=count)
        errors.append(distance(subspace.maximum_a_posteriori(X, Y, 1.0, 0.1), theta))
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.02


def test_the_realisation_has_the_given_markov_parameters():
    for model in p558.channels("6"):
        true = true_markov(model, 59)[:, :, 0]
        found, moved = subspace.realised(true, model.order, DT)
        assert moved == 0
        np.testing.assert_allclose(found.markov(59)[:, :, 0], true, atol=1e-9)
        np.testing.assert_allclose(
            np.sort_complex(found.poles()), np.sort_complex(model.poles()), atol=1e-6
        )


def test_singular_values_end_at_the_order():
    model = p558.channels("6")[1]
    values = subspace.hankel_singular_values(true_markov(model, 59)[:, :, 0])
    assert np.all(values[4:] < 1e-12 * values[0])
    assert subspace.order_at_gap(values, 10) == 4


def test_an_unstable_response_is_stabilised_with_a_note():
    growing = (1.05 ** np.arange(30.0))[:, None]
    model, moved = subspace.realised(growing, 1, DT)
    assert moved == 1
    assert model.poles()[0] == pytest.approx(1.0 / 1.05)


# The printed stage, from noisy chirps


@pytest.fixture(scope="module")
def fits():
    def of(chapter):
        return [
            subspace.identify_channel(measured(model, chirp(i), i), P, model.order)
            for i, model in enumerate(p558.channels(chapter))
        ]

    return {chapter: of(chapter) for chapter in p558.MODELS}


@pytest.mark.parametrize("chapter", p558.MODELS)
def test_the_printed_stage_is_recovered(fits, chapter):
    for fit, true in zip(fits[chapter], p558.channels(chapter), strict=True):
        assert distance(fit.model.markov(3 * P), true_markov(true, 3 * P)) <= 0.05
        assert not any("reflected" in note for note in fit.notes)
    whole, true = stacked([fit.model for fit in fits[chapter]]), p558.model(chapter)
    assert whole.order == true.order
    assert np.abs(whole.poles()).max() < 1.0
    assert distance(whole.markov(3 * P), true_markov(true, 3 * P)) <= 0.05


@pytest.mark.parametrize("channel", range(3))
def test_without_a_prior_a_noisy_chirp_is_not_enough(fits, channel):
    true = p558.channels("7")[channel]
    record = measured(true, chirp(channel), channel)
    free = subspace.identify_channel(record, P, true.order, subspace.least_squares)
    exact = true_markov(true, 3 * P)
    assert distance(fits["7"][channel].model.markov(3 * P), exact) < 0.1 * distance(
        free.model.markov(3 * P), exact
    )


def test_undetermined_directions_have_a_note():
    model, draw = p558.channels("7")[0], np.random.default_rng(3)
    rich = measured(model, draw.standard_normal(1000))
    assert subspace.identify_channel(rich, 5, 3).notes == ()
    sine = measured(model, np.sin(0.3 * np.arange(1000)), 1)
    (note,) = subspace.identify_channel(sine, 5, 3).notes
    assert note.startswith("the input excites 2 of the 10 directions of 10 samples")


def test_a_projection_has_a_note():
    model, steps = p558.channels("7")[0], np.random.default_rng(3).standard_normal(500)
    record = measured(model, steps)

    def growing(X, Y):
        # h(s) = 1.1^s from H0 = Gamma and H1 = Phi H0, for p = 2 and q = 3.
        gamma = np.kron(1.1 ** np.array([[1, 0], [2, 1]]), np.ones((3, 1)))
        return np.hstack([gamma, 1.21 * np.eye(6), np.zeros((6, 2))])

    fit = subspace.identify_channel(record, 2, 1, growing)
    assert fit.notes == ("1 of 1 poles lay outside the unit circle and were reflected",)
    assert fit.model.poles()[0] == pytest.approx(1.0 / 1.1)


def test_any_estimate_can_be_used(fits):
    true = p558.channels("7")[0]
    record = measured(true, chirp(0)[:1500], 0)

    def recursion(X, Y):
        return subspace.recursive(X, Y, 1.0, 10.0)[0]

    found, expected = (
        subspace.identify_channel(record, 8, 3, estimate).markov
        for estimate in (recursion, subspace.PRIOR)
    )
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8)


def test_simulation_errors_equal_those_of_a_plain_loop(fits):
    model, true = fits["7"][0].model, p558.channels("7")[0]
    record = measured(true, chirp(0)[:800], 5)
    A, B, C, D = matrices(model)
    rest = np.linalg.solve(np.eye(len(A)) - A, B[:, 0] * record.input[0])
    error = oracle.simulate(A, B, C, D, record.inputs, rest) - record.outputs
    np.testing.assert_allclose(
        subspace.simulation_errors(model, record),
        np.sqrt(np.mean(error**2, axis=0)),
        rtol=1e-9,
    )


def test_p_and_order_are_chosen_on_another_record():
    true = p558.channels("6")[1]
    train, validate = measured(true, chirp(1), 1), measured(true, chirp(1)[::-1], 2)
    orders, ps = (1, 2, 3, 4, 6), (4, 8, 20)
    choice = subspace.choose(train, validate, ps, orders)
    assert choice.errors.shape == (3, 5)
    best = choice.errors[ps.index(choice.p), orders.index(choice.order)]
    assert best <= 1.1 * choice.errors.min() < 0.002
    smaller = choice.errors[:, : orders.index(choice.order)]
    assert np.all(smaller > 1.1 * choice.errors.min())
    model = subspace.identify_channel(train, choice.p, choice.order).model
    errors = subspace.simulation_errors(model, validate)
    expected = np.linalg.norm(errors) / validate.spans.max()
    assert best == pytest.approx(expected, rel=1e-9)
    np.testing.assert_array_equal(np.isinf(choice.errors[0]), [False] * 4 + [True])


# Refused input


@pytest.mark.parametrize(
    ("p", "order", "message"),
    [
        (0, 3, "p is 0; 5000 samples allow 1..1250"),
        (1300, 3, "p is 1300; 5000 samples allow"),
        (4, 6, "order is 6; 11 Markov parameters allow 1..5"),
        (4, 0, "order is 0; 11 Markov"),
    ],
)
def test_bad_sizes_are_refused(p, order, message):
    record = measured(p558.channels("7")[1], chirp(1))
    with pytest.raises(ValueError, match=message):
        subspace.identify_channel(record, p, order)


def test_a_record_with_several_inputs_is_refused():
    draw = np.random.default_rng(0).standard_normal
    record = Record(draw((200, 2)), draw((200, 3)), DT, source="lab")
    with pytest.raises(ValueError, match="lab: the record has 2 inputs; it needs"):
        subspace.identify_channel(record, 4, 3)
