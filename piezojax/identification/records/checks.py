"""Checks of a record before a fit: clipping, excitation, initial state."""

from collections.abc import Iterator

import numpy as np
import scipy

from .record import Record

CYCLES = 3
"""Least number of full hysteresis cycles in the training part without a warning."""

STROKE = 0.1
"""Smallest rise or fall of a cycle, as a share of the input's span."""

LINE = 0.03
"""Weakest spectral component above the noise, as a share of the strongest one."""

LINE_BINS = 6
"""Number of bins above LINE of a single sine under a Blackman-Harris window."""

NEAR = 0.02
"""Largest difference of two equal levels of a signal, as a share of its span."""

FAR = 0.2
"""Least difference of two levels that surely differ, as a share of the span."""


def record_warnings(
    record: Record,
    train: slice,
    validate: slice,
    *,
    order: int = 0,
    hysteresis: bool = True,
) -> list[str]:
    """Return warnings about ``record``, a sentence each; none for a good record.

    ``train`` and ``validate`` are the samples to fit and to validate on. ``order`` is
    the number of parameters of the linear dynamics: an input excites them all if it
    holds half as many frequencies (Ljung, System Identification, 2nd ed., 13.2). A
    model with ``hysteresis`` needs full cycles from a known initial state.
    """
    warnings = [
        *_clipping(record),
        *(_few_cycles(record, train) if hysteresis else ()),
        *_poor_excitation(record, train, order, hysteresis),
        *_unknown_start(record, hysteresis),
    ]
    if validate.start < train.stop and train.start < validate.stop:
        warnings.append(
            "the validation part shares samples with the training part: "
            "its error does not measure prediction"
        )
    return warnings


def cycles(input: np.ndarray) -> int:
    """Return the number of full cycles in ``input`` [samples].

    A cycle is a rise and a fall between reversals, each of at least STROKE of the
    span. The first and the last stroke count in proportion to the stroke next to them,
    as one stroke at most.
    """
    ends = input[_reversals(input, STROKE * np.ptp(input))]
    strokes = np.abs(np.diff(ends))
    if strokes.size < 2:
        return 0
    first = min(1.0, strokes[0] / strokes[1])
    last = min(1.0, strokes[-1] / strokes[-2])
    # Add a twentieth: noise at the ends must not remove a cycle.
    return int((first + strokes.size - 2 + last) / 2.0 + 0.05)


def _reversals(signal: np.ndarray, least: float) -> list[int]:
    """Return the samples at which strokes of at least ``least`` begin and end.

    A shorter stroke is part of the longer stroke around it.
    """
    steps = np.sign(np.diff(signal))
    moving = np.flatnonzero(steps)
    turns = moving[np.flatnonzero(np.diff(steps[moving])) + 1]
    reversals, low, high, direction = [0], 0, 0, 0
    for i in map(int, (*turns, len(signal) - 1)):
        low = i if signal[i] < signal[low] else low
        high = i if signal[i] > signal[high] else high
        if direction <= 0 and signal[i] - signal[low] >= least:
            reversals += [low] if direction else []
            direction, high = 1, i
        elif direction >= 0 and signal[high] - signal[i] >= least:
            reversals += [high] if direction else []
            direction, low = -1, i
    return [*reversals, high if direction > 0 else low]


def _labelled(side: str, columns: np.ndarray) -> list[tuple[str, np.ndarray]]:
    if columns.shape[1] == 1:
        return [(side, columns[:, 0])]
    return [(f"{side} {i}", column) for i, column in enumerate(columns.T)]


def _clipping(record: Record) -> Iterator[str]:
    inputs = zip(_labelled("input", record.inputs), record.input_units, strict=True)
    outputs = zip(_labelled("output", record.outputs), record.output_units, strict=True)
    for (name, signal), unit in (*inputs, *outputs):
        for level in (signal.min(), signal.max()):
            runs = _clipped_runs(signal, level)
            if runs:
                start, stop = max(runs, key=lambda run: run[1] - run[0])
                yield (
                    f"{name} seems to be clipped: it runs into exactly {level:g} "
                    f"{unit} and stays there for {stop - start} samples from sample "
                    f"{start} on ({len(runs)} times in all)"
                )


def _clipped_runs(signal: np.ndarray, level: float) -> list[tuple[int, int]]:
    """Return the runs [start, stop) at ``level`` that are due to clipping.

    A smooth signal is a parabola near its extreme. If it stays within one resolution
    step q for n samples, it falls by at most 9 q over the next n samples. A clipped
    signal reaches and leaves the level at its usual rate. A held signal does so within
    one sample, a clipped signal over several samples.
    """
    resolution = np.diff(np.unique(signal)).min()
    pace = np.mean(np.abs(np.diff(signal)))
    reach = max(3, int(np.ceil(20.0 * resolution / pace)))
    fall = max(12.0 * resolution, 0.1 * pace * reach)
    edges = np.diff(np.concatenate([[0], signal == level, [0]]).astype(int))
    runs = []
    for start, stop in zip(*map(np.flatnonzero, (edges > 0, edges < 0)), strict=True):
        if stop - start < reach or start < reach or stop + reach > signal.size:
            continue
        far = np.abs(signal[[start - reach, stop - 1 + reach]] - level)
        near = np.abs(signal[[start - 1, stop]] - level)
        if np.all((far > fall) & (far > 2.0 * near)):
            runs.append((int(start), int(stop)))
    return runs


def _few_cycles(record: Record, train: slice) -> Iterator[str]:
    for name, input in _labelled("input", record.inputs[train]):
        count = cycles(input)
        if count < CYCLES:
            yield (
                f"{name} has {count} full hysteresis cycle{'s' * (count != 1)} in the "
                "training part; "
                f"{CYCLES} or more separate the loop from its initial loading"
            )


def _poor_excitation(
    record: Record, train: slice, order: int, hysteresis: bool
) -> Iterator[str]:
    for name, input in _labelled("input", record.inputs[train]):
        count = lines(input)
        if 2 * count < order:
            yield (
                f"{name} is not exciting enough: its {count} "
                f"{'frequency' if count == 1 else 'frequencies'} in the training part "
                f"determine {2 * count} parameters of linear dynamics, and the model "
                f"has {order}; a multisine, a chirp or noise would suffice "
                "(python -m piezojax.excite writes one)"
            )
        elif count <= 1 and hysteresis:
            yield (
                f"{name} has essentially one frequency: only the shape of the loop "
                "distinguishes hysteresis from linear lag, and the record says nothing "
                "about other frequencies"
            )


def lines(input: np.ndarray) -> int:
    """Return the number of sines in the spectrum of ``input`` [samples]."""
    window = scipy.signal.windows.blackmanharris(input.size)
    spectrum = np.abs(np.fft.rfft((input - np.mean(input)) * window))
    strong = np.concatenate([[0], spectrum > LINE * spectrum.max(), [0]])
    edges = np.diff(strong.astype(int))
    widths = np.flatnonzero(edges < 0) - np.flatnonzero(edges > 0)
    return int(np.sum(np.maximum(1, widths // LINE_BINS)))


def _unknown_start(record: Record, hysteresis: bool) -> Iterator[str]:
    """Yield warnings if rest or a known loading before sample 0 is doubtful."""
    inputs, outputs = record.inputs, record.outputs
    for name, input in _labelled("input", inputs):
        if record.period is None and _begins_in_motion(input):
            yield (
                f"{name} moves from sample 0 on, at {input[0]:g}, well inside its "
                "range: the state before is unknown; begin the record at rest"
            )
    left = np.any(np.abs(inputs - inputs[0]) > NEAR * np.ptp(inputs, axis=0), axis=1)
    rest = int(np.argmax(left))
    for name, output in _labelled("output", outputs):
        before, after = output[: rest // 3], output[rest - rest // 3 : rest]
        if before.size < 3:
            continue
        drift = np.median(after) - np.median(before)
        if abs(drift) > 2.0 * NEAR * np.ptp(output):
            yield (
                f"{name} has not come to rest at sample 0: it drifts by {drift:.3g} "
                f"while the input rests until sample {rest}"
            )
    if hysteresis and inputs.shape[1] == 1:
        input_start = _start_fraction(inputs[:, 0])
        for name, output in _labelled("output", outputs):
            rising = np.corrcoef(inputs[:, 0], output)[0, 1] > 0
            output_start = _start_fraction(output if rising else -output)
            end = round(input_start)
            if abs(input_start - end) < NEAR and abs(output_start - end) > FAR:
                away = 100.0 * abs(output_start - end)
                yield (
                    f"{name} starts {away:.0f} % of its range away "
                    "from the end of its range that matches the start of the "
                    "input: its initial loading is unknown"
                )


def _start_fraction(signal: np.ndarray) -> float:
    """Return the first value of ``signal`` as a fraction of its range, from 0 to 1."""
    return float((signal[0] - signal.min()) / np.ptp(signal))


def _begins_in_motion(input: np.ndarray) -> bool:
    """Return whether ``input`` starts in motion, neither at zero nor at a reversal."""
    span = np.ptp(input)
    if abs(input[0]) < NEAR * span or not NEAR < _start_fraction(input) < 1.0 - NEAR:
        return False
    # A lag is long enough when the signal moves by more than the noise within it.
    for lag in 2 ** np.arange(int(np.log2(input.size / 4)) + 1):
        usual = np.median(np.abs(input[lag:] - input[:-lag]))
        if usual > 2.5 * NEAR * span:
            return bool(abs(input[lag] - input[0]) > 0.5 * usual)
    return False
