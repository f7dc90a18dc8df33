"""Time that clocks count as compiling."""

from types import SimpleNamespace

import pytest

from piezojax.solve import clock
from piezojax.solve.clock import Clock


@pytest.fixture
def now(monkeypatch):
    """A time (s) that the test sets."""
    now = SimpleNamespace(s=100.0)
    shown = SimpleNamespace(perf_counter=lambda: now.s, process_time=lambda: now.s)
    monkeypatch.setattr(clock, "time", shown)
    monkeypatch.setattr(clock, "_compiling", clock._Compiling())
    return now


def test_programs_that_compile_at_once_count_once(now):
    first = Clock()
    with clock._compiling.counted():
        now.s = 101.0
        with clock._compiling.counted():
            now.s = 103.0
        now.s = 104.0
        assert first.compile_s == 4.0
    now.s = 110.0
    assert (first.compile_s, first.wall_s()) == (4.0, 10.0)


def test_a_clock_counts_from_its_start(now, monkeypatch):
    def slow(program):
        now.s += 5.0
        return program

    monkeypatch.setattr(clock, "compiled", slow)
    first = Clock()
    assert first.compiled("program") == "program"
    second = Clock()
    now.s += 1.0
    second.wait_for(SimpleNamespace(result=lambda: slow(None)))
    assert (first.compile_s, second.compile_s) == (10.0, 5.0)


def test_a_failed_compilation_counts(now, monkeypatch):
    def failing(program):
        now.s += 2.0
        raise ValueError("no program")

    monkeypatch.setattr(clock, "compiled", failing)
    one = Clock()
    with pytest.raises(ValueError, match="no program"):
        one.compiled(None)
    now.s += 2.0
    assert one.compile_s == 2.0
