"""Allocation against linear programming, bounded least squares and geometry."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import allocation as oracle
from oracles import state_space

from piezojax import (
    load,
    save,
    simulate,
)
from piezojax.catalog import p558, p558_actuators
from piezojax.control import (
    Allocation,
)
from piezojax.core.system import rest_output
from piezojax.dynamics import (
    StateSpace,
)

PLATE = p558_actuators.allocation()
METHODS = ("minimum_norm", "weighted", "bounded")
POSES = np.random.default_rng(5).uniform([0, -250, -250], [50, 250, 250], (4000, 3))
"""The box of poses in docs/allocation.md, which names these shares and tests."""

SHARES = {"minimum_norm": 0.50, "bounded": 0.66}
LOCKED_SHARES = {0.0: 0.17, 25.0: 0.23, 50.0: 0.17}

allocate = eqx.filter_jit(lambda allocation, pose: allocation.allocate(jnp.array(pose)))
allocate_all = eqx.filter_jit(
    lambda allocation, poses: jax.vmap(allocation.allocate)(poses)
)


def missed(found):
    return np.abs(found.error).max(axis=1)


@pytest.fixture(scope="module")
def bounded():
    return jax.tree.map(np.asarray, allocate_all(PLATE, POSES))


@pytest.fixture(scope="module")
def feasible():
    return oracle.out_of_reach(oracle.PLATE, [0.0] * 4, [50.0] * 4, POSES) < 1e-6


def test_the_geometry_equals_the_documentation():
    np.testing.assert_allclose(PLATE.geometry, oracle.PLATE, rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        p558_actuators.elongations(), oracle.ELONGATIONS, rtol=1e-12
    )
    still = allocate(PLATE, [25.0, 0.0, 0.0])
    np.testing.assert_allclose(still.commands, np.full(4, 25.0), rtol=1e-12)


@pytest.mark.parametrize("method", SHARES)
def test_share_of_poses_reached(method):
    reached = missed(allocate_all(p558_actuators.allocation(method), POSES)) < 1e-9
    assert abs(reached.mean() - SHARES[method]) < 0.02


def test_bounded_reaches_every_reachable_pose(bounded, feasible):
    error = missed(bounded)
    assert 0.6 < feasible.mean() < 0.7
    assert error[feasible].max() < 1e-9
    assert error[~feasible].min() > 1e-6


def test_poses_at_the_edge_of_reach_stay_within_bounds():
    # With rounding such commands may be slightly outside, and the pose out of reach.
    draw = np.random.default_rng(11)
    commands = np.clip(draw.uniform(-25.0, 75.0, (4000, 4)), 0.0, 50.0)
    found = allocate_all(PLATE, commands @ oracle.PLATE.T)
    assert missed(found).max() < 1e-9
    assert found.commands.min() == 0.0
    assert found.commands.max() == 50.0


def test_bounded_uses_the_smallest_sufficient_twist(bounded):
    expected, possible = oracle.shifted(POSES)
    found, expected = bounded.commands[possible], expected[possible]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    twist = expected @ oracle.TWIST
    np.testing.assert_allclose(bounded.internal[possible, 0], twist, rtol=0, atol=1e-9)
    assert np.abs(twist).max() > 5.0


def assert_least(poses, errors, axis_weights):
    for pose, error in zip(poses, errors, strict=True):
        q = oracle.least_squares(oracle.PLATE, 0.0, 50.0, pose, axis_weights)
        expected = pose - oracle.PLATE @ q
        np.testing.assert_allclose(error, expected, rtol=0, atol=1e-6)
        least = np.sqrt(axis_weights @ expected**2)
        assert abs(np.sqrt(axis_weights @ error**2) - least) < 1e-6


def test_bounded_has_the_least_error_out_of_reach(bounded, feasible):
    errors = bounded.error[~feasible][:300]
    assert_least(POSES[~feasible][:300], errors, np.ones(3))


def test_axis_weights_distribute_the_error_out_of_reach(bounded, feasible):
    axis_weights, poses = np.array([400.0, 1.0, 2.0]), POSES[~feasible][:300]
    lower, upper = np.zeros(4), np.full(4, 50.0)
    weighted = Allocation(oracle.PLATE, lower, upper, axis_weights=axis_weights)
    errors = np.asarray(allocate_all(weighted, poses).error)
    assert_least(poses, errors, axis_weights)
    z, before = np.abs(errors[:, 0]), np.abs(bounded.error[~feasible][:300, 0])
    assert z.mean() < 0.7 * before.mean()


def test_minimum_norm_is_the_clipped_pseudo_inverse():
    found = allocate_all(p558_actuators.allocation("minimum_norm"), POSES)
    expected = np.clip(POSES @ oracle.ELONGATIONS.T, 0.0, 50.0)
    np.testing.assert_allclose(found.commands, expected, rtol=0, atol=1e-9)
    made = expected @ oracle.PLATE.T
    np.testing.assert_allclose(found.pose, made, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.error, POSES - made, rtol=0, atol=1e-9)


def test_actuator_weights_relieve_an_actuator():
    weights, far = np.array([10.0, 1.0, 1.0, 2.0]), np.full(4, 1e3)
    by = oracle.PLATE / weights
    right = by.T @ np.linalg.inv(by @ oracle.PLATE.T)
    for method in ("weighted", "bounded"):
        allocation = Allocation(oracle.PLATE, -far, far, method, weights)
        found = allocate_all(allocation, POSES).commands
        np.testing.assert_allclose(found, POSES @ right.T, rtol=0, atol=1e-9)


WIDE = {"2 of 4": (2, 4), "3 of 5": (3, 5), "3 of 3": (3, 3), "3 of 2": (3, 2)}


@pytest.mark.parametrize(("axes", "actuators"), WIDE.values(), ids=WIDE)
def test_any_geometry_has_the_least_error_then_the_least_effort(axes, actuators):
    draw = np.random.default_rng(7)
    geometry = draw.normal(size=(axes, actuators))
    lower, upper = draw.uniform(-2, -0.5, actuators), draw.uniform(0.5, 2, actuators)
    weights, axis_weights = draw.uniform(0.5, 2, actuators), draw.uniform(1, 3, axes)
    allocation = Allocation(geometry, lower, upper, "bounded", weights, axis_weights)
    poses = draw.normal(size=(100, axes)) * draw.uniform(0.3, 4, (100, 1))
    found = jax.tree.map(np.asarray, allocate_all(allocation, poses))
    for pose, commands, error in zip(poses, found.commands, found.error, strict=True):
        q = oracle.least_squares(geometry, lower, upper, pose, axis_weights)
        np.testing.assert_allclose(error, pose - geometry @ q, rtol=0, atol=1e-9)
        facts = (pose, weights, axis_weights)
        q = oracle.least_effort(geometry, lower, upper, *facts)
        np.testing.assert_allclose(commands, q, rtol=0, atol=1e-5)
    assert found.internal.shape == (100, max(actuators - axes, 0))
    exact = missed(found) < 1e-9
    assert not exact.all()
    assert exact.any() == (actuators >= axes)


@pytest.mark.parametrize("at", LOCKED_SHARES)
def test_a_locked_actuator_leaves_the_stated_share(at):
    lower, upper = [at, 0.0, 0.0, 0.0], [at, 50.0, 50.0, 50.0]
    feasible = oracle.out_of_reach(oracle.PLATE, lower, upper, POSES) < 1e-6
    for method in METHODS:
        allocation = p558_actuators.allocation(method).locked(0, at)
        found = allocate_all(allocation, POSES)
        np.testing.assert_array_equal(found.commands[:, 0], np.full(len(POSES), at))
        error = missed(found)
        assert error[feasible].max() < 1e-9
        assert error[~feasible].min() > 1e-6
    assert abs(feasible.mean() - LOCKED_SHARES[at]) < 0.02
    errors = np.asarray(found.error)[~feasible]
    for pose, error in zip(POSES[~feasible][:50], errors[:50], strict=True):
        # Three actuators, three axes: the remaining pose within bounds.
        left = pose - at * oracle.PLATE[:, 0]
        q = oracle.least_squares(oracle.PLATE[:, 1:], 0.0, 50.0, left)
        np.testing.assert_allclose(
            error, left - oracle.PLATE[:, 1:] @ q, rtol=0, atol=1e-6
        )


def test_a_locked_actuator_changes_the_twist_of_reachable_poses_only():
    # Bounds are arrays, so failures form a batch.
    stuck = np.eye(4, dtype=bool)
    lower, upper = np.where(stuck, 25.0, 0.0), np.where(stuck, 25.0, 50.0)

    def with_bounds(lower, upper, pose):
        return Allocation(oracle.PLATE, lower, upper).allocate(pose)

    pose = np.array([22.0, 40.0, -30.0])
    found = jax.jit(jax.vmap(with_bounds, (0, 0, None)))(lower, upper, pose)
    np.testing.assert_allclose(found.error, np.zeros((4, 3)), rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.diag(found.commands), np.full(4, 25.0), rtol=0)
    twist = (25.0 - oracle.ELONGATIONS @ pose) / oracle.TWIST
    np.testing.assert_allclose(found.internal[:, 0], twist, rtol=0, atol=1e-9)
    assert np.abs(twist).min() > 0.9


def test_two_locked_actuators_give_the_least_error():
    allocation = PLATE.locked(1, 10.0).locked(3, 40.0)
    found = allocate(allocation, [25.0, 60.0, 20.0])
    left = np.array([25.0, 60.0, 20.0]) - oracle.PLATE[:, [1, 3]] @ [10.0, 40.0]
    q = oracle.least_squares(oracle.PLATE[:, [0, 2]], 0.0, 50.0, left)
    np.testing.assert_allclose(
        found.commands, [q[0], 10.0, q[1], 40.0], rtol=0, atol=1e-9
    )


PLACES = {
    "inside": [25.0, 40.0, -30.0],
    "shifted": [25.0, 400.0, 300.0],
    "one on its bound, error": [44.0, 240.0, -200.0],
    "at a corner": [60.0, 10.0, 20.0],
}


def commands_of(at, method):
    pose, lower, upper = at
    return Allocation(oracle.PLATE, lower, upper, method).step((), pose)[1]


@eqx.filter_jit
def slopes_and_differences(at, directions, method):
    def both(direction):
        slope = jax.jvp(lambda at: commands_of(at, method), (at,), (direction,))[1]

        def moved(by):
            return commands_of(
                jax.tree.map(lambda v, d: v + by * d, at, direction), method
            )

        ahead, behind = moved(1e-4), moved(-1e-4)
        return slope, (ahead - behind) / 2e-4

    return jax.vmap(both)(directions)


@pytest.mark.parametrize("lock", [None, 20.0])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("place", PLACES)
def test_gradients_equal_finite_differences(place, method, lock):
    allocation = p558_actuators.allocation(method)
    by_lower, by_upper = np.eye(11)[3:7], np.eye(11)[7:]
    if lock is not None:
        allocation = allocation.locked(2, lock)
        # Equal bounds change together.
        by_lower[2] += by_upper[2]
        by_upper[2] = by_lower[2]
    at = (jnp.array(PLACES[place]), allocation.lower, allocation.upper)
    directions = np.concatenate([np.eye(11)[:3], by_lower, by_upper])
    slope, difference = slopes_and_differences(
        at, tuple(map(jnp.array, np.split(directions, [3, 7], axis=1))), method
    )
    np.testing.assert_allclose(slope, difference, rtol=0, atol=1e-7)
    assert np.abs(slope).max() > 0.1


@pytest.mark.parametrize("method", METHODS)
def test_gradients_at_rest_on_the_bounds_equal_the_pseudo_inverse(method):
    def commands(allocation, pose):
        return allocation.step((), pose)[1]

    slope = jax.jit(jax.jacrev(commands, argnums=1))
    allocation = p558_actuators.allocation(method)
    np.testing.assert_allclose(
        slope(allocation, jnp.zeros(3)), oracle.ELONGATIONS, rtol=0, atol=1e-12
    )
    stuck = slope(allocation.locked(0, 0.0), jnp.zeros(3))
    np.testing.assert_array_equal(stuck[0], np.zeros(3))
    np.testing.assert_allclose(oracle.PLATE @ stuck, np.eye(3), rtol=0, atol=1e-12)


numbers = st.floats(-2000.0, 2000.0)
anywhere = st.tuples(numbers, numbers, numbers).map(np.array)
TURNED = np.array([3, 0, 1, 2])
"""The plate rotated by 90 degrees: actuator i replaces actuator i - 1."""


@settings(max_examples=50)
@given(pose=anywhere, method=st.sampled_from(METHODS))
def test_bounds_are_never_exceeded(pose, method):
    allocation = p558_actuators.allocation(method)
    commands = np.asarray(allocate(allocation, pose).commands)
    assert commands.min() >= 0.0
    assert commands.max() <= 50.0


@settings(max_examples=50)
@given(pose=anywhere)
def test_no_method_has_a_smaller_error_than_bounded(pose):
    least = np.linalg.norm(allocate(PLATE, pose).error)
    cut = allocate(p558_actuators.allocation("minimum_norm"), pose)
    assert least <= np.linalg.norm(cut.error) + 1e-9


@settings(max_examples=50)
@given(pose=anywhere)
def test_a_reached_pose_is_a_fixed_point(pose):
    found = allocate(PLATE, pose)
    again = allocate(PLATE, found.pose)
    np.testing.assert_allclose(again.pose, found.pose, rtol=0, atol=1e-8)


@settings(max_examples=50)
@given(pose=anywhere, scale=st.floats(1e-3, 1e3))
def test_commands_scale_with_pose_and_bounds(pose, scale):
    scaled = Allocation(oracle.PLATE, PLATE.lower * scale, PLATE.upper * scale)
    found = allocate(scaled, scale * pose).commands / scale
    expected = allocate(PLATE, pose).commands
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)


@settings(max_examples=50)
@given(pose=anywhere)
def test_a_rotated_plate_has_rotated_commands(pose):
    z, rx, ry = pose
    found = allocate(PLATE, np.array([z, -ry, rx])).commands
    expected = allocate(PLATE, pose).commands[TURNED]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)


def test_commands_are_continuous_in_the_pose():
    # A path that crosses all faces of the reachable set twice, in small steps.
    s = np.linspace(0.0, 2.0 * np.pi, 20_001)
    poses = np.stack([25 + 40 * np.sin(s), 500 * np.sin(2 * s), 400 * np.cos(3 * s)], 1)
    for allocation in (PLATE, PLATE.locked(1, 30.0)):
        commands = np.asarray(allocate_all(allocation, poses).commands)
        step = np.linalg.norm(np.diff(poses, axis=0), axis=1)
        jump = np.linalg.norm(np.diff(commands, axis=0), axis=1)
        # The largest norm of the inverses on all faces is below 5.
        assert np.all(jump < 5.0 * step + 1e-6)


def test_jit_and_batch_equal_eager(bounded):
    commands = PLATE.step((), POSES[3])[1]
    for found in (bounded.commands[3], allocate(PLATE, POSES[3]).commands):
        np.testing.assert_allclose(found, commands, rtol=0, atol=1e-11)


def actuator():
    model = p558.channels("7")[0]
    return StateSpace(model.A, model.B, model.C[:1], model.D[:1], model.dt)


def motion(height, first, second):
    """Return poses over a second: height, and tilts about both diagonals."""
    t = p558.DT * np.arange(500)
    one, two = first * np.sin(2 * np.pi * 3 * t), second * np.sin(2 * np.pi * 5 * t)
    return np.stack([height + 2.0 * np.cos(2 * np.pi * t), one + two, two - one], 1)


@eqx.filter_jit
def run(stage, poses):
    return simulate(stage, poses, stage.init(poses[0]))[1]


WITHIN, SHIFTED = motion(25.0, 100.0, 60.0), motion(40.0, 150.0, 20.0)


@pytest.mark.parametrize(
    ("poses", "lock", "method"),
    [
        (WITHIN, None, "minimum_norm"),
        (WITHIN, None, "bounded"),
        (SHIFTED, None, "bounded"),
        (WITHIN, 25.0, "minimum_norm"),
        (WITHIN, 25.0, "bounded"),
    ],
)
def test_equal_actuators_behind_the_allocation_are_uncoupled_axes(poses, lock, method):
    model = actuator()
    stage = p558_actuators.stage(model, method)
    if lock is not None:
        # a failed actuator: it remains at its position
        stuck = stage.parts[0].locked(0, lock)
        stage = eqx.tree_at(lambda stage: stage.parts[0], stage, stuck)
    found = run(stage, poses)
    A, B, C, D = map(np.asarray, (model.A, model.B, model.C, model.D))
    for axis, wanted in enumerate(poses.T):
        rest = np.linalg.solve(np.eye(len(A)) - A, B[:, 0] * wanted[0])
        expected = state_space.simulate(A, B, C, D, wanted[:, None], rest)
        np.testing.assert_allclose(found[:, axis], expected[:, 0], rtol=0, atol=1e-9)


def test_the_motion_requires_the_null_space_shift():
    exceeded = np.abs(SHIFTED @ oracle.ELONGATIONS.T - 25.0).max(axis=1) > 25.0
    assert exceeded.sum() > 50
    assert oracle.shifted(SHIFTED)[1].all()
    cut = run(p558_actuators.stage(actuator(), "minimum_norm"), SHIFTED)
    whole = run(p558_actuators.stage(actuator()), SHIFTED)
    assert np.abs(cut - whole).max() > 10.0


def test_a_stage_at_rest_stays_at_rest():
    model = actuator()
    A, B, C = map(np.asarray, (model.A, model.B, model.C))
    gain = (C @ np.linalg.solve(np.eye(len(A)) - A, B)).item()
    for pose in ([0.0, 0.0, 0.0], [25.0, 40.0, -30.0], [40.0, 150.0, -150.0]):
        found = run(p558_actuators.stage(model), np.tile(pose, (20, 1)))
        expected = np.tile(gain * np.array(pose), (20, 1))
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("suffix", ["toml", "json"])
def test_the_stage_is_saved_and_loaded(tmp_path, suffix):
    stage = p558_actuators.stage(actuator())
    weighted = Allocation(
        oracle.PLATE, np.zeros(4), np.ones(4), "weighted", (1.0, 2.0, 3.0, 4.0)
    )
    for system in (stage, weighted):
        path = tmp_path / f"{type(system).__name__}.{suffix}"
        save(system, path)
        back = load(path)
        assert jax.tree.structure(back) == jax.tree.structure(system)
        pose = jnp.array([25.0, 40.0, -30.0])
        np.testing.assert_array_equal(
            rest_output(back, pose), rest_output(system, pose)
        )


def made(geometry=oracle.PLATE, lower=(0.0,) * 4, upper=(50.0,) * 4, **options):
    return Allocation(geometry, lower, upper, **options)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: made([[1.0, 2.0], [3.0]]), "geometry must be numbers in rows"),
        (lambda: made([1.0, 2.0]), "geometry must be numbers in rows"),
        (
            lambda: made(np.full((3, 4), np.inf)),
            r"(?s)geometry is .*inf.* must be finite",
        ),
        (lambda: made(np.ones((3, 4))), "geometry has rank 1; it must have 3"),
        (
            lambda: made(np.ones((1, 7)), (0.0,) * 7, (1.0,) * 7),
            "geometry has 7 actuators; it must have at most 6",
        ),
        (
            lambda: made(lower=(0.0,) * 3),
            r"lower has shape \(3,\); with .* of shape \(3, 4\) it must be \(4,\)",
        ),
        (lambda: made(weights=(1.0, 2.0)), r"weights has shape \(2,\); .* \(4,\)"),
        (lambda: made(axis_weights=(1.0,) * 4), r"axis_weights has shape \(4,\)"),
        (lambda: made(lower=(np.nan,) * 4), "lower is .*nan"),
        (lambda: made(upper=(np.inf,) * 4), "upper in .* is .*inf.* must be finite"),
        (
            lambda: made(lower=(0.0, 51.0, 0.0, 0.0)),
            "lower must be at most upper",
        ),
        (lambda: made(weights=(1.0, 0.0, 1.0, 1.0)), "weights is 0; .* above 0"),
        (lambda: made(axis_weights=(1.0, -1.0, 1.0)), "axis_weights is -1; .* above 0"),
        (
            lambda: made(method="minimum_norm", weights=(1.0, 2.0, 1.0, 1.0)),
            "with minimum_norm they must be equal",
        ),
        (
            lambda: made(method="pinv"),
            "method is 'pinv'; it must be one of minimum_norm, weighted, bounded",
        ),
        (lambda: made().locked(4, 0.0), "actuator is 4; it must be 0 to 3"),
        (lambda: made().locked(-1, 0.0), "actuator is -1; it must be 0 to 3"),
        (lambda: made().locked(0, np.nan), "lower is .*nan"),
        (
            lambda: p558_actuators.stage(p558.channels("7")[0]),
            "actuator has 1 inputs and 3 outputs; it must have one of each",
        ),
    ],
)
def test_bad_allocations_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
