"""Warnings about records: none for a good one, the reason for a bad one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from piezojax import (
    Record,
)
from piezojax.identification.records.checks import cycles, record_warnings

DT = 1e-3
SAMPLES = 4000
TIME = np.arange(SAMPLES) * DT
TRAIN, VALIDATE = slice(0, 2000), slice(2000, SAMPLES)


def triangle(phase):
    """Return a unit triangle wave from 0 upwards, ``phase`` in periods."""
    return 2.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * phase))


def stage(input, lag=0.2, start=0.0):
    """Return the output of a stage: a play operator and a first-order lag."""
    play, output, outputs = 0.0, start, []
    for drive in input:
        play = max(drive - 0.8, min(drive + 0.8, play))
        output += lag * (0.1 * drive + 0.03 * play - output)
        outputs.append(output)
    return np.array(outputs)


def record_of(input, output=None, noise=1e-3, **options):
    output = stage(input) if output is None else output
    scatter = np.random.default_rng(3).standard_normal(output.shape)
    return Record(input, output + noise * scatter, DT, **options)


def warnings(record, **options):
    return record_warnings(record, TRAIN, VALIDATE, **options)


def multisine():
    """Return odd harmonics of 0.5 Hz to 40 Hz, random phases, after 50 ms of rest."""
    phases = np.random.default_rng(5).uniform(0.0, 2.0 * np.pi, 40)
    lines = 0.5 * np.arange(1, 80, 2)
    drive = np.sum(np.cos(2.0 * np.pi * np.outer(TIME, lines) + phases), axis=1)
    return np.where(TIME < 0.05, 0.0, drive)


def smooth_steps():
    """Return minimum-jerk motions between 0 and 1, and rests, of 0.1 s each."""
    share = np.clip((TIME[:400] % 0.2) / 0.1 - 1.0, 0.0, 1.0)
    move = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    return np.tile(np.where(TIME[:400] < 0.2, move, 1.0 - move), 10)


SINE = 10.0 * np.sin(2.0 * np.pi * 5.0 * TIME)
GOOD = {
    "multisine": multisine(),
    "chirp": 10.0 * np.sin(2.0 * np.pi * (1.0 + 5.0 * TIME) * TIME),
    "decaying triangle": 10.0 * np.linspace(1.0, 0.1, SAMPLES) * triangle(2.5 * TIME),
    "triangle from zero": 50.0
    + 50.0 * np.linspace(1.0, 0.1, SAMPLES) * triangle(2.5 * TIME - 0.25),
    "pseudo-random": np.repeat(
        [0.0, *np.random.default_rng(2).choice([-1.0, 1.0], SAMPLES // 20 - 1)], 20
    ),
    "staircase": np.repeat(
        [0.0, *np.random.default_rng(2).integers(0, 9, SAMPLES // 40 - 1)], 40
    ),
    "levels": np.repeat(
        [0.0, *np.random.default_rng(2).uniform(0.0, 9.0, SAMPLES // 40 - 1)], 40
    ),
    "smooth moves": 50.0 * smooth_steps(),
    "noise": np.append(0.0, np.random.default_rng(4).standard_normal(SAMPLES - 1)),
}


@pytest.mark.parametrize("order", [0, 4])
@pytest.mark.parametrize("name", GOOD)
def test_a_good_record_gives_no_warning(name, order):
    assert warnings(record_of(GOOD[name]), order=order) == []


@pytest.mark.parametrize("bits", [10, 12, 16])
@pytest.mark.parametrize("name", GOOD)
def test_a_converter_gives_no_warning(name, bits):
    def converted(signal):
        step = 2.0 * np.max(np.abs(signal)) / 2**bits
        return step * np.round(signal / step)

    drive = GOOD[name]
    assert warnings(record_of(converted(drive), converted(stage(drive)), 0.0)) == []


# Clipping


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_a_clipped_output(side, noise):
    scatter = np.random.default_rng(0).standard_normal(SAMPLES)
    output = side * np.minimum(side * (stage(SINE) + noise * scatter), 1.0)
    text = "; ".join(warnings(record_of(SINE, output, noise=0.0)))
    assert f"output seems to be clipped: it runs into exactly {side:g} um and" in text
    assert "input seems" not in text
    # A sine of 20 periods exceeds the limit as often.
    assert "(20 times in all)" in text
    start = int(text.split("from sample ")[1].split()[0])
    count = int(text.split("stays there for ")[1].split()[0])
    assert np.all(output[start : start + count] == side)
    assert output[start - 1] != side
    assert output[start + count] != side


def test_a_clipped_converter():
    code = np.clip(np.round(stage(SINE) * 400.0), -(2**15), 450)
    assert "runs into exactly 450 um" in "; ".join(warnings(record_of(SINE, code, 0.0)))


def test_a_clipped_input_among_several():
    drives = np.stack([GOOD["chirp"], np.clip(GOOD["chirp"][::-1], -9.0, 11.0)], axis=1)
    record = record_of(drives, stage(drives[:, 0]), input_units=("V", "mV"))
    found = [text for text in warnings(record) if "clipped" in text]
    assert len(found) == 1
    assert found[0].startswith(
        "input 1 seems to be clipped: it runs into exactly -9 mV"
    )


@given(
    amplitude=st.floats(0.9, 6.0).map(lambda x: 10.0**x),
    period=st.floats(0.9, 4.3).map(lambda x: 10.0**x),
    phase=st.floats(0.0, 1.0),
    wave=st.sampled_from([lambda x: np.sin(2.0 * np.pi * x), triangle]),
)
def test_a_rounded_wave_is_not_clipped(amplitude, period, phase, wave):
    signal = np.round(amplitude * wave(np.arange(SAMPLES) / period + phase))
    if np.ptp(signal) > 0:
        record = Record(signal, SINE, DT)
        assert not any("clipped" in text for text in warnings(record))


@given(
    amplitude=st.floats(2.3, 6.0).map(lambda x: 10.0**x),
    period=st.floats(1.7, 3.2).map(lambda x: 10.0**x),
    share=st.floats(0.3, 0.9),
)
def test_a_clipped_rounded_wave_is_found(amplitude, period, share):
    wave = np.round(amplitude * np.sin(2.0 * np.pi * np.arange(SAMPLES) / period))
    limit = np.round(share * amplitude)
    text = "; ".join(warnings(Record(SINE, np.minimum(wave, limit), DT)))
    assert f"output seems to be clipped: it runs into exactly {limit:g} um" in text


@pytest.mark.parametrize("lag", [0.02, 0.2])
def test_an_output_that_settles_is_not_clipped(lag):
    steps = np.where(TIME < 0.1, 0.0, 10.0 * np.sign(np.sin(2.0 * np.pi * 0.5 * TIME)))
    assert not any("clipped" in t for t in warnings(record_of(steps, noise=0.0)))
    output = np.round(3e4 * stage(steps, lag)) / 3e4
    record = record_of(steps, output, noise=0.0)
    assert not any("clipped" in text for text in warnings(record))


# Cycles


@pytest.mark.parametrize("periods", [0.25, 1.0, 2.0, 2.4, 3.0, 7.0])
@pytest.mark.parametrize(
    "wave",
    [
        lambda x: np.sin(2.0 * np.pi * x),
        lambda x: np.cos(2.0 * np.pi * x),
        lambda x: 50.0 * (1.0 - np.cos(2.0 * np.pi * x)),
        triangle,
    ],
)
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_full_cycles_are_counted(periods, wave, noise):
    signal = wave(np.linspace(0.0, periods, 700))
    scatter = np.random.default_rng(1).standard_normal(signal.size)
    assert cycles(signal + noise * np.ptp(signal) * scatter) == int(periods)


def test_small_loops_count_as_cycles_and_ripple_does_not():
    peaks = [0.0, 100.0, 0.0, 80.0, 10.0, 60.0, 20.0, 50.0, 20.0]
    drive = np.interp(np.linspace(0.0, 8.0, 900), np.arange(9), peaks)
    assert cycles(drive) == 4
    assert cycles(drive + 4.0 * np.sin(np.arange(900))) == 4


def test_a_motion_and_its_return_are_one_cycle():
    assert cycles(np.sin(np.linspace(0.0, np.pi, 100))) == 1
    assert cycles(np.linspace(0.0, 1.0, 100)) == 0
    assert cycles(np.zeros(100)) == 0


@pytest.mark.parametrize(("frequency", "count"), [(0.2, 0), (0.5, 1), (1.0, 2)])
def test_few_cycles_warn(frequency, count):
    record = record_of(10.0 * triangle(frequency * TIME))
    expected = (
        f"input has {count} full hysteresis cycle{'s' * (count != 1)} in the training "
        "part; 3 or more separate the loop from its initial loading"
    )
    assert expected in warnings(record)
    assert not any("cycle" in text for text in warnings(record, hysteresis=False))


# Excitation


@pytest.mark.parametrize("frequency", [1.7, 5.0, 61.3])
@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize("hysteresis", [True, False])
def test_a_sine_does_not_excite_dynamics(frequency, noise, hysteresis):
    scatter = np.random.default_rng(6).standard_normal(SAMPLES)
    drive = np.sin(2.0 * np.pi * frequency * TIME) + noise * scatter
    drive[0] = 0.0
    text = "; ".join(warnings(record_of(drive), order=4, hysteresis=hysteresis))
    assert "input is not exciting enough: its 1 frequency in the training part" in text
    assert "determine 2 parameters of linear dynamics, and the model has 4" in text


@pytest.mark.parametrize("lines", [1, 2, 3, 5])
def test_each_frequency_determines_two_parameters(lines):
    frequencies = 7.0 * np.arange(1, lines + 1)
    drive = np.sum(np.sin(2.0 * np.pi * np.outer(TIME, frequencies)), axis=1)
    record = record_of(drive)
    found = [t for t in warnings(record, order=2 * lines + 1) if "exciting" in t]
    assert len(found) == 1
    assert f"determine {2 * lines} parameters" in found[0]
    # The autocorrelation matrix of n sines is singular at order 2n + 1, not at 2n.
    lagged = np.lib.stride_tricks.sliding_window_view(drive, 40 * lines + 1)[:, ::20]
    values = np.linalg.svd(lagged - drive.mean(), compute_uv=False)
    assert values[2 * lines - 1] > 1e-3 * values[0]
    assert values[2 * lines] < 1e-3 * values[0]
    assert not any("exciting" in text for text in warnings(record, order=2 * lines))


def test_one_frequency_is_poor_excitation_for_hysteresis():
    text = "; ".join(warnings(record_of(SINE)))
    assert "input has essentially one frequency: only the shape of the loop" in text
    assert warnings(record_of(SINE), hysteresis=False) == []


def test_the_poor_input_of_two_is_named():
    drives = np.stack([GOOD["chirp"], SINE], axis=1)
    found = warnings(record_of(drives, stage(SINE)), order=4)
    assert len(found) == 1
    assert found[0].startswith("input 1 is not exciting enough")


def test_only_the_training_part_is_checked():
    drive = np.where(TIME < 2.0, SINE, GOOD["chirp"])
    assert any("exciting" in text for text in warnings(record_of(drive), order=4))
    rich = record_warnings(
        record_of(drive), slice(2000, 4000), slice(0, 2000), order=4, hysteresis=False
    )
    assert rich == []


# The start


def test_a_record_cut_from_a_longer_one():
    late = slice(1030, None)
    drive, output = SINE[late], stage(SINE)[late]
    text = "; ".join(warnings(Record(drive, output, DT)))
    assert f"input moves from sample 0 on, at {drive[0]:g}, well inside its" in text
    assert "begin the record at rest" in text
    # The periods of a steady state may start anywhere.
    assert "moves" not in "; ".join(warnings(Record(drive, output, DT, period=200)))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_output_that_starts_inside_its_range(sign):
    drive = GOOD["triangle from zero"]
    output = sign * (stage(drive) + 8.0 * np.exp(-TIME / 0.5))
    found = warnings(record_of(drive, output))
    assert len(found) == 1
    away = 100.0 * abs(output[0] - (sign * output).min() * sign) / np.ptp(output)
    assert f"output starts {away:.0f} % of its range away from the end" in found[0]
    assert warnings(record_of(drive, output), hysteresis=False) == []


def test_an_output_that_has_not_settled():
    drive = np.concatenate([np.zeros(300), GOOD["decaying triangle"][:-300]])
    output = stage(drive) + np.exp(-TIME / 0.1)
    (text,) = warnings(record_of(drive, np.stack([stage(drive), output], axis=1)))
    assert text.startswith("output 1 has not come to rest at sample 0: it drifts by -0")
    assert "while the input rests until sample 30" in text
    assert warnings(record_of(drive)) == []


def test_a_validation_part_within_the_training_part():
    record = record_of(GOOD["chirp"])
    text = record_warnings(record, slice(0, 2000), slice(1999, SAMPLES))
    assert text == [
        "the validation part shares samples with the training part: "
        "its error does not measure prediction"
    ]
