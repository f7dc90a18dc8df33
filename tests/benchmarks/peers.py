"""PyTorch, python-control and jaxonomy as engines of the throughput benchmark.

    pip install torch control
    pip install --no-deps jaxonomy
    pip install dataclasses-json dataclasses-jsonschema ts-type

They run the first loop only, in float64 on one thread, and the benchmark skips those
that are not installed. `pip install jaxonomy` would replace JAX by version 0.9, which
jaxonomy 3.4.1 requires, and install packages that only a few of its blocks import. The
last two lines keep JAX and install what jaxonomy imports here. With JAX 0.10.2 its
results agree with C, and its times are those of JAX 0.9.2.

`step` is one sample of `engines.simulate`, for floats, arrays and tensors.
"""

import importlib
import os
import shutil
import time

import numpy as np
from engines import (
    A1,
    A2,
    B0,
    B1,
    B2,
    DOB_PID_SMC,
    HYS_A,
    HYS_B,
    HYS_C,
    KE,
    U_MAX,
    U_MIN,
    Engine,
    Q,
    T,
    UnavailableError,
)

SUM_B = B0 + B1 + B2
G0, G1, G2 = ((1.0 - A1 - A2) / SUM_B * b for b in (B0, B1, B2))
STATES = 21


def imported(name):
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise UnavailableError(f"{name} cannot be imported: {error}") from None


def first_loop_only(loop, name):
    if loop.name != DOB_PID_SMC.name:
        raise UnavailableError(f"{loop.name} is not written for {name}")


def coefficients(gains):
    """Return the coefficients of `step` for gains [8], or [8, lanes]."""
    slope = gains[3]
    k_eq = 1.0 / (slope * B0 + B0 / T)
    x = 1.0 / (gains[7] * T)
    inv_c0 = 1.0 / ((0.25 + x * x + x) * SUM_B)
    return (
        slope,
        gains[0],
        gains[1] * T,
        gains[2] / T,
        Q / (Q + gains[4]),
        gains[5],
        gains[6] / T,
        (slope * (A1 + A2) + (A1 + A2 - 1.0) / T) * k_eq,
        (slope * -A2 * T - A2) * k_eq,
        inv_c0 / KE,
        inv_c0,
        (0.5 - 2.0 * x * x) * SUM_B * inv_c0,
        (0.25 + x * x - x) * SUM_B * inv_c0,
    )


def initial_state(zero, reference):
    """Return the state before the first sample; the reference there is r(0)."""
    return (zero,) * (STATES - 2) + (reference,) * 2


def miss(state):
    """Return y(k) - r(k)."""
    return state[0] - state[-2]


def step(coefficients, state, ahead, noise, limit):
    """Return the state one sample later; `limit` clips the voltage."""
    slope, kp, ki, kd, soft, alpha, beta, eq1, eq2, in_z, inv_c0, c1, c2 = coefficients
    y, y1, h, h1, yh, vh, s_sum, s1, f1, f2, *rest = state
    z1, z2, qy1, qy2, qu1, qu2, u1, u2, u3, r, r1 = rest

    z = y + noise
    p = yh + T * vh
    res = z - p
    yh = p + alpha * res
    vh = vh + beta * res

    e1 = yh - r
    e2 = vh - (r - r1) * (1.0 / T)
    s = slope * e1 + e2
    s_sum = s_sum + s
    past = (ahead - A1 * r - A2 * r1) * (1.0 / B0) - (B1 / B0) * f1 - (B2 / B0) * f2
    pd = kp * s + kd * (s - s1)
    f = soft * (past - eq1 * e1 - eq2 * e2 - ki * s_sum - pd)

    qy = (z - A1 * z1 - A2 * z2) * in_z - c1 * qy1 - c2 * qy2
    qu = (B0 * u1 + B1 * u2 + B2 * u3) * inv_c0 - c1 * qu1 - c2 * qu2
    u = limit(f * (1.0 / KE) - (qy - qu))

    du = u - u1
    size = abs(du)
    rise = 2.0 * HYS_B * du + (2.0 + HYS_C * size) * h + HYS_A * size * (u + u1)
    hk = rise / (2.0 - HYS_C * size)
    yk = A1 * y + A2 * y1 + G1 * h + G2 * h1 + G0 * hk

    first = yk, y, hk, h, yh, vh, s_sum, s, f, f1
    return first + (z, z1, qy, qy1, qu, qu1, u, u1, u2, ahead, r)


class TorchEngine(Engine):
    """Engine in PyTorch: all lanes at once, `chunk` steps in one compiled function.

    Inductor unrolls the steps and fuses them into one vectorised C++ loop over lanes.
    Two of its options are set: without `max_fusion_size` it stores states between the
    steps of a chunk, and `cpp_wrapper` shortens a call by a third. A call takes about
    25 us before it computes. Longer chunks are therefore faster for few lanes, but each
    step takes up to a second to compile, unless Inductor has it in its cache of an
    earlier process. The last chunk is filled with steps that do not count.

    Not faster: `while_loop` over the chunks, `set_stance(skip_guard_eval_unsafe=True)`,
    vectors of 256 bits and contraction to fused multiply-adds.
    """

    name = "torch"

    def __init__(self, loop=DOB_PID_SMC, chunk=100):
        first_loop_only(loop, self.name)
        self._chunk = chunk

    def prepare(self, gains, reference, noise):
        torch = imported("torch")
        if shutil.which(os.environ.get("CXX", "g++")) is None:
            raise UnavailableError("torch.compile needs a C++ compiler")
        torch.set_num_threads(1)
        lanes, steps = noise.shape
        chunk, half = self._chunk, steps // 2
        padded = -(-steps // chunk) * chunk

        def rows(array, count):
            found = torch.zeros(count, lanes, dtype=torch.float64)
            found[: array.shape[1]] = torch.from_numpy(array.T)
            return found

        ahead, noise = rows(reference[:, 1:], padded), rows(noise, padded)
        weight = torch.zeros(padded, dtype=torch.float64)
        weight[half:steps] = 1.0 / (steps - half)
        self._chunks = list(
            zip(*(x.split(chunk) for x in (ahead, noise, weight)), strict=True)
        )
        zero, start = torch.zeros(lanes).double(), torch.tensor(reference[:, 0])
        self._start = torch.stack(initial_state(zero, start)), zero
        self._coefficients = torch.stack(coefficients(torch.tensor(gains.T)))

        def limit(voltage):
            return voltage.clamp(U_MIN, U_MAX)

        def advance(packed, state, total, ahead, noise, weight):
            gains, state = packed.unbind(), state.unbind()
            for k in range(chunk):
                total = total + weight[k] * miss(state) ** 2
                state = step(gains, state, ahead[k], noise[k], limit)
            return torch.stack(state), total

        torch.compiler.reset()  # keeps no function for other lanes
        options = {"max_fusion_size": 100_000, "cpp_wrapper": True}
        self._advance = torch.compile(
            advance, fullgraph=True, dynamic=False, options=options
        )
        self._no_grad = torch.no_grad
        begin = time.perf_counter()
        with torch.no_grad():
            self._advance(self._coefficients, *self._start, *self._chunks[0])
        self.compile_s = time.perf_counter() - begin

    def run(self):
        state, total = self._start
        with self._no_grad():
            for signals in self._chunks:
                state, total = self._advance(self._coefficients, state, total, *signals)
        return np.sqrt(total.numpy())


class ControlEngine(Engine):
    """Engine in python-control: `input_output_response` of one nonlinear system.

    The whole loop is one discrete-time `nlsys`: an interconnection of its parts would
    evaluate their outputs several times per step. Up to 3 lanes run one after the
    other, in Python numbers, at 10 us per lane and step. From FEW_LANES on, one state
    holds all lanes and the update uses NumPy, which is faster. An update compiled by
    numba would make the step of one lane 10 % shorter. python-control keeps all states
    of a call: long runs are split into segments, which take less memory and time.

    A shorter run can be scaled, because nothing but the steps takes noticeable time.
    """

    name = "control"
    slow = True
    FEW_LANES = 4

    def __init__(self, loop=DOB_PID_SMC):
        first_loop_only(loop, self.name)

    def prepare(self, gains, reference, noise):
        self._control = imported("control")
        self._steps = noise.shape[1]
        self._times = T * np.arange(self._steps)
        self._reference = reference
        lanes = len(gains)
        width = 1 if lanes < self.FEW_LANES else lanes
        self._segment = max(50, 100_000 // width)  # samples
        make = self._one_lane if width == 1 else self._all_lanes
        self._runs = []
        for lane in range(0, lanes, width):
            part = slice(lane, lane + width)
            start = initial_state(np.zeros(width), reference[part, 0])
            self._runs.append(
                (
                    part,
                    make(gains[part].T),
                    # time first in memory, because a step reads all its signals
                    np.asfortranarray(
                        np.concatenate([reference[part, 1:], noise[part]])
                    ),
                    np.concatenate(start),
                )
            )

    def _one_lane(self, gains):
        constants = coefficients([float(gain) for gain in gains[:, 0]])

        def limit(voltage):
            return min(max(voltage, U_MIN), U_MAX)

        def update(time, state, signals, parameters):
            return step(constants, state.tolist(), *signals.tolist(), limit)

        return self._system(update, 1)

    def _all_lanes(self, gains):
        constants, lanes = coefficients(gains), gains.shape[1]

        def limit(voltage):
            return np.minimum(np.maximum(voltage, U_MIN), U_MAX)

        def update(time, state, signals, parameters):
            state, signals = state.reshape(STATES, -1), signals.reshape(2, -1)
            return np.concatenate(step(constants, state, *signals, limit))

        return self._system(update, lanes)

    def _system(self, update, lanes):
        def output(time, state, signals, parameters):
            return state[:lanes]

        return self._control.nlsys(
            update, output, inputs=2 * lanes, outputs=lanes, states=STATES * lanes, dt=T
        )

    def run(self):
        respond = self._control.input_output_response
        output = np.empty_like(self._reference[:, : self._steps])
        for part, system, signals, state in self._runs:
            for k in range(0, self._steps - 1, self._segment):
                # The last sample of a segment is the first one of the next.
                window = slice(k, min(k + self._segment + 1, self._steps))
                response = respond(
                    system, self._times[window], signals[:, window], state
                )
                output[part, window] = response.outputs.reshape(-1, len(response.time))
                state = response.states[:, -1]
        half = self._steps // 2
        errors = (output - self._reference[:, : self._steps])[:, half:]
        return np.sqrt(np.mean(errors**2, axis=1))


class JaxonomyEngine(Engine):
    """Engine in jaxonomy: `Simulator.advance_to` of one LeafSystem, compiled by JAX.

    The whole loop is one discrete state with one periodic update, so that no signal
    passes through ports. A state holds all lanes of a block, which gives the program of
    `simulate_batch(use_vmap=True)` without its selects; the squared error is summed in
    the state, because recording it would take longer.

    XLA compiles this loop as one function only with the flags that piezojax sets. In a
    benchmark with piezojax they hold for jaxonomy as well; blocks of 64 lanes are then
    fastest. Alone (`--engines jaxonomy`) it runs as installed, where all lanes at once
    are fastest.
    """

    name = "jaxonomy"

    def __init__(self, loop=DOB_PID_SMC):
        first_loop_only(loop, self.name)

    def prepare(self, gains, reference, noise):
        jaxonomy = imported("jaxonomy")
        import jax
        import jax.numpy as jnp

        jax.config.update("jax_enable_x64", True)
        self._lanes, steps = noise.shape
        flags = "small_while_loop" in os.environ.get("XLA_FLAGS", "")
        width = min(self._lanes, 64) if flags else self._lanes
        half = steps // 2

        def lanes_last(array, lanes):
            block = array[np.minimum(lanes, self._lanes - 1)].T
            return jnp.array(block[..., 0] if width == 1 else block)

        arrays = {"gains": gains, "reference": reference, "noise": noise}
        blocks = [
            {
                name: lanes_last(array, np.arange(lane, lane + width))
                for name, array in arrays.items()
            }
            for lane in range(0, self._lanes, width)
        ]

        def start(block):
            zero = jnp.zeros_like(block["reference"][0])
            state = initial_state(zero, block["reference"][0])
            return jnp.zeros((), int), zero, state

        def limit(voltage):
            return jnp.clip(voltage, U_MIN, U_MAX)

        def update(time, state, gains, reference, noise):
            k, total, state = state.discrete_state
            total = total + jnp.where(k >= half, miss(state) ** 2, 0.0)
            state = step(coefficients(gains), state, reference[k + 1], noise[k], limit)
            return k + 1, total, state

        system = jaxonomy.LeafSystem()
        for name, array in blocks[0].items():
            system.declare_dynamic_parameter(name, array)
        system.declare_discrete_state(default_value=start(blocks[0]), as_array=False)
        system.declare_periodic_update(update, period=T, offset=0.0)
        options = jaxonomy.SimulatorOptions(math_backend="jax")
        simulator = jaxonomy.Simulator(system, options=options)
        end = (steps - 0.5) * T  # the first update is at 0

        def rms(context):
            _, total, _ = simulator.advance_to(end, context).context.discrete_state
            return jnp.sqrt(total / (steps - half))

        first = system.create_context()
        self._contexts = [
            first.with_parameters(block).with_discrete_state(start(block))
            for block in blocks
        ]
        begin = time.perf_counter()
        self._compiled = jax.jit(rms).lower(self._contexts[0]).compile()
        self.compile_s = time.perf_counter() - begin

    def run(self):
        results = [self._compiled(context) for context in self._contexts]
        return np.concatenate([np.atleast_1d(r) for r in results])[: self._lanes]


ENGINES = {each.name: each for each in (TorchEngine, ControlEngine, JaxonomyEngine)}
"""Engines by the name of their package."""
