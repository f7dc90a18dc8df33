"""Gauss-Newton on errors: derivatives, steps within the box, known minima."""

import copy
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from study_tables import PID_ON_LAG

import piezojax as pj
from piezojax import (
    simulate,
)
from piezojax.core.arrays import as_array
from piezojax.core.feedback import loop_inputs
from piezojax.solve import successive_halving
from piezojax.solve.clock import Clock
from piezojax.solve.gauss_newton import PARALLEL, Descent, GaussNewton
from piezojax.solve.local_model import UNIT_BOX, LocalModel, Slack
from piezojax.solve.multi_start import Abreast, Patience, descend, in_threads
from piezojax.solve.problem import Errors, Verdict
from piezojax.solve.sampled_errors import (
    derivatives_at,
    errors_at,
    local_model,
    spacing,
    trials_of,
)
from piezojax.solve.successive_halving import better_half
from piezojax.study import Study, build
from piezojax.tuning.data import make_data
from piezojax.tuning.objective import Objective
from piezojax.tuning.search import make_strategy


class Problem(eqx.Module):
    """Residuals as the errors of a run; the loss is half their mean square.

    ``circle`` has a constraint: the point stays within a circle around (0, 0). Its
    penalty is large, so that its minimum is that on the circle to three digits.
    """

    kind: str = eqx.field(static=True)

    def terms(self, unit):
        if self.kind != "circle":
            return jnp.zeros(0)
        return 1e3 * (jnp.linalg.norm(unit + 1e-3)[None] - 0.5)

    def residuals(self, unit):
        if self.kind == "valley":
            x, y = 4.0 * unit - 2.0
            return jnp.stack([100.0 * (y - x**2), 1.0 - x])
        if self.kind == "circle":
            return jnp.stack([5.0 * (unit[0] - 0.2), 1.0 - unit[1]])
        if self.kind == "bound":
            return jnp.stack([unit[0] + 0.5, 10.0 * (unit[1] - 0.4 + unit[0])])
        time = jnp.linspace(0.0, 1.0, 40)
        height, rate = unit * jnp.array([4.0, 10.0])
        return height * jnp.exp(-rate * time) - 1.6 * jnp.exp(-3.5 * time)

    def errors(self, unit, every):
        errors, terms = self.residuals(unit)[None], self.terms(unit)
        loss = 0.5 * jnp.mean(errors**2) + jnp.sum(jnp.maximum(terms, 0.0) ** 2)
        verdict = Verdict(loss, jnp.zeros(0))
        return Errors(loss, verdict, errors, terms, jnp.ones(1))

    def loss(self, unit):
        return self.errors(unit, 1).loss


PROBLEMS = {
    "valley": (0.75, 0.75),
    "bound": (0.0, 0.4),
    "decay": (0.4, 0.35),
}


@cache
def programs_of(kind):
    problem = Problem(kind)
    return (
        jax.jit(lambda u: derivatives_at(problem, u, 1)),
        jax.jit(lambda u: errors_at(problem, u, 1)),
    )


def descents_on(kind, units, linearise=None, tolerance=1e-14):
    problem = Problem(kind)
    derivatives, errors = programs_of(kind)
    linearise = linearise or (lambda u: local_model(u, derivatives(as_array(u))))
    descents = [
        Descent(
            np.array(unit),
            PARALLEL,
            UNIT_BOX,
            Patience(5, gain=tolerance),
            loss=float(problem.loss(np.array(unit))),
            verdict=problem.errors(np.array(unit), 1).verdict,
        )
        for unit in units
    ]
    return descents, GaussNewton(
        descents,
        lambda units: in_threads(lambda u: trials_of(errors(as_array(u))), units),
        lambda units: in_threads(linearise, units),
    )


@pytest.mark.parametrize("kind", PROBLEMS)
@pytest.mark.parametrize("start", [(0.15, 0.9), (0.9, 0.2), (0.5, 0.5)])
def test_descents_reach_the_minimum(kind, start):
    (descent,), group = descents_on(kind, [start])
    for _ in range(60):
        group.advance()
        assert np.all((descent.point >= 0.0) & (descent.point <= 1.0))
        if descent.done:
            break
    assert descent.done
    np.testing.assert_allclose(descent.point, PROBLEMS[kind], atol=1e-5)
    assert np.all(np.diff(descent.losses) <= 0.0)


def test_a_curved_valley_takes_few_steps():
    """The valley is a hundred times steeper than that of Rosenbrock."""
    (descent,), group = descents_on("valley", [(0.2, 0.56)])
    taken = 0
    while descent.loss > 1e-8:
        group.advance()
        taken += 1
    assert taken <= 12


def test_a_descent_follows_a_constraint_that_it_meets():
    """A step that ignores the circle leaves it far behind, and is rejected."""
    expected = scipy.optimize.minimize(
        lambda at: 0.5 * np.mean([25.0 * (at[0] - 0.2) ** 2, (1.0 - at[1]) ** 2]),
        (0.3, 0.3),
        constraints={
            "type": "ineq",
            "fun": lambda at: 0.5 - np.hypot(at[0] + 1e-3, at[1] + 1e-3),
        },
        tol=1e-12,
    ).x
    (descent,), group = descents_on("circle", [(0.45, 0.05)])
    for _ in range(6):
        group.advance()
    np.testing.assert_allclose(descent.point, expected, atol=1e-3)


def test_a_step_meets_the_constraints_that_bound_it():
    """The oracle minimises the loss of the linearised model, hinges and all."""
    random, meeting = np.random.default_rng(4), 0
    for _ in range(20):
        root = random.normal(size=(3, 3))
        slack = Slack(
            -random.uniform(0.01, 0.5, 6), random.normal(size=(3, 6)), np.arange(6)
        )
        model = LocalModel(
            np.full(3, 0.5), random.normal(size=3), root @ root.T, slack=slack
        )

        def damped(step, model=model):
            return model.predicted(step) + 0.5 * 0.2 * step @ step

        step = model.step(0.2, (-np.inf, np.inf))
        meeting += np.any(slack.after(step) > 0.0)
        found = scipy.optimize.minimize(damped, np.zeros(3), tol=1e-14)
        np.testing.assert_allclose(step, found.x, atol=1e-5)
        hinges = np.maximum(slack.values + step @ slack.jacobian, 0.0)
        plain = model.gradient @ step + 0.5 * step @ model.curvature @ step
        assert model.predicted(step) == pytest.approx(plain + 0.5 * hinges @ hinges)
    assert meeting > 10


def test_a_point_without_finite_gradients_ends_its_descent():
    good = programs_of("valley")[0](as_array([0.2, 0.5]))
    bad = good._replace(jacobian=good.jacobian * jnp.nan)
    _, group = descents_on("valley", [(0.2, 0.5)], lambda unit: local_model(unit, bad))
    standing = group.advance()
    assert standing.evaluations == 1
    assert standing.done
    np.testing.assert_array_equal(standing.units, [(0.2, 0.5)])


def test_a_rejected_step_keeps_the_model():
    """Only a new point is linearised; the damping grows until a step is accepted."""
    asked, zeros, ones = [], np.zeros((2, 2)), np.ones(2)

    def wrong(unit):
        asked.append(unit)
        return LocalModel(unit, np.array([-1.0, 0.0]), np.eye(2), 1.0, zeros, ones)

    (descent,), group = descents_on("bound", [(0.2, 0.3)], wrong)
    taken = [group.advance().evaluations for _ in range(3)]
    assert taken == [1 + 4 * 12, 2 * 12, 0]
    assert len(asked) == 1
    assert descent.done
    assert descent.damping == 30.0**6 > PARALLEL.last
    np.testing.assert_array_equal(descent.point, (0.2, 0.3))


def test_steps_stay_inside_the_box():
    curvature = np.array([[2.0, 1.9], [1.9, 2.0]])
    unit = np.array([0.2, 0.5])

    def model(target):
        return LocalModel(unit, curvature @ (unit - target), curvature)

    step = model([-0.5, 0.9]).step(0.0, UNIT_BOX)
    # At x = 0 the best y solves 1.9 (0 + 0.5) + 2 (y - 0.9) = 0.
    np.testing.assert_allclose(unit + step, [0.0, 0.9 - 0.5 * 0.95], atol=1e-12)
    step = model([0.3, 0.6]).step(0.0, UNIT_BOX)
    np.testing.assert_allclose(unit + step, [0.3, 0.6])
    # At the side of the box a step outwards has no effect.
    edge = LocalModel(np.array([0.0, 0.5]), np.array([3.0, 0.0]), curvature)
    assert edge.step(0.1, UNIT_BOX)[0] == 0.0


@pytest.mark.parametrize(("runs", "counted"), [(1, 10), (4, 600), (10, 10_000)])
def test_spacing_is_prime_and_keeps_enough_samples(runs, counted):
    every = spacing(runs, counted)
    assert all(every % d for d in range(2, every))
    assert counted // every >= 2
    assert runs * counted / every <= 25_000


def test_the_better_half_continues(monkeypatch):
    """Of nine descents five continue, then three; the best ones are never dropped."""
    monkeypatch.setattr(successive_halving, "HALVING_STEPS", 3)
    places = np.random.default_rng(1).uniform(0.0, 0.2, (9, 2))
    seen = []
    standing, ended = descend(
        descents_on("valley", places)[1],
        7,
        seen.append,
        cut=better_half,
    )
    assert not ended
    assert [len(s.losses) for s in seen] == 3 * [9] + 3 * [5] + [3]
    for before, after in zip(seen[2:-1:3], seen[3::3], strict=True):
        best = np.argsort(before.losses)[: len(after.losses)]
        np.testing.assert_array_equal(after.places, before.places[best])
    assert standing.losses[0] <= min(s.losses.min() for s in seen)


@pytest.mark.parametrize(
    ("step", "running", "kept"),
    [(9, 8, None), (10, 9, 5), (20, 5, 3), (30, 3, 2), (40, 2, None), (10, 1, None)],
)
def test_the_finalists_are_never_dropped(step, running, kept):
    """In a problem with constraints the best valley shows only at the end."""
    assert better_half(step, running) == kept


def test_descents_abreast_have_their_own_problems():
    """They advance as they do alone, and the one that is kept goes on."""
    places = np.array([[0.1, 0.2], [0.15, 0.1], [0.05, 0.1]])

    def alone(place):
        return descents_on("valley", place[None])[1]

    together, single = Abreast([*map(alone, places)]), [*map(alone, places)]
    for _ in range(3):
        status, every = together.advance(), [each.advance() for each in single]
        np.testing.assert_array_equal(status.units, [s.units[0] for s in every])
        np.testing.assert_array_equal(status.losses, [s.losses[0] for s in every])
        assert status.places.tolist() == [0, 1, 2]
        assert status.evaluations == sum(each.evaluations for each in every)
    together.keep(np.array([2, 0]))
    status = together.advance()
    assert status.places.tolist() == [2, 0]
    np.testing.assert_array_equal(status.losses[0], single[2].advance().losses[0])


STUDY = PID_ON_LAG | {
    "constraints": {"sensitivity_peak": "off", "delay_margin": "off"},
    "references": {"tune": ["SIN50", "SW50"], "duration": 0.05, "settle": 0.02},
    "parameters": {
        "controller.proportional": {"lower": 0.1, "upper": 50.0, "scale": "log"},
        "controller.integral": {"lower": 100.0, "upper": 2e5, "scale": "log"},
    },
    "objective": {"noise_draws": 2},
    "optimiser": {
        "method": "gauss_newton",
        "starts": 3,
        "candidates": 8,
        "steps": 30,
    },
}


def case_of(**optimiser):
    study = copy.deepcopy(STUDY)
    study["optimiser"] |= optimiser
    return build(Study.model_validate(study), "small.toml")


def objective_of(case, **options):
    return Objective(
        loop=case.loop,
        space=case.space,
        signals=make_data(case).tuning,
        scale=jnp.array([[0.5, 2.0]]),
        voltage_span=as_array(140.0),
        start=400,
        **options,
    )


def test_each_descent_has_its_own_multipliers():
    """Two descents of a later round move as each does alone."""
    case = case_of()
    objective = objective_of(case).with_limits({"effort": 1.0})
    strategy = make_strategy(objective, case, Clock())
    strategy.wait()
    units = np.array([[0.4, 0.6], [0.5, 0.4]])
    multipliers = jnp.array([[0.0], [3.0]]) * jnp.ones(strategy.constraints)
    together, taken = strategy.begin(objective, units, multipliers)
    status = together.advance()
    assert taken == 2
    for row in range(2):
        rows = slice(row, row + 1)
        alone, _ = strategy.begin(objective, units[rows], multipliers[rows])
        expected = alone.advance()
        np.testing.assert_array_equal(status.units[rows], expected.units)
        np.testing.assert_array_equal(status.losses[rows], expected.losses)


def test_weighted_errors_give_the_gradient_of_the_objective():
    """The oracle is a plain run with the errors of all samples: sum of w mean(e de)."""
    case = case_of()
    objective = objective_of(case, aggregate="worst")
    unit = jnp.array([0.4, 0.6])

    def errors(unit):
        loop = case.space.put(case.loop, unit)

        def one(reference, noise):
            inputs = loop_inputs(reference, noise)
            log = simulate(loop, inputs, loop.init(reference[0]))[1]
            return (log.displacement - log.reference)[400:]

        signals = objective.signals
        references = jnp.repeat(signals.references, 2, axis=0)
        return jax.vmap(one)(references, signals.noise.reshape(4, -1))

    every = 7
    whole = jax.jit(lambda u: objective.errors(u, every))(unit)
    loss, sample, weights = whole.loss, whole.errors, whole.weights
    both = jax.jacfwd(lambda u: (errors(u),) * 2, has_aux=True)
    slopes, dense = jax.jit(both)(unit)
    # The gradient of the objective is computed through its figures.
    here = jax.jit(lambda u: derivatives_at(objective, u, every))(unit)
    found = jnp.einsum("r,rt,rti->i", weights, dense, slopes) / dense.shape[1]
    np.testing.assert_allclose(found, here.gradient, rtol=1e-8)
    np.testing.assert_allclose(loss, here.loss, rtol=1e-12)
    np.testing.assert_allclose(weights, here.weights, rtol=1e-12)
    # every seventh counted sample of the run
    at = np.arange(6, 1000, 7)
    at = at[400 // 7 :] - 400
    np.testing.assert_allclose(sample, dense[:, at], atol=1e-12)
    np.testing.assert_allclose(
        here.jacobian, jnp.moveaxis(slopes[:, at], 2, 0), rtol=1e-8, atol=1e-9
    )


@pytest.fixture(scope="module")
def objective():
    return objective_of(case_of())


@pytest.fixture(scope="module")
def programs(objective):
    clock = Clock()
    found = make_strategy(objective, case_of(), clock)
    found.wait()
    assert clock.compile_s > 0.0
    return found


def test_screening_any_number_of_points(objective, programs):
    points = np.random.default_rng(0).uniform(0.1, 0.9, (5, 2))
    found, verdict = programs.screen(objective, points)
    np.testing.assert_array_equal(found, verdict.loss)
    expected = jax.jit(jax.vmap(lambda u: objective.loss(u)))(jnp.asarray(points))
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.fixture(scope="module")
def outcome():
    return pj.tune(case_of())


def test_a_study_is_tuned(outcome):
    result = outcome.result
    assert result.method == "gauss_newton"
    assert result.status == "converged"
    assert result.holdout.geomean_rms_um < 0.5 * result.holdout_before.geomean_rms_um
    history = np.array(result.history, dtype=float)
    assert history.shape[1] == 3
    assert np.all(np.diff(history, axis=0) <= 0.0)
    assert len(result.times_s) == len(history)
    # Each step of each descent needs derivatives, unless the last step was rejected,
    # and three times as many points as dampings.
    steps = (result.evaluations - 9 - 3) / (1 + 3 * len(PARALLEL.multiples))
    assert len(history) < steps <= 3 * len(history)


def test_no_neighbouring_point_is_better(outcome, objective, programs):
    """Points of grids in the box; the loss is that of the tuner minus a constant."""
    case = case_of()
    values = jnp.array([outcome.result.gains[path] for path in case.space.paths])
    unit = np.asarray(case.space.to_unit(values))
    side = np.linspace(-1.0, 1.0, 9)
    grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    around = np.clip(
        np.concatenate([unit + scale * grid for scale in (1e-3, 0.03, 1.0)]), 0.0, 1.0
    )
    here = programs.screen(objective, unit[None])[0][0]
    assert np.all(programs.screen(objective, around)[0] >= here - 1e-5)


class Stopping:
    def __init__(self, steps):
        self._left = steps

    def stage(self, text, steps=0):
        pass

    def advance(self, best):
        self._left -= 1
        if self._left == 0:
            raise KeyboardInterrupt


def test_ctrl_c_keeps_the_best_so_far(outcome):
    found = pj.tune(case_of(), progress=Stopping(2)).result
    assert found.status == "interrupted"
    assert found.history == outcome.result.history[:2]
