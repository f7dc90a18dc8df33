import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax import (
    Metric,
    loop_inputs,
    simulate,
)
from piezojax.catalog import p753
from piezojax.core import paths
from piezojax.core.feedback import LoopInput
from piezojax.core.metrics import (
    Tracking,
)
from piezojax.core.rollout import (
    in_blocks,
)
from piezojax.core.system import Affine
from piezojax.hysteresis import (
    ColemanHodgdon,
)
from piezojax.signals import waveforms as signals

SAMPLES = 1050  # not a multiple of the 100 samples of a segment
PLANT = p753.plant()
VOLTAGES = jnp.array(np.random.default_rng(13).uniform(-20.0, 120.0, SAMPLES))
REFERENCE = jnp.array(signals.sine(signals.time_grid(SAMPLES / 2e4, 2e4), 50.0))
NOISE = jnp.array(np.random.default_rng(14).normal(size=SAMPLES))


class WeightedSum(Metric):
    """Metric that depends on every output and its index."""

    def init(self):
        return jnp.zeros(())

    def update(self, total, index, output):
        return total + output * jnp.sin(0.1 * index)

    def result(self, total):
        return 2.0 * total


WEIGHTS = 2.0 * np.sin(0.1 * np.arange(SAMPLES))


@pytest.fixture(scope="module")
def dense():
    return jax.jit(simulate)(PLANT, VOLTAGES)


@pytest.mark.parametrize("segment", [1, 7, 100, SAMPLES - 1, 5000])
def test_metric_equals_that_of_the_stacked_outputs(segment, dense):
    run = jax.jit(
        lambda plant: simulate(plant, VOLTAGES, metric=WeightedSum(), segment=segment)
    )
    state, found = run(PLANT)
    np.testing.assert_allclose(found, WEIGHTS @ dense[1], rtol=1e-11)
    assert_same(state, dense[0])


def assert_same(found, expected, atol=1e-11):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)
    for one, other in pairs:
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=atol)


@pytest.mark.parametrize("segment", [7, 100])
def test_gradient_does_not_depend_on_the_segments(segment):
    def accumulated(plant, voltages):
        return simulate(plant, voltages, metric=WeightedSum(), segment=segment)[1]

    def stacked(plant, voltages):
        return WEIGHTS @ simulate(plant, voltages)[1]

    found, expected = (
        jax.jit(jax.grad(f, argnums=(0, 1)))(PLANT, VOLTAGES)
        for f in (accumulated, stacked)
    )
    assert_same(found, expected, atol=1e-9)


@pytest.fixture(scope="module")
def loop():
    return p753.loop(p753.inversion())


def test_tracking_equals_that_of_the_stacked_samples(loop):
    inputs, start = loop_inputs(REFERENCE, NOISE), 333

    @jax.jit
    def both(loop):
        figures = simulate(loop, inputs, loop.init(), metric=Tracking(start))[1]
        return figures, simulate(loop, inputs, loop.init())[1]

    figures, samples = both(loop)
    error = (samples.displacement - samples.reference)[start:]
    voltage = samples.voltage[start:]
    clipped = np.abs(samples.command - samples.voltage) > 0.1
    expected = {
        "rms_error": np.sqrt(np.mean(error**2)),
        "peak_error": np.abs(error).max(),
        "rms_effort": np.sqrt(np.mean(voltage**2)),
        "rms_slew": np.sqrt(np.sum(np.diff(voltage) ** 2) / error.size),
        "saturated": np.mean(clipped),
        "peak_voltage": np.abs(samples.voltage).max(),
    }
    for name, value in expected.items():
        np.testing.assert_allclose(getattr(figures, name), value, rtol=1e-11)


@pytest.mark.parametrize("every", [1, 2, 20, 50, SAMPLES, 3 * SAMPLES])
def test_a_decimated_log_has_every_nth_output(every, dense):
    state, outputs = jax.jit(lambda p: simulate(p, VOLTAGES, every=every))(PLANT)
    np.testing.assert_allclose(outputs, dense[1][::every], rtol=0.0, atol=1e-12)
    assert_same(state, dense[0])


def test_decimated_log_of_a_loop_has_all_its_columns(loop):
    inputs = loop_inputs(REFERENCE[:101], NOISE[:101])

    @jax.jit
    def both(loop):
        return (
            simulate(loop, inputs, loop.init(0.0), every=20)[1],
            simulate(loop, inputs, loop.init(0.0))[1],
        )

    coarse, fine = both(loop)
    assert coarse.voltage.shape == (6,)
    assert_same(coarse, jax.tree.map(lambda x: x[::20], fine))


def test_two_halves_equal_the_whole(dense):
    run = jax.jit(simulate)
    half, first = run(PLANT, VOLTAGES[:525])
    state, second = run(PLANT, VOLTAGES[525:], half)
    assert_same(jnp.concatenate([first, second]), dense[1])
    assert_same(state, dense[0])


def test_default_start_is_at_rest(dense):
    state, outputs = jax.jit(simulate)(PLANT, VOLTAGES, PLANT.init(0.0))
    assert_same((state, outputs), dense)
    elsewhere = jax.jit(simulate)(PLANT, VOLTAGES, PLANT.init(50.0))[1]
    assert np.abs(elsewhere - outputs).max() > 1.0


@pytest.mark.parametrize("options", [{}, {"every": 3}, {"metric": Tracking(2)}])
def test_jit_equals_eager(options, loop):
    inputs, state = loop_inputs(REFERENCE[:10], NOISE[:10]), loop.init(0.0)
    eager = simulate(loop, inputs, state, **options)
    compiled = jax.jit(lambda loop: simulate(loop, inputs, state, **options))(loop)
    assert_same(eager, compiled)


def test_eager_equals_a_python_loop():
    state, outputs = PLANT.init(0.0), []
    for voltage in VOLTAGES[:5]:
        state, output = PLANT.step(state, voltage)
        outputs.append(output)
    assert_same(simulate(PLANT, VOLTAGES[:5]), (state, jnp.stack(outputs)))


def lane(plant, scale):
    state, outputs = simulate(plant, scale["voltage"] * VOLTAGES[:50], every=7)
    return {"last": outputs[-1], "log": outputs, "state": state}


one_lane = jax.jit(lane)


@pytest.mark.parametrize("lanes", [1, 5, 64, 130])
def test_blocks_equal_single_lanes(lanes):
    share = jnp.linspace(0.1, 1.0, lanes)
    plants = jax.vmap(lambda share: ColemanHodgdon(0.01 * share, 0.1, -0.05))(share)
    batch = plants, {"voltage": share}
    alone = [one_lane(*jax.tree.map(lambda x, i=i: x[i], batch)) for i in range(lanes)]
    expected = jax.tree.map(lambda *x: jnp.stack(x), *alone)
    assert_same(jax.jit(lambda *b: in_blocks(lane, *b))(*batch), expected)
    if lanes > 64:  # fewer lanes are one block, as in vmap
        assert_same(jax.jit(jax.vmap(lane))(*batch), expected)


@pytest.mark.parametrize("size", [1, 3, 10, 11])
def test_blocks_of_any_size_give_the_same_result(size):
    values = jnp.arange(20.0).reshape(10, 2)
    found = in_blocks(lambda x, y: (x.sum(), 2.0 * y), values, values[:, 0], size=size)
    assert_same(found, (values.sum(axis=1), 2.0 * values[:, 0]))


def test_gradient_through_blocks_equals_that_of_vmap():
    scales = jnp.linspace(0.1, 1.0, 20)

    def total(mapped):
        def f(plant):
            return mapped(lambda s: simulate(plant, s * VOLTAGES[:50])[1][-1], scales)

        return jax.jit(jax.grad(lambda plant: jnp.sum(f(plant) ** 2)))(PLANT.parts[0])

    blocks = total(lambda f, s: in_blocks(f, s, size=8))
    assert_same(blocks, total(lambda f, s: jax.vmap(f)(s)))


def test_new_gains_do_not_compile_again(loop):
    inputs = loop_inputs(REFERENCE[:50])

    def run(loop):
        return simulate(loop, inputs, loop.init(0.0), metric=Tracking())[1].rms_error

    # Raises if it traces a second time.
    compiled = jax.jit(eqx.debug.assert_max_traces(run, max_traces=1))
    found = {float(compiled(loop))}
    for share in (0.9, 1.1):
        gains = {
            name: share * value
            for name, value in paths.parameters(loop).items()
            if name.startswith("controller.feedback.")
        }
        found.add(float(compiled(paths.replace(loop, gains))))
    found.add(float(compiled(p753.loop(p753.inversion("5-4"), noise_rms=0.0))))
    assert len(found) == 4
    with pytest.raises(RuntimeError, match="traced 2 times"):
        compiled(p753.loop(p753.pid()))


def growth(function):
    """Return the bytes of temporary memory per additional sample."""
    sizes = []
    for samples in (1000, 8000):
        voltages = jax.ShapeDtypeStruct((samples,), jnp.float64)
        compiled = jax.jit(jax.grad(function)).lower(PLANT, voltages).compile()
        sizes.append(compiled.memory_analysis().temp_size_in_bytes)
    return (sizes[1] - sizes[0]) / 7000


def test_memory_of_the_gradient_does_not_grow_with_time():
    def accumulated(plant, voltages):
        return simulate(plant, voltages, metric=WeightedSum())[1]

    def stacked(plant, voltages):
        return jnp.mean(simulate(plant, voltages)[1] ** 2)

    # one stored state per 100 samples, against one per sample
    assert growth(accumulated) < 8.0
    assert growth(stacked) > 40.0


@pytest.mark.parametrize("options", [{}, {"every": 20}, {"metric": WeightedSum()}])
def test_ragged_and_empty_inputs_are_refused(options):
    with pytest.raises(ValueError, match=r"must share one length in time; .*\[3, 4\]"):
        simulate(Affine(), (jnp.zeros(3), jnp.zeros(4)), **options)
    with pytest.raises(ValueError, match=r"must share one length in time; found \[\]"):
        simulate(Affine(), (), **options)
    with pytest.raises(ValueError, match="inputs hold no samples"):
        simulate(Affine(), jnp.zeros(0), **options)


@pytest.mark.parametrize("every", [2, 7, 100, SAMPLES])
def test_a_metric_counts_every_sample_beside_a_decimated_log(every, dense):
    run = jax.jit(
        lambda plant: simulate(plant, VOLTAGES, metric=WeightedSum(), every=every)
    )
    state, (found, outputs) = run(PLANT)
    np.testing.assert_allclose(found, WEIGHTS @ dense[1], rtol=1e-11)
    expected = dense[1][every - 1 :: every]
    np.testing.assert_allclose(outputs, expected, rtol=0.0, atol=1e-12)
    assert_same(state, dense[0])


def test_a_metric_with_a_block_longer_than_the_run_is_refused():
    with pytest.raises(ValueError, match=f"every is 2000; the run has {SAMPLES}"):
        simulate(PLANT, VOLTAGES, every=2000, metric=WeightedSum())


@pytest.mark.parametrize(
    "options", [{"every": 0}, {"every": -2}, {"metric": WeightedSum(), "segment": 0}]
)
def test_impossible_strides_are_refused(options):
    with pytest.raises(ValueError, match="must be"):
        simulate(Affine(), VOLTAGES, **options)


def test_noise_of_another_length_is_refused(loop):
    with pytest.raises(ValueError, match=r"found \[10, 11\]"):
        simulate(loop, LoopInput(REFERENCE[:10], NOISE[:11]), loop.init(0.0))
