"""The forty stages: each operator against a slow loop or a closed form."""

import itertools
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import hilbert

from oracles import excitation, forty_stages
from oracles.stages import MEMORIES, Parameters, Stage, remember

NUMBER = {operator.__name__: place for place, operator in enumerate(MEMORIES)}
PLAIN = np.array([[0.0, 1.0, 0.0]])
"""One play without a threshold: no hysteresis."""

STIFF = np.array([[1500.0, 1.0, 1.0]])


def wandering(seed=1, corners=12):
    """Return a path over 0 to 1 with random turning points, 150 samples per stroke."""
    ends = np.random.default_rng(seed).uniform(size=corners)
    ends = np.concatenate([[0.0, 1.0], ends])
    strokes = [np.linspace(*pair, 150) for pair in itertools.pairwise(ends)]
    return np.concatenate(strokes)


def memorised(kind, path, table, dt=1e9):
    state, before, found = np.zeros(1000), 0.0, []
    for x in path:
        found.append(remember(NUMBER[kind], x, x - before, dt, state, table))
        before = x
    return np.array(found)


def plain(**changes):
    """Return a stage of 50 um over 100 V at 10 kHz; by default a line and a mode."""
    numbers = {
        "name": "plain",
        "rate": 10e3,
        "lower": 0.0,
        "upper": 100.0,
        "stroke": 50.0,
        "memory": NUMBER["plays"],
        "table": PLAIN,
        "modes": STIFF,
        "creep": np.zeros((0, 2)),
        "bits": 40,
    }
    return Stage(Parameters(**numbers | changes))


# Memories


@pytest.mark.parametrize("kind", ["plays", "drifting"])
def test_plays_equal_the_textbook_loop(kind):
    table = forty_stages.KINDS[kind](np.random.default_rng(3))
    path, outputs, before = wandering(), [], 0.0
    positions = [0.0] * len(table)
    for x in path:
        total = 0.0
        for i, (threshold, weight, creeping) in enumerate(table):
            p = positions[i] + creeping * abs(x - before) * (x - positions[i])
            if x - p > threshold:
                p = x - threshold
            elif p - x > threshold:
                p = x + threshold
            positions[i], total = p, total + weight * p
        outputs.append(total)
        before = x
    np.testing.assert_allclose(memorised("plays", path, table), outputs, atol=1e-13)


def test_elasto_slide_elements_balance_the_input():
    table = forty_stages.slipping_elements(np.random.default_rng(4))
    path = wandering()
    q, forces = 0.0, np.zeros(len(table) - 1)

    def pull(to):
        return np.clip(forces + table[1:, 0] * (to - q), -table[1:, 1], table[1:, 1])

    expected = []
    for x in path:
        low, high = -2.0, 2.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            below = table[0, 0] * middle + pull(middle).sum() < x
            low, high = (middle, high) if below else (low, middle)
        forces, q = pull(low), low
        expected.append(q)
    np.testing.assert_allclose(
        memorised("maxwell_slip", path, table), expected, atol=1e-12
    )


def test_the_preisach_operator_equals_its_relays():
    table = forty_stages.relay_grid(np.random.default_rng(5))
    cells, each = len(table) - 2, 20
    corners = table[1:]
    weights = np.diff(np.diff(corners, axis=0), axis=1)
    fine = np.kron(weights, np.full((each, each), 1.0 / each**2))
    up, down = np.tril_indices(cells * each)
    weight = fine[up, down] * np.where(up == down, 0.5, 1.0)
    places = (np.arange(cells * each) + 0.5) / (cells * each)
    on, expected = np.zeros(up.size, bool), []
    path = wandering()
    for x in path:
        on = (on | (places[up] <= x)) & (places[down] < x)
        expected.append(table[0, 1] * x + weight[on].sum())
    found = memorised("preisach", path, table)
    assert np.abs(found - expected).max() < 1.5 / (cells * each)
    assert found[149] == pytest.approx(1.0)  # the weights have the sum 1


def test_a_slow_bouc_wen_loop_solves_its_equation():
    rise, b, c = 0.5, 4.0, 1.5
    table = np.array([[rise, b, c], [0.0, 1.0, 0.0]])
    path = wandering()
    h, ends = [0.0], [0, *range(149, path.size, 150)]
    for start, stop in zip(path[ends[:-1]], path[ends[1:]], strict=True):
        way = 1.0 if stop > start else -1.0
        branch = solve_ivp(
            lambda x, h, way=way: rise - way * b * h - c * np.abs(h),
            (start, stop),
            [h[-1]],
            rtol=1e-10,
            atol=1e-12,
        )
        h.append(branch.y[0, -1])
    found = (path - memorised("bouc_wen", path, table))[ends[1:]]
    np.testing.assert_allclose(found, h[1:], atol=2e-5)


def test_fast_bouc_wen_loops_are_wider():
    table = forty_stages.rate_dependent_loop(np.random.default_rng(6))
    cycle = 0.5 - 0.5 * np.cos(np.linspace(0.0, 8.0 * np.pi, 8000))
    width = [
        -np.trapezoid(memorised("bouc_wen", cycle, table, dt)[4000:], cycle[4000:])
        for dt in (1e-1, 1e-3, 1e-4)
    ]
    assert width[0] < width[1] < width[2] < 1.6 * width[0]


def test_friction_of_exponent_one_is_an_exponential():
    table = np.array([[0.5, 0.1, 1.0]])
    path = np.linspace(0.0, 1.0, 2000)
    found = path - memorised("dahl", path, table)
    np.testing.assert_allclose(found, 0.1 * -np.expm1(-5.0 * path), atol=1e-6)


LOOPS = np.concatenate(
    [np.linspace(*ends, 2000) for ends in ((0, 1), (1, 0.2), (0.2, 0.7), (0.7, 0.2))]
)
"""Up, a large stroke down, then a smaller one up and back to its start."""


@pytest.mark.parametrize("kind", forty_stages.KINDS)
def test_minor_loops_close_in_models_with_return_point_memory(kind):
    table = forty_stages.KINDS[kind](np.random.default_rng(7))
    operator = "plays" if kind == "drifting" else kind
    found = memorised(operator, LOOPS, table)
    gap = abs(found[-1] - found[3999])
    if kind in ("plays", "maxwell_slip", "preisach"):
        assert gap < 1e-12
    else:
        assert 1e-4 < gap < 0.1


@pytest.mark.parametrize("kind", ["plays", "maxwell_slip", "preisach"])
def test_minor_loops_between_the_same_inputs_are_congruent(kind):
    table = forty_stages.KINDS[kind](np.random.default_rng(8))
    minor = np.concatenate([np.linspace(0.4, 0.6, 300), np.linspace(0.6, 0.4, 300)])

    def after(*history):
        ends = [0.0, *history, 0.4]
        strokes = [np.linspace(*p, 300) for p in itertools.pairwise(ends)]
        path = np.concatenate([*strokes, minor, minor])
        return memorised(kind, path, table)[-600:]

    rising, falling = after(0.35), after(1.0)
    if kind != "maxwell_slip":  # congruent in the force; the output is the charge
        np.testing.assert_allclose(np.ptp(falling - rising), 0.0, atol=1e-12)
    assert np.abs(falling - rising).min() > 1e-3


# Creep, modes, sensor, converters


def test_a_mode_rings_at_its_frequency_and_damping():
    stage = plain(modes=np.array([[780.0, 0.02, 1.0]]))
    tips = stage.respond(np.full(2000, 50.0))[1]
    assert tips[-1] == pytest.approx(25.0, rel=1e-6)
    ringing = hilbert(tips[:800] - 25.0)[50:400]
    time = 1e-4 * np.arange(ringing.size)
    decay = -np.polyfit(time, np.log(np.abs(ringing)), 1)[0]
    turning = np.polyfit(time, np.unwrap(np.angle(ringing)), 1)[0]
    omega = np.hypot(decay, turning)
    assert omega / (2.0 * np.pi) == pytest.approx(780.0, rel=1e-3)
    assert decay / omega == pytest.approx(0.02, rel=0.02)


def test_modes_of_either_sign_have_their_transfer_function():
    modes = np.array([[500.0, 0.05, 1.06], [1400.0, 0.03, -0.06]])
    stage = plain(modes=modes, sensor_lag=2e-4)
    frequency = 900.0
    time = 1e-4 * np.arange(2000)
    u = 50.0 + 10.0 * np.sin(2.0 * np.pi * frequency * time)
    _, tip, sensed = stage.respond(u)
    s = 2j * np.pi * frequency
    held = -np.expm1(-s * 1e-4) / (s * 1e-4)  # the converter holds the voltage
    expected = sum(
        residue * w**2 / (s**2 + 2.0 * zeta * w * s + w**2)
        for w, zeta, residue in modes * [2.0 * np.pi, 1.0, 1.0]
    )

    def response(y):
        wave = np.exp(-s * (time[1000:] + 1e-4))
        return np.mean(y[1000:] * wave) / np.mean(u[1000:] * np.exp(-s * time[1000:]))

    # 50 um over 100 V; the difference is due to the images of the hold.
    assert response(tip) / 0.5 == pytest.approx(held * expected, rel=1e-3)
    lagged = held * expected / (1.0 + 2e-4 * s)
    assert response(sensed) / 0.5 == pytest.approx(lagged, rel=1e-3)


def test_creep_is_the_same_in_every_decade():
    stage = plain(creep=forty_stages.logarithmic_creep(0.01), rate=1e3)
    tips = stage.respond(np.full(31000, 50.0))[1]
    decades = np.diff(tips[[99, 999, 9999]])  # 0.1, 1 and 10 s
    np.testing.assert_allclose(decades, 0.01 * tips[99], rtol=0.15)
    stage.reset(50.0)
    np.testing.assert_allclose(stage.respond(np.full(2000, 50.0))[1], stage.tip)


def test_one_exponential_of_creep_has_its_time_and_share():
    stage = plain(creep=np.array([[0.1, 0.05]]))
    tips = stage.respond(np.full(2000, 50.0))[1]
    expected = 25.0 / 1.05 * (1.0 - 0.05 * math.expm1(-1.0))
    assert tips[999] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("delay", [0.0, 0.5, 1.0, 2.75])
def test_the_delay_shifts_the_response(delay):
    stage = plain(delay=delay, modes=np.array([[300.0, 0.3, 1.0]]))
    tips = stage.respond(np.full(40, 50.0))[1]
    w, zeta = 2.0 * np.pi * 300.0, 0.3
    time = np.maximum(1e-4 * (np.arange(1, 41) - delay), 0.0)
    damped = w * math.sqrt(1.0 - zeta**2)
    phase = np.cos(damped * time) + zeta * w / damped * np.sin(damped * time)
    expected = 25.0 * (1.0 - np.exp(-zeta * w * time) * phase)
    np.testing.assert_allclose(tips, expected, atol=1e-6)


def test_the_amplifier_limits_the_slew_rate():
    stage = plain(slew=1e4)
    tips = stage.respond(np.full(400, 50.0))[1]
    # The ramp ends after 5 ms; a mode lags a ramp by 2 zeta / w.
    lag = 2.0 / (2.0 * np.pi * 1500.0)
    assert tips[39] == pytest.approx(0.5 * 1e4 * (40e-4 - lag), rel=0.01)


def test_readings_are_multiples_of_the_converter_with_its_noise():
    stage = plain(noise=5e-3, bits=16)
    stage.reset(30.0, seed=9)
    readings = stage.respond(np.full(20000, 30.0))[0]
    lsb = 1.2 * 50.0 / 2**16
    steps = readings / lsb
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert np.std(readings) == pytest.approx(
        math.hypot(5e-3, lsb / math.sqrt(12)), rel=0.03
    )


def test_single_steps_equal_a_whole_record():
    one, all_at_once = (forty_stages.stage(8) for _ in range(2))
    voltages, readings = excitation.record(all_at_once, "timid", seed=2)
    first = one.reset(voltages[0], 2)
    found = [first, *(one.step(v) for v in voltages[:500])]
    np.testing.assert_array_equal(found, readings[:501])


def test_voltages_are_limited():
    stage = plain()
    assert stage.respond(np.full(500, 1e9))[1][-1] == pytest.approx(50.0)


# The forty stages, and their records


def test_the_forty_stages_have_their_strokes_and_loops():
    widths = []
    for number in range(forty_stages.COUNT):
        stage = forty_stages.stage(number)
        p = stage.parameters
        ends = (0.0, p.upper, p.lower, p.upper)
        path = [np.linspace(*e, 4000) for e in itertools.pairwise(ends)]
        tips = stage.respond(np.concatenate(path))[1]
        assert np.ptp(tips[4000:]) == pytest.approx(p.stroke, rel=0.1), p.name
        middle = np.searchsorted(path[2], 0.5 * (p.lower + p.upper))
        width = tips[8000 - middle] - tips[8000 + middle]
        widths.append(width / p.stroke)
    assert min(widths) > 0.03
    assert max(widths) < 0.25


def test_equal_numbers_are_equal_stages():
    for name in ("table", "modes", "creep"):
        first, again = (getattr(forty_stages.parameters(11), name) for _ in range(2))
        np.testing.assert_array_equal(first, again)
    with pytest.raises(ValueError, match="stage 40; there are 0 to 39"):
        forty_stages.stage(40)


@pytest.mark.parametrize("kind", excitation.KINDS)
def test_records_stay_within_the_limits(kind):
    for number in (0, 3):
        p = forty_stages.parameters(number)
        u, y = excitation.record(forty_stages.stage(number), kind)
        assert u.shape == y.shape
        assert p.lower <= u.min() < u.max() <= p.upper
    spectrum = np.abs(np.fft.rfft((u - u.mean()) * np.hanning(u.size)))
    fast = np.fft.rfftfreq(u.size, 1.0 / p.rate) > 200.0
    share = spectrum[fast].max() / spectrum.max()
    assert (share > 1e-3) == (kind in ("careful", "timid"))


def test_the_audited_stage_has_the_numbers_of_the_audit():
    p = forty_stages.audited().parameters
    assert len(p.table) == 25
    assert (p.modes[0, 0], p.modes[0, 1], p.sensor_lag) == (780.0, 0.02, 1e-3)
