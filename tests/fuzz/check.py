"""Check of one case: it works, or is refused in one line within the time limit."""

import contextlib
import signal
import time
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from unittest import mock

from piezojax import study as studies
from piezojax.core.serial import load as load_system
from piezojax.identification.records.checks import record_warnings
from piezojax.identification.records.record import read_record
from piezojax.study import fitted_plant

from .corpus import Case

LIMIT = 5.0
"""Longest time of a case, s."""

LONGEST = 3000
"""Most characters of a message."""


class Outcome(NamedTuple):
    """``status`` is "works", "refused" or the fault; ``detail`` its message."""

    status: str
    detail: str
    seconds: float


class FittedError(Exception):
    """Raised instead of a fit, which would exceed the time of a case."""


def _no_fit(*arguments: object, **options: object) -> None:
    raise FittedError


def run(case: Case, folder: Path, *, building: bool = True) -> Outcome:
    """Read the file of ``case``; ``building`` also builds studies."""
    path = folder / case.name
    path.write_bytes(case.content)
    begin = time.perf_counter()
    status, detail = "works", ""
    try:
        with warnings.catch_warnings(), _alarm():
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", ResourceWarning)
            _read(case, path, building)
    except FittedError:
        pass
    except ValueError as error:
        status, detail = "refused", str(error)
        if not detail or len(detail.splitlines()) != 1 or len(detail) > LONGEST:
            status = "not one line"
    except TimeoutError:
        status = "too slow"
        detail = traceback.format_exc(limit=-4)
    except (Exception, RecursionError) as error:
        status = type(error).__name__
        detail = "".join(traceback.format_exception(error, limit=-4))
    finally:
        path.unlink()
    return Outcome(status, detail, time.perf_counter() - begin)


def _read(case: Case, path: Path, building: bool) -> None:
    if case.kind == "model":
        load_system(path)
    elif case.kind == "record":
        record = read_record(path, **case.options)
        half = record.samples // 2
        record_warnings(record, slice(0, half), slice(half, record.samples), order=4)
    elif studies.is_comparison_study(path):
        comparison = studies.load_comparison_study(path)
        if building:
            studies.compared_cases(comparison, path)
    else:
        study = studies.load(path)
        if building:
            with mock.patch.object(fitted_plant, "identify", _no_fit):
                studies.build(study, path)


@contextlib.contextmanager
def _alarm() -> Iterator[None]:
    def ring(*_: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, LIMIT)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
