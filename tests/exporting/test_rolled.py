"""Loops of exported C against the elements that they stand for."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from exported_folders import compiled, made
from hypothesis import given
from hypothesis import strategies as st

import piezojax as pj
from piezojax.core.system import System
from piezojax.scalar.rolled import ROLLED, pieces


def elements(piece):
    """Return the operands of each element of a piece."""

    def at(text, i):
        element = re.fullmatch(r"(\w+)\[(.*i.*)\]", text)
        if element is None or piece.end == piece.first + 1:
            return text
        return f"{element[1]}[{eval(element[2], {'i': i})}]"

    return [[at(x, i) for x in piece.operands] for i in range(piece.first, piece.end)]


PROGRESSIONS = st.tuples(
    st.sampled_from("xy"), st.integers(-3, 3), st.integers(0, 9), st.integers(1, 12)
)


def texts(progressions):
    """Return elements of arrays with linear indices, one progression after another."""
    return [
        f"{name}[{40 + first + step * i}]" if step else name
        for name, step, first, count in progressions
        for i in range(count)
    ]


@given(st.lists(PROGRESSIONS, max_size=6), st.lists(PROGRESSIONS, max_size=6))
def test_pieces_hold_every_element_once_and_in_order(left, right):
    rows = [list(row) for row in zip(texts(left), texts(right), strict=False)]
    found = list(pieces(rows))
    assert [row for piece in found for row in elements(piece)] == rows
    ends = [0, *(piece.end for piece in found)]
    assert [piece.first for piece in found] == ends[:-1]
    assert all(p.end - p.first == 1 or p.end - p.first >= ROLLED for p in found)


@pytest.mark.parametrize("step", [-2, 0, 1, 24])
@pytest.mark.parametrize("count", [ROLLED - 1, ROLLED, 100])
def test_a_regular_array_is_one_loop(step, count):
    rows = [["u", f"x[{300 + step * i}]"] for i in range(count)]
    assert len(list(pieces(rows))) == (1 if count >= ROLLED else count)


LINE = 40
FACTORS = np.linspace(0.1, 0.2, LINE)


class Windowed(System):
    """A nonlinear filter over a line of samples, with factors and constants."""

    factors: jax.Array

    def init(self, input=0.0):
        return jnp.full(LINE, input)

    def step(self, state, input):
        state = jnp.concatenate([jnp.reshape(input, 1), state[:-1]])
        window = jnp.where(state > 3.0, 0.5 * state, state) * self.factors
        window = window - jnp.arange(1.0, LINE + 1.0) ** 1.5  # a table in C
        blocks = window.reshape(8, 5)
        return state, jnp.sum(blocks.T @ blocks[:, 0]) + jnp.max(window)


@compiled
@pytest.mark.parametrize("precision", ["double", "float"])
def test_arrays_are_computed_in_loops(precision, tmp_path):
    about = pj.About(judged=["fine"], reference_ranges=[(0.0, 10.0)])
    pj.export(
        Windowed(jnp.asarray(FACTORS)), tmp_path / "c", about=about, precision=precision
    )
    source = (tmp_path / "c" / "plant.c").read_text()
    assert "for (int i = " in source
    assert re.search(rf"static const {precision} \w+\[40\] = {{\n", source)
    assert len(source.splitlines()) < 400
    (values,) = re.findall(r"values\[40\] = \{([^}]*)\};", source)
    dtype = {"double": np.float64, "float": np.float32}[precision]
    found = np.array([x.strip(" \nf") for x in values.split(",")], dtype)
    np.testing.assert_array_equal(found, FACTORS.astype(dtype))
    status, text = made(tmp_path / "c")
    assert status == 0, text


def test_a_short_step_has_no_arrays(tmp_path):
    about = pj.About(judged=["fine"], reference_ranges=[(0.0, 10.0)])
    pj.export(pj.catalog.p753.pid(), tmp_path / "c", about=about, limits=[(0.0, 9.0)])
    assert "for (int" not in (tmp_path / "c" / "controller.c").read_text()


class Substepped(System):
    """A nonlinear lag with ``count`` steps a sample, which start and end together."""

    gain: jax.Array
    count: int

    def init(self, input=0.0):
        return jnp.asarray(input), jnp.asarray(0.0)

    def step(self, state, input):
        def part(number, state):
            x, y = state
            return 0.5 * (x + jnp.tanh(input) / (number + 1)), y + 1e-3 * self.gain * x

        x, y = jax.lax.fori_loop(0, self.count, part, state)
        return (x, 0.9 * y), x + y


@compiled
@pytest.mark.parametrize(("count", "loops"), [(7, 0), (8, 1), (40, 1)])
def test_repetitions_remain_a_loop(count, loops, tmp_path):
    about = pj.About(judged=["fine"], reference_ranges=[(0.0, 10.0)])
    pj.export(Substepped(jnp.asarray(0.3), count), tmp_path / "c", about=about)
    assert (tmp_path / "c" / "plant.c").read_text().count("for (;;) {") == loops
    status, text = made(tmp_path / "c")
    assert status == 0, text
