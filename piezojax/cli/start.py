"""``python -m piezojax.start RECORD``: from a record to exported gains."""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click
from rich.console import Console

from ..core.files import numbered_folder, write_text
from .command import (
    RESULTS,
    Command,
    common,
    exit_unsafe,
    print_alarms,
    print_loading,
    run,
)
from .export import export_file
from .questions import QUESTIONS, asked, concerns, option, questions
from .records import columns_of, recognised_columns
from .tune import finish, sliders_option, tune_study

if TYPE_CHECKING:
    from ..study.first_plan import Plan, Shown
    from ..tuning.outcome import Outcome

STUDY, TUNED, EXPORTED = "study.toml", "tuned", "controller"
"""Names in the results folder: the study, the folders of gains and of C code."""

OF_RECORDS = "time", "input", "output", "rate", "resample"
"""Options of ``recognised_columns``."""

OF_RESPONSES = "unit", "held", "hysteresis"
"""Options that only ``--response`` takes."""

INTERRUPTED = "interrupted"
"""Status of a result whose search was interrupted."""


class Measurement(NamedTuple):
    """File that a study of the stage is fitted to.

    ``plant`` is the table of the study that names it, ``rate`` the sampling rate of the
    loop, Hz, and ``text`` describes what was read. ``shown`` returns what the file
    shows, from the answers to ``needed``.
    """

    plant: dict[str, Any]
    rate: float
    text: str
    shown: "Callable[[dict[str, Any]], Shown]"
    needed: tuple[str, ...] = ()


@click.command(cls=Command)
@click.argument("record", type=click.Path(path_type=Path))
@questions
@click.option("--model", help="Model to fit; 'all' compares all  [auto]")
@click.option(
    "--check",
    type=click.Path(path_type=Path),
    help="Second record of the stage, which validates the model.",
)
@click.option(
    "--response", is_flag=True, help="RECORD is a frequency response, not over time."
)
@click.option("--unit", help="Unit of the response, if its file has none  [um/V]")
@click.option(
    "--held",
    is_flag=True,
    help="The response was measured through the converters of the controller.",
)
@click.option("--yes", is_flag=True, help="Ask nothing; use the options and defaults.")
@sliders_option
@recognised_columns
@common
def main(record, response, yes, sliders, out, quiet, **given):
    """Tune a controller from a RECORD of your stage, and export its gains.

    The command asks for limits, sensor noise and references; the defaults come from
    the record, and each answer is also an option. It writes a study, which
    piezojax.tune can tune again, into the new folder. It does not export gains with an
    alarm. To go on after an interruption, give the same folder as --out.

    With --response, RECORD is a frequency response; --rate, --lower, --upper and
    --noise have no defaults then.

    Exit status 3 means that the gains have an alarm, as for piezojax.tune.
    """
    measure = _response if response else _record

    def body(console):
        print_loading(console)
        from ..report.page import PAGE
        from ..tuning.result import load_result

        folder = out or numbered_folder(RESULTS / record.stem)
        study = folder / STUDY
        if study.is_file():
            _check_same(study, record, given, measure)
            console.print(f"going on in {folder} with its {STUDY}", soft_wrap=True)
        else:
            _write_study(study, measure(record, folder, given), given, yes, console)
        tuned, outcome = _finished(study, console), None
        if tuned is None:
            tuned = numbered_folder(folder / TUNED)
            try:
                outcome = tune_study(study, tuned, None, None, console, sliders=sliders)
            except KeyboardInterrupt:
                console.print(_going_on(record, folder), soft_wrap=True)
                raise
        result, alarms = outcome.result if outcome else load_result(tuned), []
        if result.status == INTERRUPTED:
            console.print(_going_on(record, folder), soft_wrap=True)
            finish(result)
        if outcome is None:
            print_alarms(console, result.alarms)
            console.print(f"tuned before: the gains are in {tuned}", soft_wrap=True)
        if result.alarms:
            console.print(
                "not exported because of the alarms; follow their advice: change "
                f"{study}, or make a new record",
                soft_wrap=True,
            )
        else:
            alarms = _export(folder, tuned, outcome, console)
        console.print(f"page with the results: {tuned / PAGE}", soft_wrap=True)
        finish(result)
        exit_unsafe(alarms)

    run(quiet, body)


def _record(record: Path, folder: Path, given: dict[str, Any]) -> Measurement:
    """Return what the file ``record`` measured, for a study in ``folder``.

    Raises ValueError for options of a response, and as ``recognised`` and
    ``read_record`` do.
    """
    from ..identification import DEFAULT
    from ..identification.records.recognise import recognised
    from ..identification.records.record import read_record
    from ..study.first_plan import Shown
    from ..study.first_study import plant_of_record

    _refuse(given, OF_RESPONSES, "needs --response")
    columns = recognised(record, {name: given[name] for name in OF_RECORDS})
    loaded = read_record(record, **columns)
    shown = Shown.by_record(loaded.in_units(("V",), ("um",)))
    plant = plant_of_record(
        record, columns, folder, model=given["model"] or DEFAULT, check=given["check"]
    )
    return Measurement(plant, 1.0 / loaded.dt, columns_of(loaded), lambda _: shown)


def _response(response: Path, folder: Path, given: dict[str, Any]) -> Measurement:
    """Return what the file ``response`` measured, for a study in ``folder``.

    Raises ValueError for options of a record, without a rate, and as ``read_response``
    does.
    """
    from ..identification.records.response_file import read_response
    from ..study.first_plan import UNSHOWN, Shown
    from ..study.first_study import plant_of_response
    from ..study.origin import response_in_study_units

    _refuse(
        given,
        [name for name in (*OF_RECORDS, "model", "check") if name != "rate"],
        "is for a record over time, not for a --response",
    )
    rate = given["rate"]
    if rate is None:
        raise ValueError("--response needs a --rate: that of the controller, Hz")
    loaded = response_in_study_units(read_response(response, unit=given["unit"]))
    return Measurement(
        plant_of_response(response, folder, unit=given["unit"], held=given["held"]),
        rate,
        f"read {response}: {loaded.frequency.size} lines from "
        f"{loaded.frequency[0]:.4g} to {loaded.frequency[-1]:.4g} Hz, with a gain of "
        f"{abs(loaded.values[0]):.4g} um/V at the lowest",
        partial(Shown.by_response, loaded, 1.0 / rate),
        UNSHOWN,
    )


def _refuse(given: dict[str, Any], names: Iterable[str], reason: str) -> None:
    """Raise ValueError if one of the options ``names`` is given."""
    if found := _named(given, names):
        raise ValueError(f"{found[0]} {reason}")


def _named(given: dict[str, Any], names: Iterable[str]) -> list[str]:
    """Return the options that have a value in ``given``, a flag if it is set."""
    present = [n for n in names if given[n] is not None and given[n] is not False]
    return [f"--{option(name)}" for name in present]


def _write_study(
    study: Path,
    measured: Measurement,
    given: dict[str, Any],
    yes: bool,
    console: Console,
) -> None:
    """Write the first ``study``; ask the ``QUESTIONS`` unless ``yes``."""
    from ..core.files import fresh_folder
    from ..study.first_plan import doubts

    console.print(measured.text, soft_wrap=True, markup=False)
    plan = _plan(measured, given, yes)
    text = _text_of(measured, plan, given)
    fresh_folder(study.parent)
    write_text(study, text)
    for name, question in QUESTIONS.items():
        if concerns(name, plan):
            console.print(f"{question.text}: {getattr(plan, name)}", soft_wrap=True)
    for doubt in doubts(plan, measured.shown(given | vars(plan))):
        console.print(f"note: {doubt}", soft_wrap=True)
    console.print(f"wrote {study}", soft_wrap=True)


def _plan(measured: Measurement, given: dict[str, Any], yes: bool = True) -> "Plan":
    """Return the Plan of the options ``given`` and of the answers, unless ``yes``."""
    from ..study.first_plan import planned

    answers = {name: given[name] for name in QUESTIONS}
    if yes:
        return planned(measured.shown(answers), answers)
    return asked(measured.shown, answers, measured.needed)


def _text_of(measured: Measurement, plan: "Plan", given: dict[str, Any]) -> str:
    from ..study.first_study import first_study

    return first_study(plan, measured.plant, measured.rate, seed=given["seed"] or 0)


def _check_same(
    study: Path,
    record: Path,
    given: dict[str, Any],
    measure: Callable[[Path, Path, dict[str, Any]], Measurement],
) -> None:
    """Raise ValueError if ``study`` has another record, or follows other options.

    A study that exists is tuned as it is. Options are accepted if they would write it.
    """
    from ..core.files import seen_from
    from ..study import load

    plant = load(study).plant  # it may name a model instead
    known = plant.get("record", plant.get("response", []))
    known = known if isinstance(known, list) else [known]
    named = _named(given, given)
    if seen_from(study.parent, record) not in known:
        named = [str(record)]
    elif named:
        measured = measure(record, study.parent, given)
        text = _text_of(measured, _plan(measured, given), given)
        if text == study.read_text(encoding="utf-8"):
            return
    if named:
        raise ValueError(
            f"{study} was written before and does not follow {', '.join(named)}: edit "
            "it, or start in a new folder"
        )


def _finished(study: Path, console: Console) -> Path | None:
    """Return the newest folder of gains of a finished search on ``study``, or None.

    Gains of an earlier version of the study or of its record do not count, nor does a
    folder without its page, which is written last.
    """
    from ..core.serial import read_about
    from ..report.page import PAGE
    from ..study import contents_of, load, sha256_of
    from ..tuning.result import GAINS_FILE, RESULT_FILE, load_result

    known, found = load(study), []
    wanted = sha256_of(known, contents_of(known, study.parent))
    for folder in study.parent.glob(f"{TUNED}*"):
        files = GAINS_FILE, RESULT_FILE, PAGE
        if not all((folder / file).is_file() for file in files):
            continue
        if load_result(folder).status == INTERRUPTED:
            continue
        if read_about(folder / GAINS_FILE).study_sha256 == wanted:
            found.append(folder)
        else:
            console.print(
                f"note: {study.name} or its record has changed since {folder.name}; "
                f"the values in {study.name} stay as they are written",
                soft_wrap=True,
            )
    return max(found, key=lambda folder: folder.stat().st_mtime, default=None)


def _going_on(record: Path, folder: Path) -> str:
    return f"interrupted; to go on: python -m piezojax.start {record} --out {folder}"


def _export(
    folder: Path, tuned: Path, outcome: "Outcome | None", console: Console
) -> list[str]:
    """Export the gains in ``tuned``, unless they are exported already.

    Gains of a device are written in its file format, all others as C code. Return the
    alarms of the exported controller. A folder without its page, which is written last,
    is of a killed run: it is renamed.
    """
    from ..report.page import PAGE
    from ..study import load
    from ..study.first_plan import DEVICES
    from ..tuning.exported_runs import make_runs

    device = load(folder / STUDY).controller.get("design") in DEVICES
    # The gains in tuned-2 go to controller-2.
    exported = folder / tuned.name.replace(TUNED, EXPORTED, 1)
    if (exported / PAGE).is_file():
        alarms = _export_alarms(exported)
        print_alarms(console, alarms)
        console.print(f"exported before: {exported}", soft_wrap=True)
        return alarms
    if exported.is_dir() and any(exported.iterdir()):
        exported.rename(
            numbered_folder(exported.with_name(f"{exported.name}-unfinished"))
        )
    alarms = export_file(
        tuned,
        console,
        to="vendor" if device else "c",
        study=folder / STUDY,
        out=exported,
        runs=make_runs(outcome.case, outcome.holdout) if outcome else None,
    )
    console.print(
        f"done: gains and pictures in {tuned}, {'values' if device else 'C code'} in "
        f"{exported}, the study in {folder / STUDY}",
        soft_wrap=True,
    )
    return alarms


def _export_alarms(exported: Path) -> list[str]:
    """Return the alarms in the report of the ``exported`` folder, if it has one."""
    from ..core.files import read_model
    from ..exporting.exporter import REPORT
    from ..exporting.judge import ExportReport

    if not (exported / REPORT).is_file():
        return []
    return read_model(ExportReport, exported / REPORT, "is no report").alarms
