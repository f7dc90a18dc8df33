"""Common parts of all commands: options, the results folder, one-line errors."""

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ..core.files import fresh_folder, numbered_folder
from ..core.profile import Profile, profiled
from ..core.runtime import keep_programs
from ..core.temporaries import claimed, is_claimed, remove_stale
from .stopping import exit_interrupted, terminable
from .terminal import console

if TYPE_CHECKING:
    from ..report.page import Page

UNSAFE = 3
"""Exit status of a command that finished with an alarm."""

RESULTS = Path("results")
"""Parent folder of the results if ``--out`` is not given."""


def common(function: Callable) -> Callable:
    """Add the options ``--out``, ``--seed``, ``--quiet`` and ``--profile``."""
    for option in (
        click.option(
            "--profile",
            is_flag=True,
            help="Print where the time went: import, compiling, running, drawing.",
        ),
        click.option("--quiet", is_flag=True, help="Print only alarms and errors."),
        click.option(
            "--seed",
            type=click.IntRange(min=0),
            default=None,
            help="Seed of random numbers, where the command uses it (default: that of "
            "the study, or 0).",
        ),
        click.option(
            "--out",
            type=click.Path(path_type=Path),
            default=None,
            help="New folder for the results (default: a fresh one under results/).",
        ),
    ):
        function = option(function)
    return function


def given(*names: str) -> list[str]:
    """Return which of the options ``names`` the command line sets."""
    source = click.get_current_context().get_parameter_source
    return [name for name in names if source(name) is not ParameterSource.DEFAULT]


class Command(click.Command):
    """A command with one-line usage errors and, on request, a profile of its time."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments. Raises ClickException, one line, for a usage error."""
        try:
            return super().parse_args(ctx, args)
        except click.UsageError as error:
            raise _one_line(error.format_message()) from None

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; with ``--profile``, print the time of each stage."""
        asked = ctx.params.pop("profile", False)
        with profiled(_print_profile) if asked else nullcontext():
            return super().invoke(ctx)


@contextmanager
def results_folder(
    out: Path | None, name: str, going_on: str | None = None
) -> Iterator[Path]:
    """Yield an empty folder for results: ``out``, or a numbered one named ``name``.

    A folder ``out`` that holds the file ``going_on`` is yielded with its content, to be
    continued. No other command takes the folder while this one runs. The folder is
    removed if the work fails while it is empty. Raises ValueError if ``out`` holds
    other results, is in use or cannot be written.
    """
    with ExitStack() as stack:
        if out is not None and going_on and (out / going_on).is_file():
            if is_claimed(out):
                raise ValueError(f"--out {out} is in use by a running command")
            stack.enter_context(claimed(out))
            remove_stale(out)
            yield out
            return
        folder = fresh_folder(out or numbered_folder(RESULTS / name))
        while not stack.enter_context(claimed(folder)):  # another command was faster
            stack.close()
            folder = fresh_folder(out or numbered_folder(RESULTS / name))
        try:
            yield folder
        except BaseException:
            stack.close()
            if not any(folder.iterdir()):
                folder.rmdir()
            raise


def run(quiet: bool, body: Callable[[Console], Any]) -> None:
    """Run ``body``; report bad input in one line, with a non-zero exit status."""
    keep_programs()
    try:
        with terminable():
            body(console(quiet))
    except ValueError as error:
        raise _one_line(str(error)) from None
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        raise _one_line(f"{where}{error.strerror or error}") from None
    except KeyboardInterrupt:
        click.echo("interrupted; any finished files are kept", err=True)
        exit_interrupted()


def _print_profile(found: Profile) -> None:
    """Print the time of each stage on standard error, even of a quiet command."""
    table = Table(title="where the time went")
    table.add_column("stage")
    for heading in ("time, s", "share, %", "programs"):
        table.add_column(heading, justify="right")
    total = sum(found.seconds.values())
    for name, seconds in found.seconds.items():
        share = f"{100.0 * seconds / total:.1f}"
        number = found.programs.get(name, "")
        table.add_row(name, f"{seconds:.2f}", share, f"{number}")
    table.add_section()
    table.add_row("total", f"{total:.2f}", "100", "", style="bold")
    console(False, sys.stderr).print(table)


def print_loading(console: Console) -> None:
    """Print that the command has started, because importing JAX takes seconds."""
    console.print("loading", style="dim")


def print_alarms(console: Console, alarms: Sequence[str]) -> None:
    """Print ``alarms`` in red, on standard error if the console is quiet."""
    shown = Console(stderr=True, highlight=False) if console.quiet else console
    for alarm in alarms:
        shown.print(Text(f"ALARM: {alarm}", style="bold red"), soft_wrap=True)


def print_page(page: "Page", console: Console) -> None:
    """Print the alarms, tables and sentences of ``page``."""
    print_alarms(console, page.alarms)
    for part in page.parts:
        console.print(part, soft_wrap=isinstance(part, str))


def print_results(page: "Page", folder: Path, console: Console) -> None:
    """Print ``page``, and its path and that of the results in ``folder``."""
    from ..report.page import PAGE

    print_page(page, console)
    console.print(f"page: {folder / PAGE}; results in {folder}", soft_wrap=True)


def exit_unsafe(alarms: Sequence[str]) -> None:
    """End the command with the status ``UNSAFE`` if there are any ``alarms``."""
    if alarms:
        raise SystemExit(UNSAFE)


def _one_line(message: str) -> click.ClickException:
    return click.ClickException(" ".join(message.split()))
