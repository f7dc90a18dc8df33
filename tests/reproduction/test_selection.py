"""Selection of suspect numbers: synthetic cells with a known misprint or none."""

import jax.numpy as jnp
import numpy as np
import pytest

from piezojax.core.space import Range, space_of
from piezojax.reproduction import selection
from piezojax.reproduction.selection import FOLDS, cross_validated, select
from piezojax.reproduction.stage_fit import Problem

STAGE, PRINTS, CELLS = 2, 6, 30


def powers():
    """Return the exponents of each cell for the stage and for the printed numbers."""
    random = np.random.default_rng(3)
    stage = random.uniform(0.3, 1.5, (CELLS, STAGE))
    prints = np.zeros((CELLS, PRINTS))
    for print_ in range(PRINTS):
        group = np.arange(CELLS) // 5 == print_
        prints[group, print_] = random.uniform(1.0, 3.0, group.sum())
    return stage, prints


def errors(self, values):
    """Return errors: powers of the stage and of printed numbers above a floor."""
    stage, prints = powers()
    log = jnp.log(jnp.stack([values[name] for name in self.space.paths]))
    held = jnp.log((0.05 + jnp.exp(log[STAGE:])) / 1.05)
    return 0.1 * jnp.exp(stage @ log[:STAGE] + prints @ held)


def made_up(wrong, scatter):
    names = [f"stage {i}" for i in range(STAGE)] + [f"print {i}" for i in range(PRINTS)]
    spans = [3.0] * STAGE + [100.0] * PRINTS
    space = space_of(
        {n: Range(1 / s, s, "log") for n, s in zip(names, spans, strict=True)}
    )
    problem = Problem(
        space=space,
        stage=STAGE,
        numerator=(),
        lanes=[],
        paper=jnp.ones(CELLS),
        counts=jnp.ones(CELLS),
        start=space.to_unit(jnp.ones(len(names))),
        penalty_weight=jnp.asarray(1.0),
    )
    truth = {name: jnp.asarray(1.0) for name in names}
    truth |= {"stage 0": jnp.asarray(1.3), "stage 1": jnp.asarray(0.8)} | wrong
    noise = np.random.default_rng(5).standard_normal(CELLS)
    paper = errors(problem, truth) * np.exp(scatter * noise)
    return Problem(**{**vars(problem), "paper": paper})


@pytest.fixture(autouse=True)
def analytic(monkeypatch):
    monkeypatch.setattr(Problem, "errors", errors)


def test_a_misprint_of_two_decades_is_found():
    choice = select(made_up({"print 3": jnp.asarray(0.03)}, 0.05))
    assert choice.suspects == ("print 3",)
    first, last = choice.rounds
    assert first.taken == "print 3"
    assert first.before > 1.1 > 1.06 > first.after["print 3"] == last.before
    assert last.taken is None
    assert min(last.after.values()) * selection.MIN_IMPROVEMENT > last.before
    assert len(first.after) == selection.FINALISTS


@pytest.mark.parametrize("scatter", [0.0, 0.05])
def test_without_a_misprint_nothing_is_selected(scatter):
    problem = made_up({}, scatter)
    choice = select(problem)
    assert choice.suspects == ()
    np.testing.assert_array_equal(choice.point, choice.stage_only)
    np.testing.assert_array_equal(choice.point[STAGE:], problem.start[STAGE:])


def test_at_most_the_largest_number_is_selected(monkeypatch):
    monkeypatch.setattr(selection, "MAX_SUSPECTS", 1)
    wrong = {"print 1": jnp.asarray(10.0), "print 3": jnp.asarray(0.03)}
    choice = select(made_up(wrong, 0.0))
    assert len(choice.suspects) == 1
    assert choice.suspects[0] in wrong


def test_cross_validation_excludes_the_predicted_cell():
    problem = made_up({}, 0.0)
    free, begin = range(STAGE), [problem.start]
    assert cross_validated(problem, free, begin) < 1.05
    spoilt = Problem(**{**vars(problem), "paper": problem.paper.at[7].multiply(9.0)})
    ratio = cross_validated(spoilt, free, begin)
    assert ratio > 9.0 ** (1.0 / CELLS)
    assert np.arange(CELLS)[7] % FOLDS == 2
