"""The loop over time that simulates every System, and the Metric interface."""

import abc
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .arrays import State
from .system import System, resolve

T = TypeVar("T")

SEGMENT = 100
"""Samples between two stored states in reverse mode; 100 was measured as the
fastest."""

BLOCK = 64
"""Lanes simulated together, few enough for their state to stay in the nearest cache."""


class Metric(eqx.Module):
    """Quantity accumulated during a run, so that no trajectory has to be stored."""

    @abc.abstractmethod
    def init(self) -> State:
        """Return the empty accumulator."""

    @abc.abstractmethod
    def update(self, total: State, index: Array, output: Any) -> State:
        """Return ``total`` with the output at sample ``index`` added."""

    @abc.abstractmethod
    def result(self, total: State) -> Any:
        """Return the finished figures."""


def simulate(
    system: System,
    inputs: Any,
    state: State | None = None,
    *,
    every: int = 1,
    metric: Metric | None = None,
    segment: int = SEGMENT,
) -> tuple[State, Any]:
    """Simulate ``system`` over ``inputs``, a pytree of arrays with time as first axis.

    The run starts from ``state``, or from rest without one. Returns the last state and

    - without ``metric``, every ``every``-th output from the first on, stacked in time
      (a dense log takes about twice the time of the run itself, a log of every 20th
      sample a tenth); or
    - with ``metric``, its result, accumulated during the run: memory does not grow with
      time; or
    - with ``metric`` and ``every`` above 1, the pair of the result and the last output
      of each whole block of ``every`` samples, stacked in time; not for reverse mode.

    With ``metric``, reverse-mode differentiation stores one state per ``segment``
    samples and simulates the samples between them again, so that its memory stays small
    too. A ``segment`` as long as the run gives one plain loop, for runs without reverse
    mode; it is a third faster for a batch of inputs with time first (``in_axes=1``).
    Use ``jax.vmap`` for batches, or ``in_blocks`` for many lanes.

    Raises ValueError for empty or ragged inputs, ``every`` or ``segment`` below 1, or,
    with ``metric``, ``every`` longer than the run.
    """
    _check_positive("every", every)
    _check_positive("segment", segment)
    samples = samples_of(inputs, every if metric is not None else 1)
    system = resolve(system)
    state = system.init() if state is None else state
    if metric is not None and every > 1:
        return _sampled(system, inputs, state, metric, every, samples)
    if metric is not None:
        return _accumulate(system, inputs, state, metric, segment, samples)
    if every > 1:
        return _decimated(system, inputs, state, every, samples)
    # A lambda, because scan would hash a bound method, and arrays have no hash.
    return jax.lax.scan(lambda s, u: system.step(s, u), state, inputs)


def _check_positive(name: str, value: int) -> None:
    if value < 1:
        raise ValueError(f"{name} is {value}; it must be at least 1")


def samples_of(inputs: Any, every: int = 1) -> int:
    """Return the number of samples of a run, in blocks of ``every`` samples.

    Raises ValueError for ragged or empty inputs, and for an ``every`` that is below 1
    or longer than the run.
    """
    _check_positive("every", every)
    lengths = {jnp.shape(leaf)[0] for leaf in jax.tree.leaves(inputs) if jnp.ndim(leaf)}
    if len(lengths) != 1:
        raise ValueError(
            f"inputs must share one length in time; found {sorted(lengths)}"
        )
    (samples,) = lengths
    if samples == 0:
        raise ValueError("inputs hold no samples")
    if every > samples:
        raise ValueError(f"every is {every}; the run has {samples} samples")
    return samples


def _chunks(inputs: Any, size: int, samples: int) -> tuple[Any, Any]:
    whole = samples - samples % size
    head = jax.tree.map(lambda x: x[:whole].reshape(-1, size, *x.shape[1:]), inputs)
    return head, jax.tree.map(lambda x: x[whole:], inputs)


def _accumulate(
    system: System,
    inputs: Any,
    state: State,
    metric: Metric,
    segment: int,
    samples: int,
) -> tuple[State, Any]:
    def sample(carry, input):
        state, total, index = carry
        state, output = system.step(state, input)
        return (state, metric.update(total, index, output), index + 1), None

    carry = (state, metric.init(), jnp.zeros((), jnp.int32))
    if segment >= samples:
        carry, _ = jax.lax.scan(sample, carry, inputs)
    else:
        carry = _in_segments(sample, carry, inputs, segment, samples)
    state, total, _ = carry
    return state, metric.result(total)


def _sampled(
    system: System, inputs: Any, state: State, metric: Metric, every: int, samples: int
) -> tuple[State, Any]:
    def sample(carry, input):
        state, total, index, _ = carry
        state, output = system.step(state, input)
        return (state, metric.update(total, index, output), index + 1, output), None

    def stretch(carry, inputs):
        carry, _ = jax.lax.scan(sample, carry, inputs)
        return carry, carry[-1]

    # The carry holds the last output, so that the step is compiled only once.
    first = jax.tree.map(lambda x: x[0], inputs)
    empty = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype),
        jax.eval_shape(lambda s, u: system.step(s, u)[1], state, first),
    )
    head, tail = _chunks(inputs, every, samples)
    carry = (state, metric.init(), jnp.zeros((), jnp.int32), empty)
    carry, outputs = jax.lax.scan(stretch, carry, head)
    if samples % every:
        carry, _ = jax.lax.scan(sample, carry, tail)
    state, total, _, _ = carry
    return state, (metric.result(total), outputs)


def _in_segments(
    sample: Callable[[Any, Any], Any],
    carry: Any,
    inputs: Any,
    segment: int,
    samples: int,
) -> Any:
    @partial(jax.checkpoint, static_argnums=2)
    def stretch(carry, start, size):
        # Slicing here stays in cache: a scan over inputs sliced beforehand would copy a
        # whole batch of them.
        cut = jax.tree.map(
            lambda x: jax.lax.dynamic_slice_in_dim(x, start, size), inputs
        )
        return jax.lax.scan(sample, carry, cut)

    whole = samples - samples % segment
    carry, _ = jax.lax.scan(
        lambda c, start: stretch(c, start, segment),
        carry,
        jnp.arange(0, whole, segment),
    )
    if samples > whole:
        carry, _ = stretch(carry, whole, samples - whole)
    return carry


def _decimated(
    system: System, inputs: Any, state: State, every: int, samples: int
) -> tuple[State, Any]:
    def stretch(state, inputs):
        first = jax.tree.map(lambda x: x[0], inputs)
        state, output = system.step(state, first)
        rest = jax.tree.map(lambda x: x[1:], inputs)
        state, _ = jax.lax.scan(lambda s, u: (system.step(s, u)[0], None), state, rest)
        return state, output

    head, tail = _chunks(inputs, every, samples)
    state, outputs = jax.lax.scan(stretch, state, head)
    if samples % every:
        state, last = stretch(state, tail)
        outputs = jax.tree.map(
            lambda log, end: jnp.concatenate([log, end[None]]), outputs, last
        )
    return state, outputs


def in_blocks(function: Callable[..., T], *batches: Any, size: int = BLOCK) -> T:
    """Map ``function`` over the leading axis of ``batches``, ``size`` lanes at a time.

    Equivalent to ``jax.vmap(function)(*batches)``, but faster beyond ``size`` lanes.
    """
    lanes = jax.tree.leaves(batches)[0].shape[0]
    if lanes <= size:
        return jax.vmap(function)(*batches)
    blocks = -(-lanes // size)
    filler = blocks * size - lanes

    def block(x):
        # Copies of the last lane fill the last block: one compilation serves all.
        x = jnp.concatenate([x, jnp.repeat(x[-1:], filler, axis=0)]) if filler else x
        return x.reshape(blocks, size, *x.shape[1:])

    results = jax.lax.map(
        lambda args: jax.vmap(function)(*args), jax.tree.map(block, batches)
    )
    return jax.tree.map(
        lambda x: x.reshape(blocks * size, *x.shape[2:])[:lanes], results
    )
