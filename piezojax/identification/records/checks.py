"""What in a record stands against a fit: clipping, few cycles or frequencies, start."""

from collections.abc import Iterator

import numpy as np
import scipy

from .record import Record

CYCLES = 3
"""Fewer full hysteresis cycles than this in the training part give a warning."""

STROKE = 0.1
"""Smallest rise or fall, as a share of the input's span, that is part of a cycle."""

LINE = 0.03
"""Weakest component, as a share of the strongest, that counts as above the noise."""

LINE_BINS = 6
"""Bins above LINE that a single sine fills behind a Blackman-Harris window."""

NEAR = 0.02
"""Two levels of a signal within this share of its span are the same place."""

FAR = 0.2
"""Two levels further apart than this share of a span are surely not the same place."""


def record_warnings(
    record: Record,
    train: slice,
    validate: slice,
    *,
    order: int = 0,
    hysteresis: bool = True,
) -> list[str]:
    """Return what in ``record`` stands against a fit, a sentence each.

    ``train`` and ``validate``: the samples to fit and to judge on. ``order``: how many
    parameters of linear dynamics the model has; an input excites them all if it holds
    half as many frequencies (Ljung, System Identification, 2nd ed., 13.2).
    ``hysteresis``: whether the model has some, and so needs full cycles from a known
    state. A good record gives an empty list.
    """
    found = [
        *_clipping(record),
        *(_hysteresis_cycles(record, train) if hysteresis else ()),
        *_excitation(record, train, order, hysteresis),
        *_start(record, hysteresis),
    ]
    if validate.start < train.stop and train.start < validate.stop:
        found.append(
            "the validation part shares samples with the training part: "
            "its error is no measure of prediction"
        )
    return found


def cycles(input: np.ndarray) -> int:
    """Return the number of full cycles in ``input`` [samples].

    A cycle is a rise and a fall between reversals, each of at least STROKE of the
    span. The first and the last count for as much as they cover of their neighbour.
    """
    ends = input[_reversals(input, STROKE * np.ptp(input))]
    strokes = np.abs(np.diff(ends))
    if strokes.size < 2:
        return 0
    first = min(1.0, strokes[0] / strokes[1])
    last = min(1.0, strokes[-1] / strokes[-2])
    # A twentieth more, so that noise at the ends does not take a cycle away.
    return int((first + strokes.size - 2 + last) / 2.0 + 0.05)


def _reversals(signal: np.ndarray, least: float) -> list[int]:
    """Return where strokes of at least ``least`` begin and end.

    Shorter ones are part of the longer stroke around them.
    """
    steps = np.sign(np.diff(signal))
    moving = np.flatnonzero(steps)
    turns = moving[np.flatnonzero(np.diff(steps[moving])) + 1]
    found, low, high, way = [0], 0, 0, 0
    for i in map(int, (*turns, len(signal) - 1)):
        low = i if signal[i] < signal[low] else low
        high = i if signal[i] > signal[high] else high
        if way <= 0 and signal[i] - signal[low] >= least:
            found += [low] if way else []
            way, high = 1, i
        elif way >= 0 and signal[high] - signal[i] >= least:
            found += [high] if way else []
            way, low = -1, i
    return [*found, high if way > 0 else low]


def _named(side: str, columns: np.ndarray) -> list[tuple[str, np.ndarray]]:
    if columns.shape[1] == 1:
        return [(side, columns[:, 0])]
    return [(f"{side} {i}", column) for i, column in enumerate(columns.T)]


def _clipping(record: Record) -> Iterator[str]:
    inputs = zip(_named("input", record.inputs), record.input_units, strict=True)
    outputs = zip(_named("output", record.outputs), record.output_units, strict=True)
    for (name, signal), unit in (*inputs, *outputs):
        for level in (signal.min(), signal.max()):
            runs = _clipped(signal, level)
            if runs:
                start, stop = max(runs, key=lambda run: run[1] - run[0])
                yield (
                    f"{name} seems to be clipped: it runs into exactly {level:g} "
                    f"{unit} and stays there for {stop - start} samples from sample "
                    f"{start} on ({len(runs)} times in all)"
                )


def _clipped(signal: np.ndarray, level: float) -> list[tuple[int, int]]:
    """Return the runs [start, stop) of ``level`` that no smooth signal would have.

    A parabola that stays within one resolution step q for n samples falls by 9 q at
    most over n more; a clipped signal comes and goes at its usual pace, and, unlike a
    held one, over more than one sample.
    """
    resolution = np.diff(np.unique(signal)).min()
    pace = np.mean(np.abs(np.diff(signal)))
    reach = max(3, int(np.ceil(20.0 * resolution / pace)))
    fall = max(12.0 * resolution, 0.1 * pace * reach)
    edges = np.diff(np.concatenate([[0], signal == level, [0]]).astype(int))
    found = []
    for start, stop in zip(*map(np.flatnonzero, (edges > 0, edges < 0)), strict=True):
        if stop - start < reach or start < reach or stop + reach > signal.size:
            continue
        far = np.abs(signal[[start - reach, stop - 1 + reach]] - level)
        near = np.abs(signal[[start - 1, stop]] - level)
        if np.all((far > fall) & (far > 2.0 * near)):
            found.append((int(start), int(stop)))
    return found


def _hysteresis_cycles(record: Record, train: slice) -> Iterator[str]:
    for name, input in _named("input", record.inputs[train]):
        count = cycles(input)
        if count < CYCLES:
            yield (
                f"{name} has {count} full hysteresis cycle{'s' * (count != 1)} in the "
                "training part; "
                f"{CYCLES} or more separate the loop from its initial loading"
            )


def _excitation(
    record: Record, train: slice, order: int, hysteresis: bool
) -> Iterator[str]:
    for name, input in _named("input", record.inputs[train]):
        count = lines(input)
        if 2 * count < order:
            yield (
                f"{name} is not exciting enough: its {count} "
                f"{'frequency' if count == 1 else 'frequencies'} in the training part "
                f"can tell {2 * count} parameters of linear dynamics, and the model "
                f"has {order}; a multisine, a chirp or noise would do"
            )
        elif count <= 1 and hysteresis:
            yield (
                f"{name} has essentially one frequency: hysteresis and linear lag are "
                "told apart by the shape of the loop alone, and the model says nothing "
                "about other frequencies"
            )


def lines(input: np.ndarray) -> int:
    """Return how many sines the spectrum of ``input`` [samples] amounts to."""
    window = scipy.signal.windows.blackmanharris(input.size)
    spectrum = np.abs(np.fft.rfft((input - np.mean(input)) * window))
    strong = np.concatenate([[0], spectrum > LINE * spectrum.max(), [0]])
    edges = np.diff(strong.astype(int))
    widths = np.flatnonzero(edges < 0) - np.flatnonzero(edges > 0)
    return int(np.sum(np.maximum(1, widths // LINE_BINS)))


def _start(record: Record, hysteresis: bool) -> Iterator[str]:
    """Yield what speaks against rest, or a known loading, before sample 0."""
    inputs, outputs = record.inputs, record.outputs
    for name, input in _named("input", inputs):
        if record.period is None and _begins_in_motion(input):
            yield (
                f"{name} moves from sample 0 on, at {input[0]:g}, well inside its "
                "range: the state before is unknown; begin the record at rest"
            )
    left = np.any(np.abs(inputs - inputs[0]) > NEAR * np.ptp(inputs, axis=0), axis=1)
    rest = int(np.argmax(left))
    for name, output in _named("output", outputs):
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
        input_end = _place(inputs[:, 0])
        for name, output in _named("output", outputs):
            rising = np.corrcoef(inputs[:, 0], output)[0, 1] > 0
            place = _place(output if rising else -output)
            end = round(input_end)
            if abs(input_end - end) < NEAR and abs(place - end) > FAR:
                yield (
                    f"{name} starts {100.0 * abs(place - end):.0f} % of its range away "
                    f"from the end where input starts: its initial loading is unknown"
                )


def _place(signal: np.ndarray) -> float:
    """Return where in its range ``signal`` starts: 0 lowest, 1 highest."""
    return float((signal[0] - signal.min()) / np.ptp(signal))


def _begins_in_motion(input: np.ndarray) -> bool:
    """Whether ``input`` starts on its way: neither from zero nor from a reversal."""
    span = np.ptp(input)
    if abs(input[0]) < NEAR * span or not NEAR < _place(input) < 1.0 - NEAR:
        return False
    # Over so many samples that noise does not pass for motion.
    for lag in 2 ** np.arange(int(np.log2(input.size / 4)) + 1):
        usual = np.median(np.abs(input[lag:] - input[:-lag]))
        if usual > 2.5 * NEAR * span:
            return bool(abs(input[lag] - input[0]) > 0.5 * usual)
    return False
