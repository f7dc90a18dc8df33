import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import signals as oracle

from piezojax.signals import waveforms as signals

RATE = 20_000.0


@pytest.fixture(scope="module")
def second():
    return signals.time_grid(1.0, RATE)


def test_time_grid_counts_from_zero(second):
    assert second.dtype == jnp.float64
    np.testing.assert_allclose(second, np.arange(20_000) / RATE, rtol=1e-15)
    # 0.15 s at 1 kHz is 149.99999999999997 samples in floating point.
    assert signals.time_grid(0.15, 1e3).size == 150


@pytest.mark.parametrize("kind", signals.SIGNALS)
def test_all_signals_have_one_type(kind, second):
    # With a weak type a loop would be compiled twice.
    assert not signals.SIGNALS[kind](second).weak_type


@pytest.mark.parametrize(
    ("duration", "rate", "message"),
    [
        (0.0, RATE, "duration in s is 0; it must be finite and above 0"),
        (-1.0, RATE, "duration in s is -1"),
        (np.inf, RATE, "duration in s is inf"),
        (1.0, 0.0, "rate in Hz is 0; it must be finite and above 0"),
        (1.0, np.nan, "rate in Hz is nan"),
        (5e-5, RATE, "5e-05 s at 20000 Hz hold 1 samples; at least 2 are needed"),
    ],
)
def test_bad_time_grids_are_refused(duration, rate, message):
    with pytest.raises(ValueError, match=message):
        signals.time_grid(duration, rate)


@pytest.mark.parametrize("name", signals.THESIS)
def test_thesis_references_equal_the_published_ones(name, second):
    expected = oracle.ten_references(n_extra=0)[name]
    found = signals.signal(name, second)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-11)


def test_thesis_names_all_ten():
    assert set(signals.THESIS) == set(oracle.ten_references(duration=0.1))


def test_superposed_sine_scales_about_the_offset(second):
    found = signals.signal("SW10", second, amplitude=2.0, offset=7.0)
    expected = 7.0 + oracle.superposed_sine(10, amplitude=2.0)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-11)


# number of periods after which the signal repeats
REPEATS = {
    **{"SIN": 1, "COS": 1, "SCAN": 1, "TRI": 1, "SQUARE": 1},
    **{"PWSW": 4, "SW": 20, "MULTISINE": 20},
}


@pytest.mark.parametrize(("kind", "repeat"), REPEATS.items())
def test_period(kind, repeat, second):
    frequency = 100.0
    values = np.asarray(signals.SIGNALS[kind](second, frequency=frequency))
    samples = round(repeat * RATE / frequency)
    np.testing.assert_allclose(
        values[samples : 3 * samples], values[: 2 * samples], rtol=0.0, atol=1e-9
    )
    # It does not repeat after a shorter time.
    moved = np.abs(values[samples // 2 :][:samples] - values[:samples])
    assert moved.max() > 0.1


@pytest.mark.parametrize(
    "kind", ["SIN", "SCAN", "PWSW", "TRI", "STEP", "SQUARE", "CHIRP"]
)
def test_start_is_at_the_offset(kind, second):
    values = signals.SIGNALS[kind](second, frequency=10.0, offset=3.0)
    np.testing.assert_allclose(values[0], 3.0, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("kind", ["SIN", "SCAN", "PWSW", "CHIRP"])
def test_start_has_zero_speed(kind, second):
    values = signals.SIGNALS[kind](second, frequency=10.0)
    assert abs(values[1] - values[0]) < 0.01 * np.abs(np.diff(values)).max()


RANGES = {
    "SIN": (0.0, 10.0),
    "COS": (0.0, 10.0),
    "SCAN": (0.0, 10.0),
    "PWSW": (0.0, 10.0),
    "TRI": (0.0, 10.0),
    "SQUARE": (0.0, 10.0),
    "STEP": (0.0, 5.0),
    "CONST": (5.0, 5.0),
    "CHIRP": (0.0, 10.0),
    "PRBS": (0.0, 10.0),
    "SW": (-2.32, 12.93),
}


@pytest.mark.parametrize(("kind", "limits"), RANGES.items())
def test_range(kind, limits, second):
    time = signals.time_grid(4.0, 5e3)
    values = signals.SIGNALS[kind](time, frequency=10.0)
    np.testing.assert_allclose(
        (values.min(), values.max()), limits, rtol=0.0, atol=0.01
    )


def test_the_docs_list_all_references_with_their_ranges():
    text = Path(__file__).parents[1].joinpath("docs/files.md").read_text("utf-8")
    rows = dict(re.findall(r"^\| `([A-Z]+)` \| ([^|]+) \|", text, re.MULTILINE))
    assert rows.keys() == signals.SIGNALS.keys()
    time = signals.time_grid(4.0, 5e3)
    for kind, shown in rows.items():
        values = signals.SIGNALS[kind](time, frequency=10.0, amplitude=1.0)
        ends = [float(number) for number in shown.split(" to ")]
        low, high = ends[0], ends[-1]
        assert (values.min(), values.max()) == pytest.approx((low, high), abs=0.1)


def test_multisine_peaks_near_its_amplitude(second):
    values = signals.signal("MULTISINE100", second, amplitude=4.0, offset=1.0)
    assert 3.0 < np.abs(values - 1.0).max() < 5.0


def test_multisine_has_equal_tones_up_to_its_frequency(second):
    spectrum = np.abs(np.fft.rfft(signals.signal("MULTISINE100", second)))
    tones = np.arange(5, 101, 5)
    np.testing.assert_allclose(spectrum[tones], spectrum[5], rtol=1e-9)
    assert np.delete(spectrum, tones).max() < 1e-9 * spectrum[5]


def test_chirp_reaches_its_frequency_at_the_end(second):
    values = signals.signal("CHIRP100", second)
    phase = 2.0 * np.pi * 0.5 * 100.0 * np.asarray(second) ** 2 / second[-1]
    np.testing.assert_allclose(values, 5.0 * (1.0 - np.cos(phase)), atol=1e-10)
    crossings = np.sum(np.diff(np.sign(values[-2000:] - 5.0)) != 0)
    assert abs(crossings / 2 / 0.1 - 95.0) < 5.0  # mean of the last tenth, Hz


def test_step_rises_once_after_a_tenth_of_a_period(second):
    values = signals.step(second, 1.0, 2.0, 1.0)
    np.testing.assert_array_equal(values, np.where(second >= 0.1, 3.0, 1.0))


@pytest.mark.parametrize("rate", [20_000, 10_000, 48_000])
@pytest.mark.parametrize("frequency", [1, 7, 10, 30, 50, 100, 400])
def test_jumps_are_at_their_sample(frequency, rate):
    time, k = signals.time_grid(1.0, float(rate)), np.arange(rate)
    # Whole numbers tell in which half period sample k is.
    high = (2 * k * frequency // rate) % 2
    found = signals.square(time, float(frequency), 5.0, 1.0)
    np.testing.assert_array_equal(found, 1.0 + 10.0 * high)
    found = signals.step(time, float(frequency), 5.0)
    np.testing.assert_array_equal(found, 5.0 * (10 * k * frequency >= rate))


def test_triangle_has_one_speed(second):
    values = signals.triangle(second, 10.0, 5.0)
    speeds = np.abs(np.diff(values)) * RATE
    np.testing.assert_allclose(speeds, 2.0 * 10.0 * 10.0, rtol=1e-6)


def test_prbs_holds_its_level_and_depends_on_its_seed(second):
    values = np.asarray(signals.signal("PRBS100", second))
    slots = values.reshape(100, 200)
    np.testing.assert_array_equal(slots, slots[:, :1] + np.zeros((1, 200)))
    assert 30 < np.sum(slots[:, 0] > 0.0) < 70
    np.testing.assert_array_equal(values, signals.prbs(second))
    assert np.any(values != signals.prbs(second, seed=1))


@pytest.mark.parametrize("kind", signals.SIGNALS)
@settings(max_examples=25, deadline=None)
@given(
    frequency=st.floats(0.0, 1e4),
    amplitude=st.floats(-100.0, 100.0),
    offset=st.floats(-100.0, 100.0),
)
def test_every_signal_is_finite_and_bounded(kind, frequency, amplitude, offset):
    time = signals.time_grid(0.01, RATE)
    values = signals.SIGNALS[kind](time, frequency, amplitude, offset)
    assert values.shape == time.shape
    assert values.dtype == jnp.float64
    assert np.all(np.isfinite(values))
    assert np.abs(values - offset).max() <= 3.0 * abs(amplitude) + 1e-9


@pytest.mark.parametrize("kind", signals.SIGNALS)
def test_a_batch_of_frequencies_equals_a_loop(kind):
    time = signals.time_grid(0.05, RATE)
    frequencies = jnp.array([10.0, 33.3, 400.0])
    batch = jax.vmap(signals.SIGNALS[kind], in_axes=(None, 0))(time, frequencies)
    for frequency, row in zip(frequencies, batch, strict=True):
        alone = signals.SIGNALS[kind](time, frequency)
        np.testing.assert_allclose(row, alone, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("SIN10", ("SIN", 10.0)),
        ("PWSW30", ("PWSW", 30.0)),
        ("SW0.5", ("SW", 0.5)),
        ("CONST", ("CONST", None)),
    ],
)
def test_names_are_read(name, expected):
    assert signals.parse(name) == expected


@pytest.mark.parametrize(
    "name",
    ["", "10", "SINE10", "sin10", "SIN-10", "SIN1.2.3", "SIN.", "SIN10 ", "SINE"],
)
def test_unknown_names_are_refused(name):
    with pytest.raises(ValueError, match=r"is unknown; it must be one of SIN, SW, .*"):
        signals.parse(name)
    with pytest.raises(ValueError, match=f"signal {name!r} is unknown"):
        signals.signal(name, signals.time_grid(0.1, RATE))


def test_a_name_without_number_keeps_the_default_frequency(second):
    np.testing.assert_array_equal(
        signals.signal("SIN", second), signals.sine(second, 10.0)
    )


def test_gradient_by_the_amplitude_is_the_shape(second):
    shape = (signals.sine(second) - 0.0) / 5.0
    found = jax.jacfwd(lambda a: signals.sine(second, 10.0, a))(5.0)
    np.testing.assert_allclose(found, shape, rtol=0.0, atol=1e-14)
