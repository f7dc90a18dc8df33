"""Optimisers on problems with known minima, from many starts at once."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

from piezojax.core.space import squash, unsquash
from piezojax.solve.gauss_newton import (
    TRUST_REGION,
    Descent,
    GaussNewton,
    trials_with_models,
)
from piezojax.solve.gradient import with_finite_gradient
from piezojax.solve.local_model import normal_equations
from piezojax.solve.optimisers import METHODS
from piezojax.solve.problem import FAILED_LOSS, linearised

STEPS = 160
TOLERANCE = 1e-8


class Problem(NamedTuple):
    """Residuals over the unit cube, and the minimum of their squares."""

    residuals: object
    minimum: tuple

    def loss(self, unit):
        return jnp.sum(self.residuals(unit) ** 2)


def _quadratic(unit):
    return jnp.array([1.0, 3.0, 10.0]) * (unit - jnp.array([0.3, 0.7, 0.55]))


def _rosenbrock(unit):
    x, y = 4.0 * unit - 2.0
    return jnp.stack([10.0 * (y - x**2), 1.0 - x])


_TIME = jnp.linspace(0.0, 1.0, 40)
_DECAY = 1.6 * jnp.exp(-3.5 * _TIME) + 0.2


def _exponential(unit):
    height, rate, offset = unit * jnp.array([4.0, 10.0, 1.0])
    return height * jnp.exp(-rate * _TIME) + offset - _DECAY


def _on_a_bound(unit):
    return unit - jnp.array([-0.5, 0.4])


PROBLEMS = {
    "quadratic": Problem(_quadratic, (0.3, 0.7, 0.55)),
    "rosenbrock": Problem(_rosenbrock, (0.75, 0.75)),
    "least squares": Problem(_exponential, (0.4, 0.35, 0.2)),
}
ON_A_BOUND = Problem(_on_a_bound, (0.0, 0.4))


def starts_of(problem):
    size = len(problem.minimum)
    return jnp.asarray(np.random.default_rng(4).uniform(0.1, 0.9, (5, size)))


def run(method, problem, units, steps=STEPS, loss=None, tolerance=TOLERANCE):
    """Return every view from the first step on, stacked: [step, lane]."""
    optimiser = METHODS[method](loss or problem.loss, problem.residuals, tolerance)

    @jax.jit
    def advance(carry):
        carry = jax.vmap(optimiser.step)(carry)
        return carry, jax.vmap(optimiser.view)(carry)

    carry, views = jax.jit(jax.vmap(optimiser.start))(units), []
    for _ in range(steps):
        carry, view = advance(carry)
        views.append(jax.tree.map(np.asarray, view))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *views)


@pytest.fixture(scope="module", params=[f"{m}, {p}" for m in METHODS for p in PROBLEMS])
def solved(request):
    method, name = request.param.split(", ")
    problem = PROBLEMS[name]
    return method, problem, run(method, problem, starts_of(problem))


def test_every_start_finds_the_minimum(solved):
    _, problem, views = solved
    np.testing.assert_allclose(
        views.unit[-1],
        np.broadcast_to(problem.minimum, views.unit[-1].shape),
        atol=1e-4,
    )
    assert np.all(views.loss[-1] < 1e-7)


def test_iterates_stay_in_the_cube(solved):
    _, _, views = solved
    assert np.all((views.unit >= 0.0) & (views.unit <= 1.0))


def losses_of(problem, views):
    return np.stack([jax.vmap(problem.loss)(units) for units in views.unit[:30]])


def test_the_reported_loss_is_not_below_that_of_the_reported_point(solved):
    _, problem, views = solved
    expected = losses_of(problem, views)
    assert np.all(views.loss[:30] >= expected * (1.0 - 1e-9) - 1e-12)


def test_the_reported_loss_is_that_of_the_reported_point(solved):
    _, problem, views = solved
    expected = losses_of(problem, views)
    np.testing.assert_allclose(views.loss[:30], expected, rtol=1e-6, atol=1e-12)


def test_a_finished_start_does_not_move(solved):
    _, _, views = solved
    assert np.all(views.done[-1])
    for lane in range(views.done.shape[1]):
        first = int(np.argmax(views.done[:, lane]))
        assert np.all(views.done[first:, lane])
        assert np.all(views.unit[first:, lane] == views.unit[first, lane])
        assert np.all(views.loss[first:, lane] == views.loss[first, lane])


def test_a_loose_tolerance_stops_sooner():
    problem = PROBLEMS["quadratic"]
    tight, loose = (
        run("bfgs", problem, starts_of(problem), steps=40, tolerance=tolerance)
        for tolerance in (1e-10, 1e-2)
    )
    assert loose.done.sum() > tight.done.sum()


def test_lbfgsb_reaches_a_minimum_on_a_bound():
    views = run("lbfgsb", ON_A_BOUND, starts_of(ON_A_BOUND))
    np.testing.assert_array_equal(views.unit[-1][:, 0], 0.0)
    np.testing.assert_allclose(views.unit[-1][:, 1], 0.4, atol=1e-6)
    assert np.all((views.unit >= 0.0) & (views.unit <= 1.0))


@pytest.mark.parametrize("method", ["bfgs", "levenberg_marquardt"])
def test_the_other_methods_approach_a_minimum_on_a_bound(method):
    views = run(method, ON_A_BOUND, starts_of(ON_A_BOUND))
    assert np.all((views.unit >= 0.0) & (views.unit <= 1.0))
    assert np.all(views.unit[-1][:, 0] < 1e-2)
    np.testing.assert_allclose(views.unit[-1][:, 1], 0.4, atol=1e-3)


def diverging_beyond(edge, problem):
    """Return a loss that is FAILED_LOSS with a NaN gradient beyond ``edge``."""

    def loss(unit):
        blown_up = jnp.sqrt(edge - unit[0])  # NaN beyond the edge, with a NaN gradient
        total = problem.loss(unit) + 0.0 * blown_up
        return jnp.where(jnp.isfinite(total), total, FAILED_LOSS)

    return loss


@pytest.mark.parametrize(("method", "forward"), [("bfgs", True), ("lbfgsb", False)])
def test_a_diverging_start_does_not_stop_the_others(method, forward):
    problem = PROBLEMS["quadratic"]
    # The minimum is at 0.3: the first long steps of the others exceed the edge too.
    raw = diverging_beyond(0.32, problem)
    units = starts_of(problem).at[:, 0].set(jnp.array([0.02, 0.1, 0.95, 0.25, 0.31]))
    assert np.isnan(jax.grad(raw)(units[2])[0])
    loss = with_finite_gradient(raw, forward=forward)
    views = run(method, problem, units, loss=loss)
    others = [0, 1, 3, 4]
    np.testing.assert_allclose(
        views.unit[-1][others], np.broadcast_to(problem.minimum, (4, 3)), atol=1e-3
    )
    assert np.isfinite(views.unit).all()
    assert np.all((views.unit >= 0.0) & (views.unit <= 1.0))
    assert views.loss[-1][2] == FAILED_LOSS


def test_levenberg_marquardt_survives_a_diverging_start():
    problem = PROBLEMS["quadratic"]

    def residuals(unit):
        # As in Objective.residuals: a finite constant if the run diverged.
        every = problem.residuals(unit) + 0.0 * jnp.sqrt(0.9 - unit[0])
        return jnp.where(
            jnp.all(jnp.isfinite(every)), every, jnp.sqrt(FAILED_LOSS / 3.0)
        )

    units = starts_of(problem).at[2, 0].set(0.95)
    views = run("levenberg_marquardt", problem._replace(residuals=residuals), units)
    np.testing.assert_allclose(
        views.unit[-1][[0, 1, 3, 4]],
        np.broadcast_to(problem.minimum, (4, 3)),
        atol=1e-4,
    )


# The gradient for the optimisers


def wavy(unit):
    return jnp.sum(jnp.sin(3.0 * unit) * unit**2) + jnp.prod(unit)


@pytest.mark.parametrize("forward", [True, False])
def test_the_safe_gradient_equals_the_gradient(forward):
    guarded = with_finite_gradient(wavy, forward=forward)
    for unit in np.random.default_rng(0).uniform(0.0, 1.0, (5, 4)):
        value, slope = jax.value_and_grad(guarded)(jnp.asarray(unit))
        np.testing.assert_allclose(value, wavy(unit), rtol=1e-15)
        np.testing.assert_allclose(slope, jax.grad(wavy)(unit), rtol=1e-12)


def test_forward_and_reverse_mode_agree_under_vmap_and_chain_rule():
    units = jnp.asarray(np.random.default_rng(1).uniform(0.0, 1.0, (6, 3)))
    expected = jax.vmap(jax.grad(lambda u: jnp.exp(wavy(u**2))))(units)
    for forward in (True, False):
        guarded = with_finite_gradient(wavy, forward=forward)
        found = jax.vmap(jax.grad(lambda u, g=guarded: jnp.exp(g(u**2))))(units)
        np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("forward", [True, False])
def test_a_diverged_run_has_zero_gradient(forward):
    loss = diverging_beyond(0.5, PROBLEMS["quadratic"])
    guarded = jax.value_and_grad(with_finite_gradient(loss, forward=forward))
    value, slope = guarded(jnp.array([0.6, 0.2, 0.2]))
    assert value == FAILED_LOSS
    np.testing.assert_array_equal(slope, 0.0)
    value, slope = guarded(jnp.array([0.4, 0.2, 0.2]))
    assert value < 50.0
    np.testing.assert_allclose(
        slope, jax.grad(PROBLEMS["quadratic"].loss)(jnp.array([0.4, 0.2, 0.2]))
    )


@pytest.mark.parametrize("forward", [True, False])
def test_an_infinite_gradient_is_replaced(forward):
    guarded = with_finite_gradient(lambda u: jnp.sqrt(u[0]) + u[1], forward=forward)
    value, slope = jax.value_and_grad(guarded)(jnp.array([0.0, 2.0]))
    assert value == 2.0
    np.testing.assert_array_equal(slope, 0.0)


def _views(optimiser, unit, steps):
    step = jax.jit(optimiser.step)
    carry, found = optimiser.start(jnp.array(unit)), []
    for _ in range(steps):
        carry = step(carry)
        view = optimiser.view(carry)
        found.append([*np.asarray(view.unit), float(view.loss)])
    return np.array(found)


def _fit(residuals, start, steps):
    """Return points and sums of squares of a fit after each step, and the end flag."""
    program = jax.jit(lambda points: normal_equations(linearised(residuals), points))
    rule = TRUST_REGION._replace(good=optimistix.ClassicalTrustRegion().high_cutoff)
    descent = Descent(np.array(start), rule, tolerance=TOLERANCE)
    descents, found = GaussNewton([descent], trials_with_models(program, 1)), []
    for _ in range(steps):
        standing = descents.advance()
        found.append([*standing.units[0], 2.0 * standing.losses[0]])
    return np.array(found), descent.done


def _fit_in_unit_box(residuals, unit, steps):
    start = unsquash(jnp.array(unit))
    found, done = _fit(lambda free: residuals(squash(free)), start, steps)
    return np.hstack([squash(jnp.array(found[:, :-1])), found[:, -1:]]), done


@pytest.mark.parametrize(
    ("residuals", "unit"), [(_rosenbrock, (0.2, 0.8)), (_quadratic, (0.9, 0.1, 0.2))]
)
def test_gauss_newton_equals_optimistix(residuals, unit):
    ours, done = _fit_in_unit_box(residuals, unit, 60)
    method = METHODS["levenberg_marquardt"](residuals, residuals, TOLERANCE)
    theirs = _views(method, unit, 60)
    np.testing.assert_allclose(ours[:25], theirs[:25], rtol=1e-6, atol=1e-12)
    assert done
    np.testing.assert_array_equal(ours[-1], ours[-2])
    assert ours[-1, -1] < 1e-10


def test_simultaneous_descents_equal_separate_descents():
    """Of three starts, two share a program; the second one ends before the others."""
    starts = np.array([[0.9, 0.1, 0.2], [0.3, 0.7, 0.55], [0.2, 0.2, 0.9]])
    program = jax.jit(lambda points: normal_equations(linearised(_quadratic), points))
    descents = [Descent(s, TRUST_REGION, tolerance=TOLERANCE) for s in starts]
    group = GaussNewton(descents, trials_with_models(program, 2))
    together = [group.advance() for _ in range(8)]
    for place, start in enumerate(starts):
        alone, _ = _fit(_quadratic, start, 8)
        found = np.array([standing.units[place] for standing in together])
        np.testing.assert_allclose(found, alone[:, :-1], rtol=1e-9)
    assert [standing.evaluations for standing in together[:3]] == [3, 3, 2]


def test_a_parameter_without_effect_does_not_move():
    blind = lambda unit: _quadratic(unit.at[0].set(0.3))  # noqa: E731
    found, done = _fit_in_unit_box(blind, (0.9, 0.1, 0.2), 80)
    assert done
    np.testing.assert_allclose(found[-1], [0.9, 0.7, 0.55, 0.0], atol=1e-6)


def test_a_start_without_finite_slopes_is_done():
    blown = lambda unit: jnp.sqrt(unit - 0.5)  # noqa: E731
    found, done = _fit_in_unit_box(blown, (0.2, 0.3), 2)
    assert done
    np.testing.assert_allclose(found[-1][:2], (0.2, 0.3))


def test_a_linear_problem_without_bounds_takes_one_step():
    """With linear residuals and little damping one step reaches the lstsq solution."""
    matrix = np.random.default_rng(2).standard_normal((9, 3))
    target = 50.0 * np.random.default_rng(3).standard_normal(9)
    residuals = lambda point: 1e6 * (matrix @ point - target)  # noqa: E731
    found, _ = _fit(residuals, (0.0, 0.0, 0.0), 2)
    expected, *_ = np.linalg.lstsq(matrix, target)
    np.testing.assert_allclose(found[-1][:3], expected, rtol=1e-9)
