"""The profile of a command: where its time went."""

import builtins
import importlib
import json
import re
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import click
import jax
import jax.numpy as jnp
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from jax._src.monitoring import get_event_duration_listeners
from small_runs import call, main_of

from piezojax.cli.command import Command, common, run
from piezojax.core import profile
from piezojax.core.profile import (
    COMPILING,
    COMPILING_C,
    DRAWING,
    IMPORT,
    LOWERING,
    PROGRAMS,
    READING,
    RUNNING,
    STAGES,
    TRACING,
    Interval,
    profiled,
    split,
    stage,
)
from piezojax.engines import native_library

# The time of each stage


@pytest.mark.parametrize(
    ("intervals", "expected"),
    [
        ([], {RUNNING: 10.0}),
        # overlapping ones of a stage are one, and the rest runs
        ([(TRACING, True, 1, 4), (TRACING, True, 2, 6)], {TRACING: 5, RUNNING: 5}),
        # the inner stage counts
        (
            [(TRACING, True, 0, 10), (COMPILING, True, 2, 3), (IMPORT, True, 5, 7)],
            {TRACING: 7, COMPILING: 1, IMPORT: 2},
        ),
        ([(DRAWING, True, 0, 10), (TRACING, True, 2, 9)], {DRAWING: 3, TRACING: 7}),
        # the main thread counts before the others, which count while it is in no stage
        (
            [(DRAWING, True, 0, 4), (COMPILING, False, 2, 10)],
            {DRAWING: 4, COMPILING: 6},
        ),
        (
            [(TRACING, False, 0, 9), (COMPILING, False, 5, 10)],
            {TRACING: 5, COMPILING: 5},
        ),
        # what began earlier or ends later is cut off
        (
            [(IMPORT, True, -3, 1), (LOWERING, True, 8, 99)],
            {IMPORT: 1, LOWERING: 2, RUNNING: 7},
        ),
        ([(LOWERING, True, -3, -1), (READING, True, 11, 12)], {RUNNING: 10}),
    ],
)
def test_a_moment_counts_once(intervals, expected):
    found = split([Interval(*each) for each in intervals], 0.0, 10.0)
    assert list(found) == list(STAGES)
    assert {name: time for name, time in found.items() if time} == expected


ORDER = (IMPORT, COMPILING_C, READING, COMPILING, LOWERING, TRACING, DRAWING)
PIECES = st.tuples(
    st.sampled_from(ORDER), st.booleans(), st.integers(-5, 30), st.integers(0, 20)
)


@given(st.lists(PIECES, max_size=12), st.integers(0, 25))
def test_the_times_are_those_of_a_clock_that_looks_every_second(pieces, end):
    expected = dict.fromkeys(STAGES, 0.0)
    for second in range(end):
        at = [p for p in pieces if p[2] <= second < p[2] + p[3]]
        at = [p[0] for p in at if p[1]] or [p[0] for p in at]
        expected[min(at, key=ORDER.index, default=RUNNING)] += 1.0
    intervals = [Interval(name, main, a, a + long) for name, main, a, long in pieces]
    found = split(intervals, 0.0, float(end))
    assert found == expected
    assert sum(found.values()) == end


# What is measured


def measured(body):
    """Return the profile of ``body``."""
    found = []
    with profiled(found.append):
        body()
    return found[0]


def program(number):
    """Return a program of its own for each ``number``."""

    def sine_of_profile(x):
        return jnp.sin(x) + number

    return jax.jit(sine_of_profile)


def test_a_program_is_compiled_or_read():
    x, number = jnp.zeros(3), float(time.time_ns())  # not in the cache
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    try:
        new = measured(lambda: program(number)(x))
        kept = measured(lambda: program(number)(x))
    finally:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.01)
    one = {TRACING: 1, LOWERING: 1, COMPILING: 1, READING: 0, COMPILING_C: 0}
    assert new.programs == one
    assert kept.programs == one | {COMPILING: 0, READING: 1}
    for found, without in ((new, READING), (kept, COMPILING)):
        for name in PROGRAMS[:-1]:
            assert (found.seconds[name] > 0.0) == (name != without)


@pytest.mark.skipif(native_library.compiler() is None, reason="no C compiler")
def test_a_source_is_compiled(monkeypatch):
    monkeypatch.setattr(native_library, "_path", lambda name: None)
    source = "int one(void) { return 1; }"
    found = measured(lambda: native_library._compiled("one", source))
    assert found.programs[COMPILING_C] == 1
    assert found.seconds[COMPILING_C] > 0.0


@pytest.mark.parametrize("load", ["import slow", "importlib.import_module('slow')"])
def test_a_module_counts_when_it_is_loaded(load, tmp_path, monkeypatch):
    (tmp_path / "slow.py").write_text("import time\ntime.sleep(0.05)")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "slow", raising=False)
    found = measured(lambda: exec(load, {"importlib": importlib}))
    assert found.seconds[IMPORT] >= 0.05
    again = measured(lambda: exec(load, {"importlib": importlib}))
    assert again.seconds[IMPORT] < found.seconds[IMPORT]
    monkeypatch.delitem(sys.modules, "slow")


def test_other_threads_count_while_the_main_one_waits():
    begun, drawn, took = threading.Event(), threading.Event(), []

    def other():
        with stage(COMPILING):
            begin = time.perf_counter()
            begun.set()
            drawn.wait()
            time.sleep(0.05)
            took.append(time.perf_counter() - begin)

    def body():
        thread = threading.Thread(target=other)
        thread.start()
        begun.wait()
        with stage(DRAWING):
            time.sleep(0.05)
        drawn.set()
        thread.join()

    found = measured(body)
    assert found.seconds[DRAWING] >= 0.05
    assert found.seconds[COMPILING] >= 0.05
    both = found.seconds[COMPILING] + found.seconds[DRAWING]
    assert both == pytest.approx(took[0], abs=0.04)


def test_the_age_is_that_of_a_command(monkeypatch):
    assert profile._age() == 0.0  # of a process that runs tests
    command = SimpleNamespace(__spec__=SimpleNamespace(name="piezojax.tune"))
    monkeypatch.setitem(sys.modules, "__main__", command)
    monkeypatch.setattr(profile, "Path", lambda name: _Missing())
    assert 0.0 < profile._age() <= time.process_time()


class _Missing:
    def read_text(self, encoding):
        raise FileNotFoundError


# Commands


@click.command(cls=Command)
@click.argument("end")
@common
def small(end, out, seed, quiet):
    """Compile, draw, and end as asked."""

    def body(console):
        program(0.5)(jnp.zeros(3))
        with stage(DRAWING):
            time.sleep(0.05)
        console.print(f"{len(get_event_duration_listeners())} listeners")
        if end == "interrupt":
            raise KeyboardInterrupt
        if end == "fail":
            raise ValueError("bad input")
        if end == "alarm":
            raise SystemExit(3)

    run(quiet, body)


def times_in(text):
    """Return the times of the printed table, s."""
    rows = re.findall(r"│ ([\w ]+?) +│ +([\d.]+) │ +([\d.]+) │", text)
    assert [name for name, *_ in rows] == [*STAGES, "total"]
    shares = [float(share) for *_, share in rows]
    assert sum(shares[:-1]) == pytest.approx(shares[-1], abs=0.5)
    return {name: float(time) for name, time, _ in rows}


@pytest.fixture
def untouched():
    """Check that the test leaves no listener and no wrapped import."""
    before = (
        get_event_duration_listeners(),
        builtins.__import__,
        importlib.import_module,
    )
    yield len(before[0])
    now = get_event_duration_listeners(), builtins.__import__, importlib.import_module
    assert now == before
    assert profile._intervals is None


@pytest.mark.parametrize(
    ("end", "status"), [("well", 0), ("fail", 1), ("alarm", 3), ("interrupt", 130)]
)
def test_every_end_of_a_command_prints_the_table(end, status, untouched):
    result = CliRunner().invoke(small, [end, "--profile"])
    assert result.exit_code == status
    assert f"{untouched + 1} listeners" in result.stdout
    times = times_in(result.stderr)
    assert sum(times.values()) == pytest.approx(2.0 * times["total"], abs=0.05)
    assert times[DRAWING] >= 0.05
    assert result.stderr.endswith("Error: bad input\n") == (end == "fail")


def test_no_profile_has_no_listener(untouched):
    result = CliRunner().invoke(small, ["well"])
    assert f"{untouched} listeners" in result.stdout
    assert result.stderr == ""


def test_a_quiet_command_prints_the_table_alone(tmp_path, untouched):
    limits = ("--lower", "0", "--upper", "1", "--rate", "1000")
    out = ("--out", tmp_path / "out")
    result = call("excite", *limits, *out, "--profile", "--quiet")
    assert result.exit_code == 0
    assert result.stdout == ""
    times = times_in(result.stderr)
    assert times[DRAWING] > 0.1


@pytest.mark.parametrize(
    "command",
    ["tune", "identify", "validate", "sweep", "reproduce", "export", "start"]
    + ["excite", "trial", "retune", "learn", "watch"],
)
def test_every_computing_command_has_the_option(command):
    assert "profile" in {option.name for option in main_of(command).params}


def test_a_process_counts_from_its_start():
    command = [sys.executable, "-m", "piezojax.tune", "--schema", "--profile"]
    begin = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    wall = time.perf_counter() - begin
    assert json.loads(done.stdout)["title"]
    times = times_in(done.stderr)
    assert 0.5 * wall < times["total"] < wall + 0.1
    assert times[IMPORT] > 0.5 * times["total"]
