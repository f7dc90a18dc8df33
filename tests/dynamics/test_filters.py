"""Filters against the discretisations of SciPy, with gradients up to Nyquist."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from piezojax import simulate
from piezojax.dynamics import (
    Biquad,
    FirstOrderLeadLag,
    HighPass,
    LowPass,
    Notch,
    SecondOrderLowPass,
)
from piezojax.dynamics.filters import KINDS, METHODS

DT = 5e-5
NYQUIST = 0.5 / DT
SHARES = (1e-6, 1e-3, 0.2, 0.5, 0.9, 0.999)
"""Frequencies as shares of the Nyquist frequency."""


def filters(frequency, method="bilinear", orders=(1, 2, 3, 4)):
    named = {"discretisation": method}
    found: dict[str, Any] = {
        "second order": SecondOrderLowPass(frequency, 0.4, DT, **named),
        "overdamped": SecondOrderLowPass(frequency, 1.7, DT, **named),
        "critical": SecondOrderLowPass(frequency, 1.0, DT, **named),
        "lead": FirstOrderLeadLag(0.4 * frequency, frequency, DT, **named),
        "lag": FirstOrderLeadLag(frequency, 0.6 * frequency, DT, **named),
        "biquad": Biquad(0.7 * frequency, 0.02, frequency, 0.6, DT, **named),
        "real zeros": Biquad(0.7 * frequency, 1.4, frequency, 0.6, DT, **named),
        "notch": Notch(frequency, 0.3, 0.05, DT, **named),
        "full notch": Notch(frequency, 0.3, 0.0, DT, **named),
    }
    for kind, order in itertools.product(KINDS, orders):
        found[f"low-pass, {kind}, {order}"] = LowPass(
            frequency, DT, order, kind, **named
        )
        found[f"high-pass, {kind}, {order}"] = HighPass(
            frequency, DT, order, kind, **named
        )
    return found


NAMES = tuple(filters(1.0))


def warped(frequency):
    return 2.0 / DT * np.tan(np.pi * frequency * DT)


def sections(name, frequency, place):
    """Return coefficients of s of each continuous section; ``place`` gives rad/s."""
    w, v, u = place(frequency), place(0.7 * frequency), place(0.6 * frequency)
    if "pass" not in name:
        over, under = {
            "second order": ([1.0], [1.0 / w**2, 0.8 / w, 1.0]),
            "overdamped": ([1.0], [1.0 / w**2, 3.4 / w, 1.0]),
            "critical": ([1.0], [1.0 / w**2, 2.0 / w, 1.0]),
            "lead": ([1.0 / place(0.4 * frequency), 1.0], [1.0 / w, 1.0]),
            "lag": ([1.0 / w, 1.0], [1.0 / u, 1.0]),
            "biquad": ([1.0 / v**2, 0.04 / v, 1.0], [1.0 / w**2, 1.2 / w, 1.0]),
            "real zeros": ([1.0 / v**2, 2.8 / v, 1.0], [1.0 / w**2, 1.2 / w, 1.0]),
            "notch": ([1.0 / w**2, 0.03 / w, 1.0], [1.0 / w**2, 0.6 / w, 1.0]),
            "full notch": ([1.0 / w**2, 0.0, 1.0], [1.0 / w**2, 0.6 / w, 1.0]),
        }[name]
        return [(over, under)]
    passed, kind, order = name.split(", ")
    order = int(order)
    spread = np.sqrt(2.0 ** (1.0 / order) - 1.0)
    if kind == "butterworth":
        poles = w * scipy.signal.buttap(order)[1]
    else:
        poles = np.full(order, -w / spread if passed == "low-pass" else -w * spread)
    pairs = poles[poles.imag > 1e-9 * w] if kind == "butterworth" else poles[::2]
    pairs = pairs[: order // 2]
    found = [
        ([1.0], [1.0 / abs(p) ** 2, -2.0 * p.real / abs(p) ** 2, 1.0]) for p in pairs
    ]
    if order % 2:
        (single,) = (p.real for p in poles[np.abs(poles.imag) < 1e-9 * w][:1])
        found.append(([1.0], [-1.0 / single, 1.0]))
    if passed == "high-pass":
        found = [([a[0], *[0.0] * (len(a) - 1)], a) for _, a in found]
    return found


def bilinear(over, under):
    return scipy.signal.bilinear(over, under, 1.0 / DT)


def hold(over, under):
    b, a, _ = scipy.signal.cont2discrete((over, under), DT, "zoh")
    return b[0], a


def matched(over, under):
    zeros, poles = (np.exp(np.roots(c) * DT) for c in (over, under))
    zeros = np.r_[zeros, np.full(len(poles) - len(zeros), -1.0)]
    b, a = np.real(np.poly(zeros)), np.real(np.poly(poles))
    at = -1.0 if over[-1] == 0.0 else 1.0
    wanted = over[0] / under[0] if over[-1] == 0.0 else 1.0
    return b * wanted * np.polyval(a, at) / np.polyval(b, at), a


ORACLES = {"bilinear": bilinear, "hold": hold, "matched": matched}


@jax.jit
def response(system, inputs, start):
    return simulate(system, inputs, system.init(start))[1]


def responses(shares, inputs, start, method):
    """Return the outputs [shares, samples] by name; one program for all filters."""

    @jax.jit
    @jax.vmap
    def every(share):
        systems = filters(share * NYQUIST, method)
        return {name: response(one, inputs, start) for name, one in systems.items()}

    return every(np.asarray(shares))


@pytest.mark.parametrize("method", METHODS)
def test_a_filter_equals_the_discretisation_of_its_equation(method):
    inputs = 2.0 + np.random.default_rng(3).normal(size=400)
    place = warped if method == "bilinear" else lambda f: 2.0 * np.pi * f
    shares = (0.01, 0.2, 0.5, 0.9, 0.999)
    found = responses(shares, inputs, 2.0, method)
    for name, (number, share) in itertools.product(NAMES, enumerate(shares)):
        expected, rest = inputs, 2.0
        for over, under in sections(name, share * NYQUIST, place):
            b, a = ORACLES[method](over, under)
            zi = rest * scipy.signal.lfilter_zi(b, a)
            expected = scipy.signal.lfilter(b, a, expected, zi=zi)[0]
            rest = rest * np.sum(b) / np.sum(a)
        scale = np.max(np.abs(expected))
        np.testing.assert_allclose(
            found[name][number] / scale, expected / scale, rtol=0.0, atol=1e-10
        )


@pytest.mark.parametrize("share", [0.05, 0.8])
def test_filters_equal_the_designs_of_scipy(share):
    frequency = share * NYQUIST
    inputs = np.random.default_rng(4).normal(size=300)
    for (make, btype), order in itertools.product(
        ((LowPass, "low"), (HighPass, "high")), (1, 2, 4, 5, 8)
    ):
        design: Any = scipy.signal.butter(order, share, btype, output="sos")
        expected = scipy.signal.sosfilt(design, inputs)
        found = response(make(frequency, DT, order), inputs, 0.0)
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-10)


def gain(system, frequency, samples=20_000):
    impulse = np.zeros(samples)
    impulse[0] = 1.0
    output = np.asarray(response(system, impulse, 0.0))
    turns = np.exp(-2j * np.pi * frequency * DT * np.arange(samples))
    return np.sum(output * turns), output


@pytest.mark.parametrize("depth", [0.0, 0.3, 1.0])
def test_a_notch_has_its_depth_at_its_frequency(depth):
    for method in ("bilinear", "matched"):
        notch = Notch(3000.0, 0.1, depth, DT, method)
        found, output = gain(notch, 3000.0)
        if method == "bilinear":
            np.testing.assert_allclose(found, depth, rtol=0.0, atol=1e-12)
        elif depth == 0.0:
            assert abs(found) < 1e-12
        if depth == 1.0:
            impulse = np.eye(1, output.size)[0]
            np.testing.assert_allclose(output, impulse, rtol=0.0, atol=1e-13)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("make", [LowPass, HighPass])
def test_the_gain_is_3_db_at_the_cut_off(make, kind):
    for order in (1, 2, 4, 7):
        found, _ = gain(make(400.0, DT, order, kind), 400.0)
        np.testing.assert_allclose(abs(found), np.sqrt(0.5), rtol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_rest_stays_exactly_at_rest(method):
    @jax.jit
    def stepped(frequency):
        systems = filters(frequency, method)
        begun = {name: one.init(37.1) for name, one in systems.items()}
        return begun, {n: one.step(begun[n], 37.1) for n, one in systems.items()}

    for share in SHARES:
        begun, ended = stepped(share * NYQUIST)
        for name in NAMES:
            state, output = ended[name]
            assert float(output) == (0.0 if name.startswith("high") else 37.1)
            assert jax.tree.all(jax.tree.map(lambda a, b: a == b, state, begun[name]))


@pytest.mark.parametrize("method", METHODS)
def test_gradients_equal_finite_differences_up_to_nyquist(method):
    shares = np.array([*SHARES, 1.0 - 1e-6, 1.0 - 1e-9])
    inputs = jnp.asarray(np.random.default_rng(5).normal(size=40))

    def last(share):
        systems = filters(share * NYQUIST, method, orders=(3,))
        return {n: response(one, inputs, 0.0)[-1] for n, one in systems.items()}

    @jax.jit
    @jax.vmap
    def values_and_slopes(share):
        return jax.jvp(last, (share,), (1.0,))

    # One program gives the values, their differences and the gradients.
    step = 1e-6 * shares[1:6]
    lanes = np.concatenate([shares, shares[1:6] + step, shares[1:6] - step])
    values, slopes = values_and_slopes(lanes)
    for name, found in values.items():
        value, upper, lower = np.split(np.asarray(found), [8, 13])
        assert np.all(np.isfinite(value)), name
        assert np.all(np.isfinite(slopes[name][:8])), name
        np.testing.assert_allclose(
            slopes[name][1:6], (upper - lower) / (2.0 * step), rtol=1e-5, atol=1e-6
        )


def test_the_gradient_by_damping_is_finite_at_critical_damping():
    inputs = jnp.asarray(np.random.default_rng(6).normal(size=30))

    def last(damping):
        system = SecondOrderLowPass(2000.0, damping, DT, "hold")
        return simulate(system, inputs, system.init(0.0))[1][-1]

    dampings = np.array([0.99, 1.0 - 1e-9, 1.0, 1.0 + 1e-9, 1.01, 3.0, 30.0])
    lanes = np.concatenate([dampings, dampings + 1e-6, dampings - 1e-6])
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(last)))(lanes)
    _, upper, lower = np.split(np.asarray(values), 3)
    np.testing.assert_allclose(
        slopes[: dampings.size], (upper - lower) / 2e-6, rtol=1e-5, atol=1e-9
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Notch(0.0, 0.1, 0.1, DT), "frequency in Hz is 0; it must be finite"),
        (lambda: Notch(1e4, 0.1, 0.1, DT), "frequency in Hz is 10000; .* below 10000"),
        (lambda: Notch(1e3, 0.1, -0.1, DT), "depth is -0.1; .* at least 0"),
        (lambda: Notch(1e3, 0.0, 0.1, DT), "damping is 0; it must be finite and abo"),
        (lambda: LowPass(1e4, DT), "frequency in Hz is 10000"),
        (lambda: LowPass(1e3, DT, 9), "order is 9; .* at most 8"),
        (
            lambda: LowPass(1e3, DT, 2, "bessel"),
            "kind is 'bessel'; it must be one of b",
        ),
        (
            lambda: FirstOrderLeadLag(1e3, 2e3, DT, "tustin"),
            "discretisation is 'tustin'; it must be one of bilinear, hold, matched",
        ),
        (lambda: FirstOrderLeadLag(1e4, 2e3, DT), "zero_frequency in Hz is 10000"),
        (lambda: SecondOrderLowPass(1e3, 0.0, DT), "damping is 0"),
        (lambda: Biquad(2e4, 0.1, 1e3, 0.1, DT), "zero_frequency in Hz is 20000"),
        (lambda: Biquad(1e3, -0.1, 1e3, 0.1, DT), "zero_damping is -0.1"),
    ],
)
def test_values_that_are_not_allowed_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
