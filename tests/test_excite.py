"""``piezojax.excite``: voltages within the limits of a generator, and their content."""

import io

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from page_reader import checked
from rich.console import Console

from piezojax.cli.excite import main
from piezojax.identification.records.sampled import read_sampled
from piezojax.report.excitation_pictures import excitation_page, next_record_page
from piezojax.signals.excitation import (
    SMALL,
    Generator,
    buffered,
    excitation,
    holds,
    ladder,
    multisine,
)
from piezojax.tuning.next_record import ExpectedParameter, RecordReport

GENERATOR = Generator(-20.0, 120.0, 10_000.0)


def drawn(part, generator=GENERATOR, seed=0):
    return part(generator, np.random.default_rng(seed))


def turning_points(voltages):
    """Return the voltages at which the direction changes."""
    moves = voltages[np.concatenate([[True], np.diff(voltages) != 0.0])]
    turns = np.diff(np.sign(np.diff(moves))) != 0.0
    return moves[1:-1][turns]


def test_the_ladder_covers_the_range_and_has_nested_loops():
    turns = turning_points(drawn(ladder).voltages)
    assert turns.min() == pytest.approx(-20.0, abs=0.01)
    assert turns.max() == pytest.approx(120.0, abs=0.01)
    heights = np.abs(np.diff(turns))
    # two cycles of 140 V, then six that shrink from 84 V to 15 % of that
    assert np.sum(heights > 139.0) >= 4
    nested = heights[(heights > 12.0) & (heights < 85.0)]
    assert len(np.unique(np.round(nested, 1))) >= 6


def test_the_holds_are_constant_for_the_given_time():
    part = drawn(holds, Generator(0.0, 100.0, 1e3, hold=0.4))
    still = np.concatenate([[0], (np.diff(part.voltages) == 0.0).astype(int), [0]])
    ends = np.flatnonzero(np.diff(still))
    lengths = (ends[1::2] - ends[::2]) / 1e3
    assert lengths[lengths > 0.1] == pytest.approx(0.4, abs=0.005)
    assert len(lengths[lengths > 0.1]) == 3
    assert np.ptp(part.voltages) > 50.0


def test_the_multisine_has_its_lines_and_no_other_frequency():
    part = drawn(multisine)
    spectrum = np.abs(np.fft.rfft(part.voltages - 50.0)) / part.voltages.size
    frequency = np.fft.rfftfreq(part.voltages.size, 1e-4)
    lines = frequency[spectrum > 1e-6]
    assert (lines[0], lines[-1]) == pytest.approx((10.0, 4000.0))
    # sines of equal amplitude
    assert np.ptp(spectrum[spectrum > 1e-6]) < 1e-9
    moved = part.voltages - 50.0
    assert np.abs(moved).max() == pytest.approx(SMALL * 140.0)
    # Random phases have a crest factor of 3.5 to 4.5.
    assert np.abs(moved).max() / np.std(moved) < 3.3


@pytest.mark.parametrize("seed", range(8))
def test_the_multisine_begins_and_ends_near_the_middle(seed):
    moved = drawn(multisine, seed=seed).voltages - 50.0
    # It may cross the middle anywhere between two samples.
    assert abs(moved[0]) < 0.5 * np.abs(np.diff(moved)).max()
    assert abs(moved[-1]) < 1.5 * np.abs(np.diff(moved)).max()


def test_the_lines_of_the_multisine_are_closer_than_a_resonance_is_wide():
    part = drawn(multisine, Generator(-20.0, 120.0, 20_000.0))
    spectrum = np.abs(np.fft.rfft(part.voltages - 50.0))
    lines = np.fft.rfftfreq(part.voltages.size, 5e-5)[spectrum > 1e-3]
    apart = np.diff(lines) / lines[:-1]
    # 2 % between the half-power frequencies of a damping of 1 %
    assert np.max(apart[lines[:-1] > 300.0]) < 0.02


@settings(max_examples=25, deadline=None)
@given(
    lower=st.floats(-100.0, 50.0),
    span=st.floats(1.0, 200.0),
    rate=st.floats(500.0, 5e4),
    slew=st.floats(500.0, 1e6),
    seed=st.integers(0, 1000),
)
def test_no_part_exceeds_the_limits(lower, span, rate, slew, seed):
    generator = Generator(lower, lower + span, rate, slew, slowest=4.0, hold=0.05)
    parts, whole = excitation(generator, seed)
    for voltages in (whole, *(part.voltages for part in parts)):
        assert voltages.min() >= lower - 1e-9 * span
        assert voltages.max() <= lower + span + 1e-9 * span
        # The slope between samples is at most that of the signal.
        assert rate * np.abs(np.diff(voltages)).max() <= slew * (1.0 + 1e-6)


def test_the_record_has_every_part_twice_and_differently():
    parts, whole = excitation(GENERATOR, 3)
    rest = 1000
    assert np.ptp(whole[:rest]) == 0.0
    size = sum(part.voltages.size for part in parts)
    first = np.concatenate([part.voltages for part in parts])
    np.testing.assert_array_equal(whole[rest : rest + size], first)
    assert whole.size - rest == pytest.approx(2 * size, rel=0.05)
    assert not np.array_equal(whole[-100:], first[-100:])
    # the same seed, the same voltages
    np.testing.assert_array_equal(whole, excitation(GENERATOR, 3)[1])


@pytest.mark.parametrize("points", [512, 1024, 20_000])
def test_a_buffer_holds_each_part(points):
    generator = Generator(-20.0, 120.0, 20_000.0)
    parts = buffered(generator, points)
    for part in parts:
        assert part.voltages.size <= points
        # a NV200 takes multiples of 50 us
        every = 20_000.0 / part.rate
        assert every == pytest.approx(round(every), abs=1e-9)
    assert parts[2].rate == 20_000.0
    seconds = [part.voltages.size / part.rate for part in parts[:2]]
    whole = [drawn(part, generator) for part in (ladder, holds)]
    expected = [part.voltages.size / part.rate for part in whole]
    assert seconds == pytest.approx(expected, rel=0.03)


def test_parts_that_fit_a_buffer_exactly_keep_their_rate():
    longest = max(drawn(part).voltages.size for part in (ladder, holds))
    parts = buffered(GENERATOR, longest)
    assert [part.rate for part in parts] == [GENERATOR.rate] * 3
    assert max(part.voltages.size for part in parts) == longest


def test_a_buffer_may_be_too_short():
    with pytest.raises(ValueError, match="100 points are too few for the ladder: a"):
        buffered(GENERATOR, 100)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lower": 120.0}, "lower is 120 V and upper 120 V; lower must be below upper"),
        ({"rate": 0.0}, "rate is 0; it must be above 0"),
        ({"slew": -1.0}, "slew is -1; it must be above 0"),
        ({"hold": float("nan")}, "hold is nan; it must be above 0"),
        (
            {"highest": 6e3},
            "highest is 6000 Hz; it must be at most half the rate, 5000",
        ),
        (
            {"slowest": 300.0},
            "slowest is 300 Hz; it must be at most a twentieth of high",
        ),
    ],
)
def test_impossible_generators_are_refused(changes, message):
    known = {"lower": -20.0, "upper": 120.0, "rate": 1e4} | changes
    with pytest.raises(ValueError, match=message):
        Generator(**known)


def call(out, *options):
    arguments = ["--lower", "-20", "--upper", "120", "--out", str(out), *options]
    return CliRunner().invoke(main, arguments)


def test_the_command_writes_a_record_that_reads_back(tmp_path):
    printed = call(tmp_path / "out", "--rate", "2000", "--hold", "0.1", "--seed", "3")
    assert printed.exit_code == 0, printed.output
    generator = Generator(-20.0, 120.0, 2e3, hold=0.1)
    path = tmp_path / "out" / "record.csv"
    found = read_sampled(path, {"input": "voltage_V"}, time="time_s")
    assert found.dt == pytest.approx(5e-4)
    np.testing.assert_allclose(
        found.matrix("input")[:, 0], excitation(generator, 3)[1], atol=1e-6
    )
    page = checked(tmp_path / "out" / "report.html")
    assert "multisine" in page.cells
    assert "creep, up to 0.1 s" in page.cells


def test_no_table_is_cut_at_80_columns():
    console = Console(width=80, record=True, file=io.StringIO())
    parts, _ = excitation(GENERATOR)
    paths = "hysteresis.polynomial.0", "hysteresis.polynomial.1"
    errors = {"value": -1.3983e-05, "unit": "um/V^(i+1)", "designed": 2.9e-06}
    report = RecordReport(
        noise_rms_um=0.003,
        designed_s=1.0,
        usual_s=2.0,
        figures=[],
        parameters=[
            ExpectedParameter(path=path, **errors, first=1.6e-4, usual=8.6e-06)
            for path in paths
        ],
    )
    for page in (excitation_page(parts, {}), next_record_page(report, parts[0], {})):
        for part in page.parts:
            console.print(part, soft_wrap=isinstance(part, str))
    printed = console.export_text()
    assert "highest, V" in printed
    assert "a tracking error listed above is that of one run" in printed
    assert "identifies" in printed
    assert "…" not in printed


def test_the_command_writes_the_parts_for_a_buffer(tmp_path):
    printed = call(tmp_path / "out", "--rate", "20000", "--points", "1024")
    assert printed.exit_code == 0, printed.output
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == [
        *("excitation.png", "holds.csv", "ladder.csv", "multisine.csv", "report.html"),
    ]
    for line in printed.output.splitlines():
        assert "record.csv" not in line


def test_bad_options_are_refused_in_one_line(tmp_path):
    printed = call(tmp_path / "out", "--rate", "1000", "--highest", "900")
    assert printed.exit_code == 1
    assert printed.output.splitlines()[-1].startswith("Error: highest is 900 Hz; it")
    assert not (tmp_path / "out").exists()
    assert "--rate is missing; without RESULTS" in call(tmp_path / "out").output
