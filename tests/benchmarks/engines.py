"""The reference engines of the throughput benchmark, and its first loop.

The loop "dob_pid_smc" is the disturbance-observer-based PID sliding-mode
controller (thesis, chapter 5) on a hysteretic second-order plant, 20 kHz, float64.
At sample k the measurement z(k) = y(k) + n(k) and the reference r(k+1), r(k), r(k-1)
are known, and the voltage u(k) acts on y(k+1):

    filter    p = yh + T vh;  res = z - p;  yh = p + alpha res;  vh += beta/T res
    errors    e1 = yh - r(k);  e2 = vh - (r(k) - r(k-1))/T;  s = m e1 + e2
    control   v = (r(k+1) - a1 r(k) - a2 r(k-1))/b0
                  - (m (A11 e1 + A12 e2) + A21 e1 + A22 e2)/(m b0 + b0/T)
                  - (P s + I T sum(s) + D (s - s(k-1))/T)
              f = Q/(Q+R) (v - b1/b0 f(k-1) - b2/b0 f(k-2))
    observer  c0 qy = (z - a1 z(k-1) - a2 z(k-2))/Ke - c1 qy(k-1) - c2 qy(k-2)
              c0 qu = b0 u(k-1) + b1 u(k-2) + b2 u(k-3) - c1 qu(k-1) - c2 qu(k-2)
              with the corrected Q filter of (5.32), x = 1/(w T), Sb = b0 + b1 + b2:
              c0 = (1/4 + x^2 + x) Sb, c1 = (1/2 - 2 x^2) Sb, c2 = (1/4 + x^2 - x) Sb
    voltage   u = clip(f/Ke - (qy - qu), -20, 120)
    plant     trapezoid step of y' = |u'|(a u + c h) + b u' from u(k-1) to u(k) gives
              h(k); y(k+1) = a1 y(k) + a2 y(k-1) + g0 h(k) + g1 h(k-1) + g2 h(k-2)

Readings: a and b are those of (5.33) as printed in the controller; g is b scaled to
unit DC gain; past f are unclipped, past u clipped; everything starts at zero, r(-1)
= r(0). A11 = a1+a2, A12 = -a2 T, A21 = (a1+a2-1)/T, A22 = -a2.

The result of a lane is the RMS of y(k) - r(k), k = steps//2 ... steps-1, in um.

An engine is used as `engine.prepare(gains, reference, noise)`, then `engine.run()` any
number of times, with gains [B, 8], reference [B, steps+1], noise [B, steps]; `run`
returns rms [B]. Only `run` is timed: `prepare` compiles, packs and copies.
`engine(gains, reference, noise)` does both.

`loop_three_dof.py` has another loop; `CEngine(loop)` and `NumpyEngine(loop)` run it,
with the shapes reference [B, steps+1, 3], noise [B, steps, 3], rms [B, 3] and
gains [B, 9].
"""

import ctypes
import functools
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

T = 5e-5  # s
HYS_A, HYS_B, HYS_C = 0.0077, 0.1167, -0.0487
A1, A2 = 1.6035, -0.61995
B0, B1, B2 = 0.0050811, -0.0036354, 0.010553
KE = 0.1347
Q = 1.0
U_MIN, U_MAX = -20.0, 120.0  # V

GAIN_NAMES = ("P", "I", "D", "m", "R", "alpha", "beta", "cutoff")
NOMINAL_GAINS = np.array([0.01, 30.0, 1e-6, 18000.0, 100.0, 0.1, 1e-4, 500.0])

GCC_FLAGS = "-O3 -march=native"


class UnavailableError(RuntimeError):
    """The engine needs software that is not on this machine."""


def problem(lanes, steps, seed=0):
    """Return gains, reference and noise, different in every lane.

    Gains within 10 % of the nominal ones, 10 um sines of 1 to 50 Hz, 12 nm noise.
    """
    rng = np.random.default_rng(seed)
    gains = NOMINAL_GAINS * rng.uniform(0.9, 1.1, (lanes, 8))
    phase = 2 * np.pi * T * np.arange(steps + 1)
    reference = np.empty((lanes, steps + 1))
    for row, hertz in zip(reference, np.linspace(1.0, 50.0, lanes), strict=True):
        row[:] = 5.0 * (1.0 - np.cos(hertz * phase))
    noise = rng.standard_normal((lanes, steps))
    noise *= 0.012
    return gains, reference, noise


@dataclass(frozen=True)
class Loop:
    """A loop for the engines."""

    name: str  # also of the C function
    source: str  # beside this file
    problem: Callable  # (lanes, steps, seed) -> gains, reference, noise
    simulate: Callable  # (gains, reference, noise) -> rms, lanes second, time first
    one_lane: bool  # simulate also takes one lane, and numba can compile it
    axes: tuple[int, ...] = ()  # number of axes of signals and result
    design: Callable | None = None  # () -> further arguments of the C function
    few_lanes: tuple[str, ...] = ()  # gcc flags for 4 lanes or fewer


class Engine:
    """Base of the engines: ``engine(...)`` prepares and runs."""

    compile_s = None  # seconds of the last compilation, if any
    slow = False  # timed over fewer steps, then scaled

    def __call__(self, gains, reference, noise):
        self.prepare(gains, reference, noise)
        return self.run()


def simulate(gains, reference, noise):
    """Return the RMS error of one lane (gains [8], reference [T+1]) or, in NumPy, many.

    Time is the first index, so that the same source runs a lane in numba (numbers) and
    all lanes at once in NumPy (gains [8, B], reference [T+1, B], noise [T, B]).
    The measurement enters each sum last, for a shorter chain of operations.
    """
    unit_dc = (1.0 - A1 - A2) / (B0 + B1 + B2)
    g0, g1, g2 = unit_dc * B0, unit_dc * B1, unit_dc * B2
    slope = gains[3]
    kp, ki, kd = gains[0], gains[1] * T, gains[2] / T
    soft = Q / (Q + gains[4])
    alpha, beta = gains[5], gains[6] / T
    k_eq = 1.0 / (slope * B0 + B0 / T)
    eq1 = (slope * (A1 + A2) + (A1 + A2 - 1.0) / T) * k_eq
    eq2 = (slope * -A2 * T - A2) * k_eq
    x = 1.0 / (gains[7] * T)
    inv_c0 = 1.0 / ((0.25 + x * x + x) * (B0 + B1 + B2))
    c1 = (0.5 - 2.0 * x * x) * (B0 + B1 + B2) * inv_c0
    c2 = (0.25 + x * x - x) * (B0 + B1 + B2) * inv_c0
    in_z = inv_c0 / KE
    inv_t, inv_b0, inv_ke = 1.0 / T, 1.0 / B0, 1.0 / KE
    r_b1, r_b2 = B1 / B0, B2 / B0

    # Zeros with the shape of a lane or a row of lanes: numba needs one type.
    zero = 0.0 * slope
    y = y1 = h = h1 = yh = vh = s_sum = s1 = f1 = f2 = zero
    z1 = z2 = qy1 = qy2 = qu1 = qu2 = u1 = u2 = u3 = total = zero
    r = r1 = reference[0]
    steps = len(noise)
    half = steps // 2
    for k in range(steps):
        ahead = reference[k + 1]
        if k >= half:
            miss = y - r
            total = total + miss * miss

        z = y + noise[k]
        p = yh + T * vh
        res = z - p
        yh = p + alpha * res
        vh = vh + beta * res

        e1 = yh - r
        e2 = vh - (r - r1) * inv_t
        s = slope * e1 + e2
        s_sum = s_sum + s
        past = (ahead - A1 * r - A2 * r1) * inv_b0 - r_b1 * f1 - r_b2 * f2
        pd = kp * s + kd * (s - s1)
        f = soft * (past - eq1 * e1 - eq2 * e2 - ki * s_sum - pd)

        qy = (z - A1 * z1 - A2 * z2) * in_z - c1 * qy1 - c2 * qy2
        qu = (B0 * u1 + B1 * u2 + B2 * u3) * inv_c0 - c1 * qu1 - c2 * qu2
        u = np.minimum(np.maximum(f * inv_ke - (qy - qu), U_MIN), U_MAX)

        du = u - u1
        size = np.abs(du)
        rise = 2.0 * HYS_B * du + (2.0 + HYS_C * size) * h + HYS_A * size * (u + u1)
        hk = rise / (2.0 - HYS_C * size)
        yk = A1 * y + A2 * y1 + g1 * h + g2 * h1 + g0 * hk

        y, y1 = yk, y
        h, h1 = hk, h
        s1 = s
        f1, f2 = f, f1
        z1, z2 = z, z1
        qy1, qy2 = qy, qy1
        qu1, qu2 = qu, qu1
        u1, u2, u3 = u, u1, u2
        r, r1 = ahead, r
    return np.sqrt(total / (steps - half))


DOB_PID_SMC = Loop("dob_pid_smc", "loop.c", problem, simulate, one_lane=True)


class NumpyEngine(Engine):
    """Engine in NumPy: all lanes at once, a Python loop over time."""

    name = "numpy"
    slow = True

    def __init__(self, loop=DOB_PID_SMC):
        self._loop = loop

    def prepare(self, gains, reference, noise):
        arrays = gains, reference, noise
        self._arrays = [np.ascontiguousarray(array.swapaxes(0, 1)) for array in arrays]

    def run(self):
        return self._loop.simulate(*self._arrays)


@functools.cache
def _numba_lanes():
    """Return the loop over lanes compiled by numba, and the seconds of compiling."""
    try:
        import numba
    except ImportError as error:
        raise UnavailableError(f"numba cannot be imported: {error}") from None
    begin = time.perf_counter()
    one_lane = numba.njit(simulate)

    def lanes(gains, reference, noise, rms):
        for lane in range(len(rms)):
            rms[lane] = one_lane(gains[lane], reference[lane], noise[lane])

    matrix = numba.float64[:, ::1]
    compiled = numba.njit(
        numba.void(matrix, matrix, matrix, numba.float64[::1]), boundscheck=False
    )(lanes)
    return compiled, time.perf_counter() - begin


class NumbaEngine(Engine):
    """Engine in serial numba, lane by lane, without fastmath; first loop only."""

    name = "numba"
    slow = True

    def __init__(self, loop=DOB_PID_SMC):
        if not loop.one_lane:
            raise UnavailableError(f"{loop.name} is not written for numba")

    def prepare(self, gains, reference, noise):
        self._lanes, self.compile_s = _numba_lanes()
        arrays = gains, reference, noise
        self._arrays = [np.ascontiguousarray(array) for array in arrays]
        self._rms = np.empty(len(gains))

    def run(self):
        self._lanes(*self._arrays, self._rms)
        return self._rms.copy()


@functools.cache
def c_library(name, *flags):
    """Return a C source beside this file as a library, and the seconds of compiling."""
    gcc = shutil.which("gcc")
    if gcc is None:
        raise UnavailableError("gcc is not on the PATH: no C reference")
    source = Path(__file__).with_name(name)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        target = Path(folder, "loop.so")
        begin = time.perf_counter()
        done = subprocess.run(
            [gcc, *GCC_FLAGS.split(), *flags]
            + ["-shared", "-fPIC", source, "-o", target, "-lm"],
            capture_output=True,
            text=True,
        )
        if done.returncode != 0:
            raise UnavailableError(f"gcc cannot compile {name}: {done.stderr.strip()}")
        library = ctypes.CDLL(str(target))
    return library, time.perf_counter() - begin


def c_flags():
    """Return the gcc flags."""
    return GCC_FLAGS


def aligned(*shape):
    """Return an empty array that starts on a cache line."""
    memory = np.empty(int(np.prod(shape)) + 8)
    skip = -memory.ctypes.data % 64 // 8
    return memory[skip : skip + memory.size - 8].reshape(shape)


def blocks(rows, width):
    """Return [lanes, ...] as [block, ..., width], padded with the last lane."""
    count = -(-len(rows) // width)
    found = aligned(count, *rows.shape[1:], width)
    for index, block in enumerate(found):
        lanes = np.arange(index * width, (index + 1) * width)
        block[:] = np.moveaxis(rows[np.minimum(lanes, len(rows) - 1)], 0, -1)
    return found


class CEngine(Engine):
    """Engine in C, compiled by gcc for this machine: SIMD over blocks of lanes."""

    name = "c"

    def __init__(self, loop=DOB_PID_SMC):
        self._loop = loop

    def prepare(self, gains, reference, noise):
        loop = self._loop
        self._lanes, self._steps = noise.shape[:2]
        flags = loop.few_lanes if self._lanes <= 4 else ()
        library, self.compile_s = c_library(loop.source, *flags)
        width = getattr(library, loop.name + "_width")(self._lanes)
        data = [blocks(array, width) for array in (gains, reference, noise)]
        if loop.design is not None:
            data.insert(0, np.array(loop.design(), dtype=float))
        self._rms = aligned(-(-self._lanes // width), *loop.axes, width)
        self._arrays = [*data, self._rms]
        pointer = ctypes.POINTER(ctypes.c_double)
        self._pointers = [array.ctypes.data_as(pointer) for array in self._arrays]
        self._call = getattr(library, loop.name)
        self._call.argtypes = [ctypes.c_int] * 2 + [pointer] * len(self._arrays)
        self._call.restype = None

    def run(self):
        self._call(self._lanes, self._steps, *self._pointers)
        lanes_first = np.moveaxis(self._rms, -1, 1)
        return lanes_first.reshape(-1, *self._loop.axes)[: self._lanes].copy()


c_engine = CEngine()
numba_engine = NumbaEngine()
numpy_engine = NumpyEngine()
