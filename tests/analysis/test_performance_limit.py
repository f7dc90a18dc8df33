"""Distance of loops from their limit, against known answers."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

import piezojax as pj
from piezojax.analysis.limit import (
    NEAR,
    LimitComparison,
    LimitReport,
    Shares,
    performance_limit,
)
from piezojax.analysis.limit.limit_report import Curves
from piezojax.analysis.limit.linear_plant import LinearPlant, linear_plant
from piezojax.analysis.limit.performance import _last_above, _shares
from piezojax.analysis.limit.spectra import (
    ReferencePredictor,
    grid_size,
    spectra,
    windowed,
)
from piezojax.report.limit_bars import limit_text, write_limit
from piezojax.signals import waveforms as references_of

RATE, DT, START, SAMPLES = 5_000.0, 2e-4, 2_500, 15_000
NOISE, SLOPE, MEMORY, DRIVEN = 0.012, 0.15, 0.99, 0.004
NAMES = ("SIN10", "PWSW10")


def loop_of(plant, integral=8000.0, noise=NOISE):
    controller = pj.control.PID(0.0, integral, 0.0, 0.0, 50.0, dt=DT)
    return pj.Feedback(
        controller, plant, pj.hardware.Saturation(-1e3, 1e3), pj.hardware.Sensor(noise)
    )


def driving(names=NAMES, draws=1, samples=SAMPLES):
    time = references_of.time_grid(samples * DT, RATE)
    references = np.stack([references_of.signal(name, time) for name in names])
    random = np.random.default_rng(8)
    return references, random.standard_normal((len(names), draws, samples))


@pytest.fixture(scope="module")
def disturbance():
    draws = np.random.default_rng(3).standard_normal(SAMPLES)
    return signal.lfilter([DRIVEN], [1.0, -MEMORY], draws)


@pytest.fixture(scope="module")
def linear(disturbance):
    """Return the limit of a delayed slope with integral control and a disturbance."""
    found = performance_limit(
        loop_of(pj.core.system.Affine(SLOPE)),
        NAMES,
        *driving(),
        disturbance,
        start=START,
    )
    return found


def riccati(variance):
    b = variance * (1.0 - MEMORY**2) - DRIVEN**2
    return 0.5 * (-b + np.sqrt(b**2 + 4.0 * variance * DRIVEN**2))


def test_the_analysis_of_a_linear_loop_equals_its_definition(linear, disturbance):
    assert isinstance(linear, LimitReport)
    assert linear.gain == pytest.approx(SLOPE, rel=0.02)
    assert linear.delay == pytest.approx(1.0, abs=1e-9)
    assert linear.noise_rms == pytest.approx(NOISE, rel=0.02)
    assert linear.resolution == pytest.approx(10.0)
    for found in linear.references.values():
        whole = disturbance[START:].std()
        assert found.unpredicted == pytest.approx(whole, rel=0.1)
        # An error of the gain of 1 % adds 1 % of the motion, all of it predicted.
        assert found.unpredicted <= found.disturbance < whole + 0.02 * 5.0


def test_the_limit_equals_the_scalar_riccati_equation(linear):
    known = np.sqrt(riccati(NOISE**2))
    for found in linear.references.values():
        # The drawn disturbance differs from its model: a spectrum has 45 segments.
        assert found.limit == pytest.approx(known, rel=0.06)
        assert found.limit <= found.one_controller <= 1.03 * known
    # The best S is that of the Kalman predictor of the disturbance,
    # (z - MEMORY) / (z - MEMORY + gain), whose peak lies at z = -1.
    variance = riccati(NOISE**2)
    gain = MEMORY * variance / (variance + NOISE**2)
    expected = (1.0 + MEMORY) / (1.0 + MEMORY - gain)
    assert linear.sensitivity_peak == pytest.approx(expected, rel=0.1)


def test_curves_and_bandwidth_equal_the_known_spectra(linear):
    """The disturbance has the spectrum DRIVEN^2 / |1 - MEMORY z^-1|^2."""
    line = np.arccos((1.0 + MEMORY**2 - (DRIVEN / NOISE) ** 2) / (2.0 * MEMORY)) / (
        2.0 * np.pi * DT
    )
    curves = linear.curves
    # all lines but those at 0 and at the Nyquist frequency
    spacing = np.diff(curves.frequency)
    assert spacing == pytest.approx(curves.frequency[0])
    assert curves.frequency[-1] + curves.frequency[0] == pytest.approx(RATE / 2.0)
    for i, found in enumerate(linear.references.values()):
        assert found.bandwidth == pytest.approx(line, rel=0.15)
        # The lines of positive and negative frequency add up to the variance.
        assert np.sqrt(np.mean(curves.limit[i])) == pytest.approx(found.limit, rel=0.02)
        above = curves.unpredicted[i] > curves.noise
        assert curves.frequency[np.flatnonzero(above)[-1]] == found.bandwidth


def test_errors_and_shares_equal_those_of_the_loop(linear, disturbance):
    references, noise = driving()
    # The error of y(k + 1) = SLOPE u(k) + d(k), u an integral of r - z.
    loop = [1.0, 8000.0 * DT * SLOPE - 1.0]
    for i, found in enumerate(linear.references.values()):
        heard = signal.lfilter([0.0, 1.0 + loop[1]], loop, NOISE * noise[i, 0])
        left = signal.lfilter([0.0, 1.0, -1.0], loop, disturbance)

        def rms(error):
            return np.sqrt(np.mean(error[START:] ** 2))

        shares = found.tuned_shares
        assert shares.noise == pytest.approx(rms(heard), rel=0.03)
        assert shares.unpredicted == pytest.approx(rms(left), rel=0.15)
        parts = shares.noise**2 + shares.unpredicted**2 + shares.predicted**2
        assert np.sqrt(parts) == pytest.approx(found.tuned, rel=0.05)
        # The lag of integral control is the frequency over the bandwidth of the loop.
        if i == 0:
            lag = 2.0 * np.pi * 10.0 / (8000.0 * SLOPE)
            swing = references[0].std()
            expected = swing * lag / np.hypot(1.0, lag)
            assert shares.predicted == pytest.approx(expected, rel=0.05)
            assert found.largest_excess == "predicted"
        assert found.ratio > NEAR


def test_shares_that_exceed_the_error_are_those_of_no_linear_loop():
    found = _shares(1.0, 0.25, 0.36)
    assert (found.noise, found.unpredicted) == (0.5, 0.6)
    assert found.predicted == pytest.approx(np.sqrt(0.39))
    assert _shares(1.0, 0.9, 0.5).predicted == 0.0
    assert _shares(1.0, 0.9, 0.6) is None
    # The test does not depend on the unit of the error.
    assert _shares(1e-4, 0.9e-4, 0.6e-4) is None
    assert _shares(1e4, 0.25e4, 0.36e4).noise == pytest.approx(50.0)


def test_a_better_controller_is_closer_to_the_limit(linear, disturbance):
    # With a constant reference the error is that of the feedback alone.
    references, noise = driving()
    flat = np.full_like(references, 5.0)
    found = {
        integral: performance_limit(
            loop_of(pj.core.system.Affine(SLOPE), integral),
            NAMES,
            flat,
            noise,
            disturbance,
            start=START,
        )
        for integral in (8000.0, 40000.0)
    }
    good, keen = found[8000.0], found[40000.0]
    assert 1.0 < good.ratio < 1.2
    assert good.near == good.near_one_controller == 2
    assert good.ratio_to_one_controller < good.ratio
    assert keen.ratio > 2.0
    assert keen.near == 0
    assert {one.largest_excess for one in keen.references.values()} == {"noise"}
    # The limit depends on the disturbance and the noise, not on the loop.
    for name in NAMES:
        limits = [report.references[name].limit for report in (good, keen)]
        assert limits[1] == pytest.approx(limits[0], rel=0.06)


def test_a_hysteretic_stage(tmp_path):
    model = pj.hysteresis.ColemanHodgdon(0.0077, 0.1167, -0.0487)
    stage = pj.series(hysteresis=model, lag=pj.dynamics.FirstOrderLag(5e-4, DT))
    references, noise = driving(draws=2, samples=5_000)
    found = performance_limit(
        loop_of(stage, 3000.0), NAMES, references, noise, start=START, segment=0.1
    )
    for one in found.references.values():
        assert one.limit < one.one_controller < one.tuned
        # The reference predicts most of the effect of the hysteresis.
        assert 0.0 < one.unpredicted < 0.5 * one.disturbance
        assert one.limit**2 == pytest.approx(
            one.limit_shares.noise**2 + one.limit_shares.unpredicted**2
        )
    write_limit(found, tmp_path, "a stage")
    data = json.loads((tmp_path / "limit.json").read_text(encoding="utf-8"))
    assert data["references_within"] == found.near
    row = data["per_reference"]["SIN10"]
    assert row["tuned_rms_um"] / row["limit_rms_um"] == row["tuned_over_limit"]
    assert (tmp_path / "limit.png").read_bytes().startswith(b"\x89PNG")
    text = limit_text(found)
    assert f"{found.near} of 2 references within 1.5x" in text
    assert "note: on SIN10" in text


def test_memory_and_uncontrollable_states_are_removed():
    class Counting(pj.System):
        """A slope, and a ramp that does not depend on the voltage."""

        def init(self, input=0.0):
            return jnp.zeros(2)

        def step(self, state, input):
            count, ramp = state
            return jnp.stack([count + 1.0, ramp + count]), SLOPE * input + 1e-6 * ramp

    plant = linear_plant(loop_of(Counting()), 0.0, DT)
    assert len(plant.A) == 0
    np.testing.assert_allclose(
        plant.response(8), SLOPE / np.exp(0.25j * np.pi * np.arange(8))
    )
    model = pj.hysteresis.ColemanHodgdon(0.0077, 0.1167, -0.0487)
    stage = pj.series(hysteresis=model, lag=pj.dynamics.FirstOrderLag(5e-4, DT))
    # The stored input (a pole at 0) and the lag; not the state of the hysteresis.
    poles = np.linalg.eigvals(linear_plant(loop_of(stage), 5.0, DT).A)
    np.testing.assert_allclose(np.sort(poles), [0.0, np.exp(-0.4)], atol=1e-9)


def test_delays_and_zeros_of_a_plant_are_found():
    """The plants are written as functions of 1/z; one of them has slow creep."""
    moving, autoregressive = (0.0050811, -0.0036354, 0.010553), (1.6035, -0.61995)
    dynamics = pj.dynamics.ARMA(autoregressive, moving)
    for plant, delay, zeros in (
        (dynamics, 1, np.roots(moving)),
        (dynamics >> pj.core.system.Delay(2), 3, np.roots(moving)),
        (pj.dynamics.ARMA(autoregressive, (0.0, 0.2, 0.1)), 2, []),
        (pj.dynamics.ARMA(autoregressive, (0.1, 0.1)), 1, []),
        (
            pj.dynamics.LogarithmicCreep(0.02, 0.1, 1e3, DT) >> dynamics,
            1,
            np.roots(moving),
        ),
    ):
        found = linear_plant(loop_of(plant), 0.0, DT).delay_and_zeros()
        assert found[0] == delay
        np.testing.assert_allclose(np.sort(found[1]), np.sort(zeros), rtol=1e-6)
    still = LinearPlant([[0.5]], [0.0], [1.0], 0.0)
    with pytest.raises(ValueError, match="voltage does not move"):
        still.delay_and_zeros()


def test_spectra_sum_to_the_variance():
    random = np.random.default_rng(1)
    drawn = random.standard_normal((2, 3, 40_000)) * np.array([[[1.0]], [[3.0]]])
    coloured = signal.lfilter([1.0], [1.0, -0.6], drawn)
    points = grid_size(500)
    found = spectra(windowed(coloured, 500, points))
    np.testing.assert_allclose(found.mean(axis=1), coloured.var(axis=(1, 2)), rtol=0.02)
    w = np.exp(-2j * np.pi * np.arange(points) / points)
    expected = np.abs(1.0 / (1.0 - 0.6 * w)) ** 2
    shape = found[1] / (9.0 * expected)
    assert np.abs(shape.reshape(64, -1).mean(axis=1) - 1.0).max() < 0.15


@pytest.mark.parametrize("last", [1, 5, 7])
def test_the_bandwidth_is_the_highest_line_above_the_noise(last):
    spectrum = np.zeros(16)
    spectrum[[0, last, 16 - last]] = 2.0
    assert _last_above(spectrum, 1.0) == last
    assert _last_above(spectrum, 2.0) == 0


@pytest.mark.parametrize(("samples", "windows"), [(100, 1), (149, 1), (150, 2)])
def test_windows_overlap_by_half_within_the_record(samples, windows):
    assert windowed(np.ones(samples), 100, 256).shape == (windows, 129)


def test_the_predicted_part_has_the_mean_of_the_signals():
    time = np.arange(4_000) * DT
    moving = np.stack([references_of.signal("SW30", jnp.asarray(time))])
    known = ReferencePredictor(moving, 1_000, 100)
    signals = (0.5 * moving + 7.0)[:, None]
    found = known.predicted(signals)
    assert found.shape == moving.shape
    counted = known.window(found)
    assert counted.mean() == pytest.approx(known.window(signals).mean(), rel=1e-12)
    np.testing.assert_allclose(counted, known.window(signals)[:, 0], atol=1e-3)


def test_only_a_linear_filter_of_the_reference_is_predicted():
    time = np.arange(10_000) * DT
    names = ("SIN1", "SIN10", "SW30", "PWSW10")
    moving = np.stack([references_of.signal(name, jnp.asarray(time)) for name in names])
    known = ReferencePredictor(moving, 5_000, 250)
    assert known.count == 10_000 - 5_000 - 250
    # Lag, lead and slope: a linear filter of the reference.
    lagging = signal.lfilter([0.05], [1.0, -0.95], moving - moving[:, :1])
    ahead = np.concatenate([moving[:, 20:], moving[:, -20:]], axis=1)
    signals = (lagging + 0.3 * ahead + 4.0)[:, None]
    rest = known.unpredicted(signals)
    whole = known.centred(signals)
    assert np.all(rest.std(axis=2) < 1e-3 * whole.std(axis=2))
    # A linear filter predicts neither harmonics nor an independent signal.
    other = np.stack([np.sin(2.0 * np.pi * 3.0 * 10.0 * time)] * 4)[:, None]
    kept = known.unpredicted(
        signals + np.array([0.0, 1.0, 0.0, 0.0])[:, None, None] * other
    )
    assert kept[1].std() == pytest.approx(np.sqrt(0.5), rel=0.2)
    drawn = np.random.default_rng(4).standard_normal((4, 2, 10_000))
    left = known.unpredicted(drawn)
    np.testing.assert_allclose(left.std(axis=2), 1.0, atol=0.05)
    # A constant reference predicts nothing.
    still = ReferencePredictor(np.full((4, 10_000), 5.0), 5_000, 250)
    np.testing.assert_array_equal(still.unpredicted(signals), still.centred(signals))


def test_loops_without_a_limit_are_refused():
    references, noise = driving(samples=500)
    loop = loop_of(pj.core.system.Affine(SLOPE))
    with pytest.raises(ValueError, match="without sensor noise"):
        performance_limit(
            loop_of(pj.core.system.Affine(SLOPE), noise=0.0), NAMES, references, noise
        )
    with pytest.raises(ValueError, match="one axis only"):
        performance_limit(loop, NAMES, references[..., None], noise)
    with pytest.raises(ValueError, match="a run diverges"):
        performance_limit(loop, NAMES, references, np.nan * noise)
    integrating = pj.dynamics.StateSpace([[1.0]], [[1.0]], [[1.0]], [[0.0]], DT)
    with pytest.raises(ValueError, match="known for stable plants"):
        linear_plant(loop_of(Scalar(integrating)), 0.0, DT)
    with pytest.raises(ValueError, match="does not move as its linear model"):
        performance_limit(
            loop_of(pj.core.system.Affine(SLOPE), 0.0), NAMES, references, noise
        )


class Scalar(pj.System):
    """A model with vectors as a plant with scalar signals."""

    model: pj.dynamics.StateSpace

    def init(self, input=0.0):
        return jnp.zeros(1)

    def step(self, state, input):
        state, output = self.model.step(state, jnp.stack([input]))
        return state, output[0]


def comparison(tuned, limit, shares):
    least = Shares(noise=0.6 * limit, unpredicted=0.8 * limit)
    return LimitComparison(tuned, limit, 1.1 * limit, 0.3, 0.02, 200.0, shares, least)


def test_the_text_names_the_share_that_exceeds_the_limit():
    rows = {
        "A": comparison(4.0, 2.0, Shares(3.9, 0.5, 0.7)),
        "B": comparison(4.0, 2.0, Shares(1.2, 3.7, 0.7)),
        "C": comparison(4.0, 2.0, Shares(1.2, 1.6, 3.4)),
        "D": comparison(2.2, 2.0, Shares(1.5, 1.6)),
        "E": comparison(1.0, 2.0, None),
        "F": comparison(4.0, 2.0, None),
    }
    nothing = Curves(np.zeros(0), np.zeros((6, 0)), 1.0, *np.zeros((2, 6, 0)))
    report = LimitReport(rows, DT, NOISE, 10.0, SLOPE, 1.0, 1.1, nothing)
    assert report.near == 2
    assert report.ratio == pytest.approx((2.0**4 * 1.1 * 0.5) ** (1.0 / 6.0))
    text = limit_text(report)
    assert "on A 2.00x the loop passes more sensor noise" in text
    assert "on B 2.00x the loop cancels too little" in text
    assert "on C 2.00x the loop leaves an error that a linear filter" in text
    assert "on F 2.00x the loop is too nonlinear" in text
    assert "note: E 0.50x: below the limit" in text
    assert "D" not in text.split("\n", 1)[1]


def test_a_limit_of_rounding_size_is_reported_as_zero():
    rows = {"A": comparison(4.0, 1e-12, Shares(3.9, 0.5, 0.7))}
    nothing = Curves(np.zeros(0), np.zeros((1, 0)), 1.0, *np.zeros((2, 1, 0)))
    report = LimitReport(rows, DT, NOISE, 10.0, SLOPE, 1.0, 1.1, nothing)
    assert limit_text(report).startswith("limit of linear control: zero up to rounding")


def test_the_ratio_to_a_limit_of_zero_is_infinite():
    assert comparison(4.0, 0.0, None).ratio == np.inf


def test_the_text_states_the_reason_for_no_limit(tmp_path):
    write_limit("the stage sleeps", tmp_path)
    data = json.loads((tmp_path / "limit.json").read_text(encoding="utf-8"))
    assert data == {"problem": "the stage sleeps"}
    assert not (tmp_path / "limit.png").exists()
    assert limit_text("the stage sleeps").endswith("linear control: the stage sleeps")
