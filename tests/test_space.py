"""The box of tuned parameters: maps to and from it, and its bounds."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from piezojax.control import (
    PID,
)
from piezojax.core.paths import replace
from piezojax.core.space import INSIDE, SCALES, Range, space_of, squash, unsquash
from piezojax.core.system import Affine

UNIT = st.floats(0.0, 1.0)
SIDES = {
    # Subnormal numbers are zero to XLA.
    "linear": st.floats(-1e6, 1e6, allow_subnormal=False),
    "log": st.floats(-9.0, 9.0).map(lambda exponent: 10.0**exponent),
    "logit": st.floats(1e-6, 1.0 - 1e-6),
}

examples = settings(max_examples=60, deadline=None)


@st.composite
def bounds(draw):
    scale = draw(st.sampled_from(sorted(SCALES)))
    low, high = sorted((draw(SIDES[scale]), draw(SIDES[scale])))
    # Bounds that differ by rounding only have no inverse map.
    assume(high - low > 1e-3 * max(abs(low), abs(high)) + 1e-9)
    return low, high, scale


# The strategy draws numbers and the test builds the box: checking its types draws
# random numbers, which is not allowed in a strategy.
BOXES = st.lists(bounds(), min_size=1, max_size=4)
POINTS = st.lists(UNIT, min_size=4, max_size=4).map(np.array)


def box_of(several):
    return space_of({f"p{i}": Range(*bound) for i, bound in enumerate(several)})


@examples
@given(BOXES, POINTS)
def test_from_unit_never_leaves_the_bounds(several, point):
    space = box_of(several)
    values = np.asarray(space.from_unit(jnp.asarray(point[: len(several)])))
    assert np.all(values >= np.asarray(space.lower))
    assert np.all(values <= np.asarray(space.upper))


@examples
@given(BOXES, st.sampled_from([0.0, 1.0]))
def test_corners_are_the_bounds(several, side):
    space = box_of(several)
    values = space.from_unit(jnp.full(len(several), side))
    expected = space.upper if side else space.lower
    np.testing.assert_allclose(values, expected, rtol=1e-12, atol=1e-9)


@examples
@given(BOXES, POINTS)
def test_to_unit_undoes_from_unit(several, point):
    space, unit = box_of(several), jnp.asarray(point[: len(several)])
    back = space.to_unit(space.from_unit(unit))
    np.testing.assert_allclose(back, unit, rtol=0, atol=1e-8)


@examples
@given(BOXES, POINTS)
def test_from_unit_undoes_to_unit(several, point):
    space, share = box_of(several), point[: len(several)]
    low, high = np.asarray(space.lower), np.asarray(space.upper)
    values = np.clip(low + share * (high - low), low, high)
    back = space.from_unit(space.to_unit(jnp.asarray(values)))
    np.testing.assert_allclose(back, values, rtol=1e-9, atol=1e-9)


@examples
@given(bounds(), UNIT, UNIT)
def test_the_map_is_increasing(bound, one, other):
    assume(abs(one - other) > 1e-6)
    space = box_of([bound])
    low, high = (
        float(space.from_unit(jnp.array([u]))[0]) for u in sorted([one, other])
    )
    assert low < high


def test_middle_of_each_scale():
    space = space_of(
        {
            "linear": Range(-2.0, 4.0),
            "log": Range(1e-3, 1e3, "log"),
            "logit": Range(0.1, 0.9, "logit"),
        }
    )
    np.testing.assert_allclose(space.from_unit(jnp.full(3, 0.5)), [1.0, 1.0, 0.5])


@pytest.mark.parametrize("outside", [-0.2, 1.3])
def test_points_outside_the_unit_cube_stay_within_the_bounds(outside):
    space = space_of({"a": Range(1.0, 2.0), "b": Range(1.0, 2.0, "log")})
    values = np.asarray(space.from_unit(jnp.full(2, outside)))
    assert set(values) == {1.0 if outside < 0 else 2.0}


@pytest.mark.parametrize("scale", sorted(SCALES))
def test_the_map_has_a_slope_everywhere_inside(scale):
    space = space_of({"p": Range(0.1, 0.9, scale)})
    slope = jax.jacfwd(lambda u: space.from_unit(u)[0])
    for place in (1e-6, 0.3, 1.0 - 1e-6):
        assert slope(jnp.array([place]))[0] > 1e-3


@examples
@given(st.floats(-15.0, 15.0))
def test_unsquash_undoes_squash(free):
    back = unsquash(squash(jnp.asarray(free)))
    np.testing.assert_allclose(back, free, rtol=1e-8, atol=1e-8)


@examples
@given(st.floats(allow_nan=False, allow_infinity=False))
def test_squash_stays_in_the_cube_with_a_finite_slope(free):
    value, slope = jax.value_and_grad(squash)(jnp.asarray(free))
    assert 0.0 <= value <= 1.0
    assert np.isfinite(slope)
    assert slope >= 0.0


def box(**changes):
    entry = {"lower": 1.0, "upper": 10.0, "scale": "log"} | changes
    return space_of({"controller.gain": Range(**entry)})


@pytest.mark.parametrize(
    ("lower", "upper"),
    [
        (10.0, 1.0),
        (1.0, 1.0),
        (float("-inf"), 1.0),
        (0.0, float("inf")),
        (float("nan"), 1.0),
        (0.0, float("nan")),
    ],
)
@pytest.mark.parametrize("scale", sorted(SCALES))
def test_bad_bounds_are_refused(lower, upper, scale):
    message = (
        f"controller.gain: bounds are {lower:g} and {upper:g}; "
        "they must be finite and the lower below the upper"
    )
    with pytest.raises(ValueError, match=re.escape(message)):
        box(lower=lower, upper=upper, scale=scale)


@pytest.mark.parametrize("lower", [0.0, -1.0])
def test_log_scale_needs_positive_bounds(lower):
    message = (
        f"controller.gain: the lower bound is {lower:g}; "
        "with scale 'log' it must be above 0"
    )
    with pytest.raises(ValueError, match=re.escape(message)):
        box(lower=lower)


@pytest.mark.parametrize(
    ("lower", "upper"), [(0.0, 0.5), (0.5, 1.0), (-0.5, 0.5), (0.5, 3.0)]
)
def test_logit_scale_needs_bounds_between_0_and_1(lower, upper):
    message = (
        f"controller.gain: the bounds are {lower:g} and {upper:g}; "
        "with scale 'logit' they must lie between 0 and 1"
    )
    with pytest.raises(ValueError, match=re.escape(message)):
        box(lower=lower, upper=upper, scale="logit")


def test_the_first_bad_path_is_named():
    with pytest.raises(ValueError, match=r"^offset: bounds are 2 and 1"):
        space_of({"gain": Range(0.0, 1.0), "offset": Range(2.0, 1.0)})


GAIN = space_of({"gain": Range(1.0, 10.0, "log"), "offset": Range(-1.0, 1.0)})


def test_the_start_is_that_of_the_system():
    unit = GAIN.start(Affine(gain=10.0**0.25, offset=0.5))
    np.testing.assert_allclose(unit, [0.25, 0.75], rtol=1e-12)


@pytest.mark.parametrize("gain", [0.99, 10.01, -3.0, float("nan")])
def test_start_outside_the_bounds(gain):
    message = f"gain starts at {gain:g}; its bounds 1 to 10 must include the start"
    # Replaced afterwards: a system is checked at construction, not in tuning.
    system = replace(Affine(), {"gain": gain})
    with pytest.raises(ValueError, match=re.escape(message)):
        GAIN.start(system)


@pytest.mark.parametrize(("gain", "place"), [(1.0, INSIDE), (10.0, 1.0 - INSIDE)])
def test_start_on_a_bound_is_moved_inside(gain, place):
    unit = GAIN.start(Affine(gain=gain))
    assert unit[0] == pytest.approx(place, abs=1e-15)
    assert unit[1] == 0.5
    # The gain is practically unchanged.
    assert float(GAIN.from_unit(unit)[0]) == pytest.approx(gain, rel=1e-5)
    assert np.isfinite(unsquash(unit)).all()


def test_start_names_an_unknown_parameter():
    with pytest.raises(ValueError, match=r"no parameter 'gian'; .* gain"):
        space_of({"gian": Range(0.0, 1.0)}).start(Affine())


def test_put_changes_its_parameters_only():
    pid = PID(1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, dt=1e-4)
    ranges = {"integral": Range(0.5, 8.0, "log"), "proportional": Range(0.0, 4.0)}
    space = space_of(ranges)
    moved = space.put(pid, jnp.array([0.5, 0.25]))
    found = [float(value) for value in jax.tree.leaves(moved)]
    assert found == pytest.approx([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0])
    moved = space.put(pid, jnp.array([1.0, 0.0]))
    found = [float(value) for value in jax.tree.leaves(moved)]
    assert found == pytest.approx([0.0, 8.0, 3.0, 4.0, 5.0, 6.0, 7.0])
    assert moved.dt == pid.dt


def test_named_and_put_agree():
    unit = jnp.array([0.3, 0.6])
    moved, named = GAIN.put(Affine(2.0), unit), GAIN.named(unit)
    assert list(named) == ["gain", "offset"]
    assert (moved.gain, moved.offset) == (named["gain"], named["offset"])
