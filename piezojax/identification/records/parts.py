"""Records that are fitted together, and their parts to fit and to validate on."""

from collections.abc import Sequence

import numpy as np

from .record import Record


def longest_first(records: Sequence[Record]) -> tuple[Record, ...]:
    """Return ``records`` sorted by length; those of equal length keep their order."""
    return tuple(records[i] for i in longest_first_places(records))


def longest_first_places(records: Sequence[Record]) -> tuple[int, ...]:
    """Return the places of ``longest_first`` records in ``records``."""
    places = range(len(records))
    return tuple(sorted(places, key=lambda i: -records[i].samples))


def check_compatible(records: tuple[Record, ...]) -> None:
    """Raise ValueError unless all records have the same sample time and units."""
    if not records:
        raise ValueError("no record to fit a model to")
    for record in records[1:]:
        if not np.isclose(record.dt, records[0].dt, rtol=1e-6, atol=0.0):
            raise ValueError(
                f"{record.source} has the sample time {record.dt:g} s and "
                f"{records[0].source} {records[0].dt:g} s; they must be the same"
            )
        for side in ("input_units", "output_units"):
            if getattr(record, side) != getattr(records[0], side):
                raise ValueError(
                    f"{record.source} has the {side.replace('_', ' ')} "
                    f"{getattr(record, side)} and {records[0].source} "
                    f"{getattr(records[0], side)}; they must be the same"
                )


def train_and_validation(
    samples: int, train: slice | None, validate: slice | None
) -> tuple[slice, slice]:
    """Return the parts to fit and to validate on, by default the halves of a record.

    Without ``validate``, the model is validated on the samples after ``train``, or on
    those before it if none follow. Raises ValueError for a part that is empty or
    outside the ``samples``, and if ``train`` leaves no samples to validate on.
    """
    train = _closed(train or slice(0, samples // 2), samples)
    if validate is None:
        last = train.stop >= samples > train.start > 0
        validate = slice(0, train.start) if last else slice(train.stop, samples)
        if train.start == 0 and train.stop == samples:
            raise ValueError(
                f"train is 0:{samples}, the whole record: nothing is left to validate "
                "the model on; fit fewer samples, or name the samples to validate on"
            )
    validate = _closed(validate, samples)
    for name, part in (("train", train), ("validate", validate)):
        if not 0 <= part.start < part.stop <= samples:
            raise ValueError(
                f"{name} is {part.start}:{part.stop}; "
                f"it must lie in 0:{samples} and hold a sample"
            )
    return train, validate


def train_validation_and_test(
    samples: int, train: slice | None, validate: slice | None, test: slice | None
) -> tuple[slice, slice, slice | None]:
    """Return the parts to fit, to validate and to test on; there may be no test.

    By default ``train`` and ``validate`` are the halves of the samples before ``test``.
    Raises ValueError for a part that is empty or outside the ``samples``, and for a
    ``test`` that shares samples with the others.
    """
    if test is None:
        return *train_and_validation(samples, train, validate), None
    test = slice(test.start or 0, samples if test.stop is None else test.stop)
    if not 0 <= test.start < test.stop <= samples:
        raise ValueError(
            f"test is {test.start}:{test.stop}; "
            f"it must lie in 0:{samples} and hold a sample"
        )
    train = train or slice(0, test.start // 2)
    validate = validate or slice(train.stop, test.start)
    train, validate = train_and_validation(samples, train, validate)
    for name, part in (("train", train), ("validate", validate)):
        if part.start < test.stop and test.start < part.stop:
            raise ValueError(
                f"test {test.start}:{test.stop} shares samples with {name} "
                f"{part.start}:{part.stop}; they must not overlap"
            )
    return train, validate, test


def check_train(records: tuple[Record, ...], train: slice) -> None:
    """Raise ValueError if a record ends before the part to fit begins."""
    for record in records:
        if record.samples <= train.start:
            raise ValueError(
                f"train is {train.start}:{train.stop}; {record.source} has only "
                f"{record.samples} samples"
            )


def _closed(part: slice, samples: int) -> slice:
    stop = samples if part.stop is None else part.stop
    return slice(part.start or 0, stop)
