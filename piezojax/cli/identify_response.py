"""``python -m piezojax.identify ... --response``: models from frequency responses."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click
from rich.console import Console

from .command import exit_unsafe, print_results, results_folder
from .records import print_columns
from .terminal import Bar

if TYPE_CHECKING:
    from ..identification.held_dynamics import HeldDynamics
    from ..identification.measured_response import Measurement
    from ..identification.records.response import FrequencyResponse


class Amplitudes(click.ParamType):
    """Numbers above 0, separated by commas."""

    name = "A,B,..."

    def convert(self, value, param, ctx):
        """Return the numbers; fail with one line for any other text."""
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(number) for number in value.split(","))
        except ValueError:
            numbers = ()
        if not numbers or not all(0.0 < number < float("inf") for number in numbers):
            self.fail(f"{value!r} must be numbers above 0, as in 0.1,0.5", param, ctx)
        return numbers


class ResponseOptions(NamedTuple):
    """Options of ``--response``.

    An option that was not given is None, () or 1.
    """

    method: str | None
    held: bool | None
    unit: str | None
    amplitudes: tuple[float, ...]
    realisations: int
    skip: int | None
    segment: int | None

    def given(self) -> list[str]:
        """Return the names of the given options that only ``--response`` takes."""
        named = {
            "--held": self.held is not None,
            "--unit": self.unit is not None,
            "--amplitude": bool(self.amplitudes),
            "--realisations": self.realisations != 1,
            "--skip": self.skip is not None,
            "--segment": self.segment is not None,
        }
        return [name for name, given in named.items() if given]


def fit_responses(
    console: Console,
    records: Sequence[Path],
    columns: Mapping[str, Any],
    options: ResponseOptions,
    out: Path | None,
) -> None:
    """Read or measure the responses, fit their modes, write and print the results.

    End the command if the model has alarms.
    """
    from ..identification.response_levels import compare_levels
    from ..identification.response_model import identify_response
    from ..report.page import write_page
    from ..report.response_pictures import write_levels, write_measured, write_response
    from ..report.response_tables import response_page

    if options.method is None:
        found, rate = _read(records, columns, options)
    else:
        found, rate = _measured(console, records, columns, options)
    with Bar(console) as bar, results_folder(out, records[0].stem) as folder:
        if len(found) == 1 and found[0][1] is not None:
            write_measured(found[0][0], folder)
        bar.stage("fitting modes")
        try:
            models = [
                identify_response(
                    response, rate, held=bool(options.held), measured=measured
                )
                for response, measured in found
            ]
        except ValueError as error:
            kept = (
                ""
                if not any(folder.iterdir())
                else (f" (the measured response is in {folder})")
            )
            raise ValueError(f"no model: {error}{kept}") from None
        bar.stage("drawing")
        levels = compare_levels(models) if len(models) > 1 else None
        if levels is None:
            pictures = write_response(models[0], folder)
        else:
            pictures = write_levels(levels, folder)
        page = response_page(
            models[0] if levels is None else levels.chosen,
            levels,
            [measured for _, measured in found],
        )
        write_page(page, folder, pictures)
    print_results(page, folder, console)
    exit_unsafe(page.alarms)


Found = list[tuple["FrequencyResponse", "Measurement | None"]]


def _read(
    records: Sequence[Path], columns: Mapping[str, Any], options: ResponseOptions
) -> tuple[Found, float]:
    """Return the responses in files, and the rate of the model in Hz."""
    from dataclasses import replace

    from ..identification.records.response_file import read_responses

    if columns["rate"] is None:
        raise ValueError(
            "a file of --response needs a --rate: the sampling rate of the controller"
        )
    of_records = {
        "--period": columns["period"],
        "--realisations": options.realisations != 1,
        "--skip": options.skip is not None,
        "--segment": options.segment is not None,
    }
    if named := [name for name, given in of_records.items() if given]:
        needs = "needs" if len(named) == 1 else "need"
        raise ValueError(
            f"{', '.join(named)} {needs} a --method: the RECORD is then a record over "
            "time"
        )
    responses = [
        response
        for path in records
        for response in read_responses(path, unit=options.unit)
    ]
    amplitudes = options.amplitudes
    if amplitudes and len(amplitudes) != len(responses):
        raise ValueError(
            f"--amplitude has {len(amplitudes)} values for {len(responses)} responses"
        )
    if amplitudes:
        responses = [
            replace(response, amplitude=amplitude)
            for response, amplitude in zip(responses, amplitudes, strict=True)
        ]
    return [(response, None) for response in responses], columns["rate"]


def _measured(
    console: Console,
    records: Sequence[Path],
    columns: Mapping[str, Any],
    options: ResponseOptions,
) -> tuple[Found, float]:
    """Return the responses of records over time, and their rate in Hz."""
    from ..identification.measured_response import ResponseSettings, measure_responses
    from ..identification.records.record import read_record

    if options.unit is not None or options.amplitudes:
        raise ValueError(
            "--unit and --amplitude describe a file of a response; with --method "
            "they come from the record"
        )
    loaded = [read_record(record, **columns) for record in records]
    print_columns(console, loaded)
    settings = ResponseSettings(
        method=options.method or "",
        realisations=options.realisations,
        skip=1 if options.skip is None else options.skip,
        segment=options.segment,
        held=options.held is not False,
    )
    return [*measure_responses(loaded, settings)], 1.0 / loaded[0].dt


def load_dynamics(path: Path | None) -> "HeldDynamics | None":
    """Return the linear dynamics of the saved model at ``path``, if there is a path.

    Raises ValueError as ``load`` and ``held_dynamics`` do.
    """
    from ..core.serial import load, read_about
    from ..identification.held_dynamics import held_dynamics

    if path is None:
        return None
    return held_dynamics(load(path), read_about(path), path.name)
