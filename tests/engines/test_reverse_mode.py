"""Gradients in reverse mode by the reverse pass in C, against the loop of simulate."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax.catalog import p558_control, p753
from piezojax.control import FeedforwardFeedback
from piezojax.core.arrays import as_array
from piezojax.core.axes import PerAxisMetric
from piezojax.core.feedback import Feedback, LoopInput
from piezojax.core.metrics import Tracking
from piezojax.core.paths import get, replace
from piezojax.core.rollout import Metric
from piezojax.core.system import Affine, Delay, System
from piezojax.dynamics import FirstOrderLag
from piezojax.engines import metered, reverse, reverse_mode
from piezojax.engines import native_library as library
from piezojax.hardware import Saturation, Sensor
from piezojax.hysteresis import InverseHysteresis, PrandtlIshlinskii

pytestmark = pytest.mark.skipif(
    library.compiler() is None, reason="there is no C compiler"
)

SAMPLES = 23


@pytest.fixture(autouse=True)
def short_segments(monkeypatch):
    """Divide the runs into several segments, the last one shorter."""
    monkeypatch.setattr(reverse, "LEAST", 5)


class Means(Metric):
    """Means of the output and its square, and a decaying maximum over the count."""

    def init(self):
        return jnp.zeros(2), jnp.zeros(()), jnp.zeros((), jnp.int32)

    def update(self, total, index, output):
        sums, most, count = total
        counted = index >= 2
        more = jnp.stack([output, output**2])
        most = jnp.maximum(most, most * 0.5 + output)
        return sums + jnp.where(counted, more, 0.0), most, count + counted

    def result(self, total):
        return jnp.append(total[0], total[1]) / total[2]


class Mixed(System):
    """A system with states of each type, one of which no result needs."""

    gain: jax.Array
    offsets: jax.Array

    def init(self, input=0.0):
        return as_array(0.3), jnp.zeros(2), jnp.zeros((), int), as_array(0.0)

    def step(self, state, input):
        x, pair, count, unused = state
        x = jnp.sin(0.7) * x + self.gain * jnp.where(x > 0.4, input, -input)
        pair = jnp.stack([pair[1], x * pair[0]]) + self.offsets
        return (x, pair, count + 2, unused + x), x * pair[0] + 0.01 * count


def driven(lanes=()):
    rng = np.random.default_rng(3)
    return jnp.array(rng.uniform(0.0, 1.0, (*lanes, SAMPLES)))


def weighted(results):
    """Return a number that depends on all results of a run, nonlinearly."""
    leaves = jax.tree.leaves(results)
    return sum(jnp.sum(jnp.sin(x * (i + 1.3))) for i, x in enumerate(leaves))


def with_reverse_pass(loss, places=0):
    """Return loss and gradient in reverse mode."""

    def both(*arguments):
        with reverse_mode(True):
            return jax.value_and_grad(loss, places)(*arguments)

    return both


def kernels(program, *arguments):
    """Return the number of calls of compiled C in a program."""
    text = jax.jit(program).lower(*arguments).as_text()
    return text.count("custom_call @piezojax_")


def assert_equals_loop(loss, *arguments, calls=2, places=0):
    """Fail unless the gradient is that of the loop, with ``calls`` calls of C."""
    program = with_reverse_pass(lambda *x: loss(*x, "native"), places)
    assert kernels(program, *arguments) == calls
    found = jax.jit(program)(*arguments)
    expected = jax.jit(jax.value_and_grad(lambda *x: loss(*x, "loop"), places))(
        *arguments
    )
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)
    for one, other in pairs:
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)
    return found


@pytest.mark.parametrize(
    ("samples", "every"), [(3, 0), (5, 1), (SAMPLES, 0), (SAMPLES, 1)]
)
def test_gradient_by_numbers_and_start(samples, every):
    """C runs once with the carries, once for a log if any, and once in reverse."""

    def loss(gain, offsets, x, engine):
        system = Mixed(gain, offsets) >> FirstOrderLag(1e-3, 1e-4)
        first, lag = system.init()
        state = (x, *first[1:]), lag
        more = {"log": lambda y: {"y": y, "large": y > 0.1}, "every": 1}
        options = {"engine": engine} | (more if every else {})
        return weighted(metered(system, driven()[:samples], state, Means(), **options))

    parts = as_array(1.1), jnp.array([0.1, -0.2]), as_array(0.2)
    calls = 3 if every else 2
    _, found = assert_equals_loop(loss, *parts, calls=calls, places=(0, 1, 2))
    step = 1e-6
    for place, slope in ((0, found[0]), (2, found[2])):
        ends = []
        for sign in (-step, step):
            changed = [*parts]
            changed[place] = parts[place] + sign
            ends.append(loss(*changed, "loop"))
        difference = (ends[1] - ends[0]) / (2.0 * step)
        np.testing.assert_allclose(slope, difference, rtol=1e-6, atol=1e-9)


LOOPS = {
    "observer": (p753.disturbance_observer(), p753.plant(), ("controller.cutoff",)),
    "plays and delay": (
        p753.pid(),
        PrandtlIshlinskii(
            polynomial=[0.0, 0.1], thresholds=[2.0, 5.0], weights=[0.02, 0.01]
        )
        >> Delay(2)
        >> FirstOrderLag(3e-4, p753.DT),
        ("controller.proportional", "plant.0.polynomial.1"),
    ),
    "numerical inverse": (
        FeedforwardFeedback(
            InverseHysteresis(p753.hysteresis(), -20.0, 120.0), p753.pid()
        ),
        p753.plant(),
        ("controller.feedback.proportional", "controller.inverse.model.b"),
    ),
}


@pytest.mark.parametrize(
    ("name", "lanes", "shared"),
    [
        ("observer", 1, False),
        ("observer", 17, True),
        ("plays and delay", 3, True),
        ("plays and delay", 17, False),
        ("numerical inverse", 3, False),
    ],
)
def test_loops_of_many_lanes(name, lanes, shared):
    """Gains shared by all lanes or one per lane; references and noise of each lane."""
    controller, plant, paths = LOOPS[name]
    loop = Feedback(controller, plant, Saturation(-20.0, 120.0), Sensor(0.01))
    rng = np.random.default_rng(2)
    references = jnp.array(rng.uniform(0.0, 5.0, (lanes, SAMPLES)))
    noise = jnp.array(rng.standard_normal((SAMPLES, lanes)))
    own = jnp.linspace(0.9, 1.1, lanes) if not shared else None
    values = dict(zip(paths, (get(loop, p) for p in paths), strict=True))

    def loss(scale, engine):
        def lane(scale, reference, noise):
            changed = replace(loop, {p: scale * x for p, x in values.items()})
            state = changed.init(reference[0])
            inputs = LoopInput(reference, noise)
            return metered(changed, inputs, state, Tracking(start=4), engine=engine)[0]

        axes = (None if shared else 0, 0, 1)
        found = jax.vmap(lane, axes)(scale, references, noise)
        return jnp.mean(found.rms_error**2) + 1e-3 * jnp.max(found.peak_voltage)

    scale = as_array(1.0) if own is None else own
    _, slope = assert_equals_loop(loss, scale)
    assert np.all(slope != 0.0)


def test_a_loop_of_three_axes():
    controller = p558_control.multi_axis("dynamic")
    path = "controller.controller.law.proportional.1"
    rng = np.random.default_rng(2)
    references, noise = (
        tuple(jnp.array(rng.uniform(0.0, 1.0, SAMPLES)) for _ in range(3))
        for _ in range(2)
    )
    loop = p558_control.loop(controller)

    def loss(scale, engine):
        changed = replace(loop, {path: scale * get(loop, path)})
        return weighted(
            metered(
                changed,
                LoopInput(references, noise),
                changed.init((0.0,) * 3),
                PerAxisMetric(Tracking(start=4), 3),
                engine=engine,
            )[0].rms_error
        )

    assert_equals_loop(loss, as_array(1.0))


def test_jacobian():
    """Many cotangents: the reverse pass runs for each."""

    def means(gain, engine):
        system = Affine(gain, 0.3) >> FirstOrderLag(1e-3, 1e-4)
        return metered(system, driven(), system.init(), Means(), engine=engine)[0]

    def rows(gain, engine):
        with reverse_mode(True):
            return jax.jacrev(means)(gain, engine)

    gains = jnp.array([0.5, 1.5])
    found = jax.vmap(lambda gain: rows(gain, "native"))(gains)
    expected = jax.vmap(lambda gain: jax.jacfwd(means)(gain, "loop"))(gains)
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def simple(gain, scale=1.0, inputs=None):
    system = Affine(gain, scale)
    inputs = driven() if inputs is None else inputs
    return weighted(metered(system, inputs, (), Means(), engine="native")[0])


def test_other_gradients_use_the_loop():
    """Derivatives with respect to inputs, and of logs that skip outputs."""
    by_input = with_reverse_pass(lambda u: simple(2.0, inputs=u))
    assert kernels(by_input, driven()) == 0
    difference = simple(2.0, inputs=driven().at[3].add(1e-6)) - simple(2.0)
    np.testing.assert_allclose(by_input(driven())[1][3], 1e6 * difference, rtol=1e-4)

    def spaced(gain):
        system = Affine(gain, 1.0)
        return weighted(
            metered(system, driven(), (), log=abs, every=4, engine="native")[1]
        )

    assert kernels(with_reverse_pass(spaced), 2.0) == 0
    slope = with_reverse_pass(spaced)(2.0)[1]
    difference = (spaced(2.0 + 1e-6) - spaced(2.0 - 1e-6)) / 2e-6
    np.testing.assert_allclose(slope, difference, rtol=1e-6)


def test_a_run_without_derivatives_in_the_context():
    def loss(gain):
        return gain * simple(2.0)

    _, slope = with_reverse_pass(loss)(3.0)
    np.testing.assert_allclose(slope, simple(2.0))


def test_new_gains_and_lanes_need_no_new_library(compiled):
    program = jax.jit(jax.vmap(with_reverse_pass(lambda v: simple(v, 0.123))))
    first = program(jnp.linspace(0.5, 1.5, 20))
    assert len(compiled) == 2
    assert not np.array_equal(first[1], program(jnp.linspace(1.0, 3.0, 20))[1])
    jax.jit(jax.vmap(with_reverse_pass(lambda v: simple(v, 0.123))))(jnp.ones(40))
    assert len(compiled) == 2


def test_a_failing_compiler_leaves_the_loop(request):
    expected = with_reverse_pass(lambda v: simple(v, 0.456))(2.0)
    request.getfixturevalue("failing_compiler")
    program = jax.jit(with_reverse_pass(lambda v: simple(v, 0.456)))
    with pytest.warns(UserWarning, match=r"/bin/false fails.*XLA runs the loops"):
        found = program(2.0)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_the_memory_of_a_gradient_grows_with_the_root_of_the_samples(monkeypatch):
    monkeypatch.undo()

    def stored(samples):
        def loss(gain):
            return simple(gain, inputs=jnp.zeros(samples))

        jaxpr = jax.make_jaxpr(with_reverse_pass(loss))(2.0).jaxpr
        (call,) = [x for x in jaxpr.eqns if x.primitive.name == "metered_run_reversed"]
        carries = call.invars[-2].aval.shape[0]
        return carries, call.params["adjoint"].segment

    assert stored(1000) == (8, 128)
    assert stored(1_000_000) == (1000, 1000)
