"""Questions of ``python -m piezojax.start``, which are also its options."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import click

if TYPE_CHECKING:
    from ..study.first_plan import Plan, Shown


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
    "slew_rate": Question("largest slew rate of the voltage, 0 for no limit [V/s]"),
    "noise": Question("rms noise of the sensor [um]"),
    "hysteresis": Question(
        "width of the hysteresis loop that large motions have, relative to its height"
    ),
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
    "acceleration": Question(
        "largest acceleration that the controller follows; the ramps start and end "
        "with it [um/s^2]"
    ),
    "scale": Question("scale of the gains of the device, 0 if unknown [V/um]"),
    "structure": Question(
        "structure of the PID of the device: series, parallel or unknown", str
    ),
    "lowest": Question("lowest position of the device's range [um]"),
    "highest": Question("highest position of the device's range [um]"),
}
"""The questions by the name of their option; ``planned`` gives the defaults."""

OF_DEVICES = {
    **dict.fromkeys(("scale", "structure", "lowest", "highest"), True),
    "acceleration": False,
}
"""Questions that concern only the controllers of devices (True), or only the others."""


def questions(function: Callable) -> Callable:
    """Add an option for each question of ``QUESTIONS``."""
    for name, question in reversed(QUESTIONS.items()):
        text = f"{question.text[0].upper()}{question.text[1:]}{question.more}."
        function = click.option(
            f"--{option(name)}", type=question.kind, default=None, help=text
        )(function)
    return function


def asked(
    shown: "Callable[[dict[str, Any]], Shown]",
    given: dict[str, Any],
    needed: tuple[str, ...] = (),
) -> "Plan":
    """Ask the questions that ``given`` does not answer, and return the Plan.

    ``shown`` returns what the measurement shows, from the answers; ``needed`` are the
    questions without which it shows nothing, and so without a default. A question is
    repeated after an invalid answer. Raises ValueError, naming the option, if the input
    ends before all are answered.
    """
    from ..study.first_plan import planned

    answers = dict(given)
    for name in needed:
        if answers[name] is None:
            answers[name] = _prompted(name, None)
    plan = planned(shown(answers), answers)
    for name in QUESTIONS:
        while answers[name] is None and concerns(name, plan):
            answer = _prompted(name, getattr(plan, name))
            try:
                plan = planned(shown(answers), answers | {name: answer})
                answers[name] = answer
            except ValueError as error:
                click.echo(f"{error}")
    return plan


def _prompted(name: str, default: Any) -> Any:
    question = QUESTIONS[name]
    try:
        return click.prompt(question.text, default=default, type=question.kind)
    except click.Abort:
        raise ValueError(
            f"no answer for the {question.text}: give it as --{option(name)}"
            + ("" if default is None else ", or --yes for all defaults")
        ) from None


def option(name: str) -> str:
    """Return the name of the option of a question, without its dashes."""
    return name.replace("_", "-")


def concerns(name: str, plan: "Plan") -> bool:
    """Return whether ``plan`` has an answer that matters for its controller."""
    from ..study.first_plan import DEVICES

    known = getattr(plan, name) is not None
    device = plan.controller in DEVICES
    return known and OF_DEVICES.get(name, device) == device
