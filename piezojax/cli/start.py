"""``python -m piezojax.start RECORD``: from a record to exported gains."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click
from rich.console import Console

from ..core.files import numbered_folder, write_text
from .command import RESULTS, Command, common, print_alarms, print_loading, run
from .export import export_file
from .records import print_columns, recognised_columns
from .tune import finish, sliders_option, tune_study

if TYPE_CHECKING:
    from ..identification import Record
    from ..study.first_plan import Plan
    from ..tuning.outcome import Outcome

STUDY, TUNED, EXPORTED = "study.toml", "tuned", "controller"
"""Names in the results folder: the study, the folders of gains and of C code."""

INTERRUPTED = "interrupted"
"""Status of a result whose search was interrupted."""


class Question(NamedTuple):
    """Question about a value that a record does not contain.

    ``text`` is the question, ``kind`` the type of the answer, and ``more`` the end of
    the help text.
    """

    text: str
    kind: type = float
    more: str = ""


QUESTIONS = {
    "lower": Question("lower limit of the voltage [V]"),
    "upper": Question("upper limit of the voltage [V]"),
    "noise": Question("rms noise of the sensor [um]"),
    "frequency": Question("frequency of the slowest reference [Hz]"),
    "track": Question(
        "references to track, with their frequencies in Hz",
        str,
        ", such as SIN10,PWSW40",
    ),
    "amplitude": Question("amplitude of the references, half of their range [um]"),
    "offset": Question("lowest value of the references [um]"),
    "slew": Question(
        "fastest slew that the controller follows; jumps become ramps [um/s]"
    ),
    "controller": Question(
        "controller to tune", str, ", such as inversion_pid or nv200"
    ),
    "scale": Question("scale of the gains of the device, 0 if unknown [V/um]"),
    "lowest": Question("lowest position of the device's range [um]"),
    "highest": Question("highest position of the device's range [um]"),
}
"""The questions by the name of their option; ``planned`` gives the defaults."""

OF_DEVICES = ("scale", "lowest", "highest")
"""Questions that only concern the controller of a vendor's device."""


def questions(function: Callable) -> Callable:
    """Add an option for each question of ``QUESTIONS``."""
    for name, question in reversed(QUESTIONS.items()):
        text = f"{question.text[0].upper()}{question.text[1:]}{question.more}."
        function = click.option(
            f"--{name}", type=question.kind, default=None, help=text
        )(function)
    return function


@click.command(cls=Command)
@click.argument("record", type=click.Path(path_type=Path))
@questions
@click.option("--model", help="Model to fit; 'all' compares all  [auto]")
@click.option(
    "--check",
    type=click.Path(path_type=Path),
    help="Second record of the stage, which validates the model.",
)
@click.option("--yes", is_flag=True, help="Ask nothing; use the options and defaults.")
@sliders_option
@recognised_columns
@common
def main(record, model, check, yes, sliders, out, seed, quiet, **given):
    """Tune a controller from a RECORD of your stage, and export its gains.

    The command asks for limits, sensor noise and references; the defaults come from
    the record, and each answer is also an option. It writes a study, which
    piezojax.tune can tune again, into the new folder. It does not export gains with an
    alarm. To go on after an interruption, give the same folder as --out.

    Exit status 3 means that the gains have an alarm, as for piezojax.tune.
    """

    def body(console):
        print_loading(console)
        from ..report.page import PAGE
        from ..tuning.result import load_result

        folder = out or numbered_folder(RESULTS / record.stem)
        study = folder / STUDY
        options = {"model": model, "check": check, "seed": seed}
        if study.is_file():
            _check_same(study, record, given, options)
            console.print(f"going on in {folder} with its {STUDY}", soft_wrap=True)
        else:
            _write_study(study, record, given, options, yes, console)
        tuned, outcome = _finished(study, console), None
        if tuned is None:
            tuned = numbered_folder(folder / TUNED)
            try:
                outcome = tune_study(study, tuned, None, None, console, sliders=sliders)
            except KeyboardInterrupt:
                console.print(_going_on(record, folder), soft_wrap=True)
                raise
        result = outcome.result if outcome else load_result(tuned)
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
            _export(folder, tuned, outcome, console)
        console.print(f"page with the results: {tuned / PAGE}", soft_wrap=True)
        finish(result)

    run(quiet, body)


def _write_study(
    study: Path,
    record: Path,
    given: dict[str, Any],
    options: dict[str, Any],
    yes: bool,
    console: Console,
) -> None:
    """Write the first ``study`` of ``record``; ask the ``QUESTIONS`` unless ``yes``."""
    from ..core.files import fresh_folder
    from ..study.first_plan import doubts, planned

    loaded, columns = _read(record, given)
    print_columns(console, [loaded])
    in_units = loaded.in_units(("V",), ("um",))
    asked = {name: given[name] for name in QUESTIONS}
    plan = planned(in_units, asked) if yes else _asked(in_units, asked)
    text = _text_of(study, record, loaded, columns, plan, options)
    fresh_folder(study.parent)
    write_text(study, text)
    for name, question in QUESTIONS.items():
        if _concerns(name, plan):
            console.print(f"{question.text}: {getattr(plan, name)}", soft_wrap=True)
    for doubt in doubts(plan, in_units):
        console.print(f"note: {doubt}", soft_wrap=True)
    console.print(f"wrote {study}", soft_wrap=True)


def _read(record: Path, given: dict[str, Any]) -> "tuple[Record, dict[str, Any]]":
    """Return the Record in the file ``record``, and the columns that it was read by."""
    from ..identification.records.recognise import recognised
    from ..identification.records.record import read_record

    columns = recognised(
        record, {name: value for name, value in given.items() if name not in QUESTIONS}
    )
    return read_record(record, **columns), columns


def _text_of(
    study: Path,
    record: Path,
    loaded: "Record",
    columns: dict[str, Any],
    plan: "Plan",
    options: dict[str, Any],
) -> str:
    """Return the text of the ``study`` of ``plan``; ``options`` are those of main."""
    from ..identification import DEFAULT
    from ..study.first_study import first_study

    return first_study(
        plan,
        record,
        columns,
        1.0 / loaded.dt,
        folder=study.parent,
        model=options["model"] or DEFAULT,
        check=options["check"],
        seed=options["seed"] or 0,
    )


def _asked(record: "Record", given: dict[str, Any]) -> "Plan":
    """Ask the questions that ``given`` does not answer, and return the Plan.

    A question is repeated after an invalid answer. Raises ValueError, naming the
    option, if the input ends before all are answered.
    """
    from ..study.first_plan import planned

    plan, answers = planned(record, given), dict(given)
    for name, question in QUESTIONS.items():
        while answers[name] is None and _concerns(name, plan):
            try:
                answer = click.prompt(question.text, default=getattr(plan, name))
            except click.Abort:
                raise ValueError(
                    f"no answer for the {question.text}: give it as --{name}, or "
                    "--yes for all defaults"
                ) from None
            try:
                plan = planned(record, answers | {name: answer})
                answers[name] = answer
            except ValueError as error:
                click.echo(f"{error}")
    return plan


def _concerns(name: str, plan: "Plan") -> bool:
    """Return whether a question matters for the controller of ``plan``."""
    from ..study.first_plan import DEVICES

    return name not in OF_DEVICES or plan.controller in DEVICES


def _check_same(
    study: Path, record: Path, given: dict[str, Any], options: dict[str, Any]
) -> None:
    """Raise ValueError if ``study`` has another record, or follows other options.

    A study that exists is tuned as it is. Options are accepted if they would write it.
    """
    from ..core.files import seen_from
    from ..study import load
    from ..study.first_plan import planned

    known = load(study).plant.get("record", [])  # a study may name a model instead
    known = known if isinstance(known, list) else [known]
    every = given | options
    named = [f"--{name}" for name, value in every.items() if value is not None]
    if seen_from(study.parent, record) not in known:
        named = [str(record)]
    elif named:
        loaded, columns = _read(record, given)
        asked = {name: given[name] for name in QUESTIONS}
        plan = planned(loaded.in_units(("V",), ("um",)), asked)
        text = _text_of(study, record, loaded, columns, plan, options)
        if text == study.read_text(encoding="utf-8"):
            return
    if named:
        raise ValueError(
            f"{study} was written before and does not follow {', '.join(named)}: edit "
            "it, or start in a new folder"
        )


def _finished(study: Path, console: Console) -> Path | None:
    """Return the newest folder of gains of a finished search on ``study``, or None.

    Gains of an earlier version of the study or of its record do not count.
    """
    from ..core.serial import read_about
    from ..study import contents_of, load, sha256_of
    from ..tuning.result import GAINS_FILE, RESULT_FILE, load_result

    known, found = load(study), []
    wanted = sha256_of(known, contents_of(known, study.parent))
    for file in study.parent.glob(f"{TUNED}*/{RESULT_FILE}"):
        folder = file.parent
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
) -> None:
    """Export the gains in ``tuned``, unless they are exported already.

    Gains of a device are written in its file format, all others as C code.
    """
    from ..study import load
    from ..study.first_plan import DEVICES
    from ..tuning.exported_runs import make_runs

    device = load(folder / STUDY).controller.get("design") in DEVICES
    # The gains in tuned-2 go to controller-2.
    exported = folder / tuned.name.replace(TUNED, EXPORTED, 1)
    if exported.is_dir() and any(exported.iterdir()):
        console.print(f"exported before: {exported}", soft_wrap=True)
        return
    exported = numbered_folder(exported)
    export_file(
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
