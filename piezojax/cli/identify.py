"""``python -m piezojax.identify RECORD --model NAME --out DIR``."""

from pathlib import Path

import click

from .command import (
    Command,
    common,
    exit_unsafe,
    given,
    print_loading,
    print_results,
    results_folder,
    run,
)
from .identify_response import Amplitudes, ResponseOptions, fit_responses, load_dynamics
from .records import SampleRange, print_columns, record_columns
from .stopping import exit_interrupted
from .terminal import Bar

ALL = "all"
"""Value of ``--model`` that fits every model the records support."""


class _Gain(click.ParamType):
    name = "NAME=VALUE"

    def convert(self, value, param, ctx):
        name, _, number = value.partition("=")
        try:
            return name.strip(), float(number)
        except ValueError:
            self.fail(f"{value!r} must be a name and a number, as in ki=70", param, ctx)


@click.command(cls=Command)
@click.argument(
    "records", nargs=-1, type=click.Path(path_type=Path), metavar="RECORD..."
)
@click.option(
    "--model",
    default="auto",
    show_default=True,
    help="Model to fit, parts joined by '+'; 'help' lists all, 'all' compares all.",
)
@click.option(
    "--controller",
    metavar="DEVICE",
    help="Measure the scale of the gains of an nv200 or e727, from a record of its "
    "error and voltage.",
)
@click.option(
    "--gain",
    "gains",
    multiple=True,
    type=_Gain(),
    help="With --controller: a gain during the record, as ki=70; repeat for each gain.",
)
@click.option(
    "--response",
    is_flag=True,
    help="Fit modes, lag and delay to the frequency response in RECORD, for a "
    "controller at --rate. With --method, RECORD is a record over time, from which the "
    "response is measured first.",
)
@click.option(
    "--held/--not-held",
    default=None,
    help="With --response: converters held the input between samples, at the rate of "
    "the record or --rate (default: held in a record over time).",
)
@click.option("--unit", help="With --response: unit of the response in a file  [um/V]")
@click.option(
    "--amplitude",
    "amplitudes",
    type=Amplitudes(),
    default=(),
    help="With --response: rms amplitude of the input of each response.",
)
@click.option(
    "--realisations",
    type=click.IntRange(min=1),
    default=1,
    help="With --response: number of realisations of the multisine, one after another "
    "in a RECORD.",
)
@click.option(
    "--skip",
    type=click.IntRange(min=0),
    help="With --response: number of periods that the method robust discards at the "
    "start  [1]",
)
@click.option(
    "--segment",
    type=click.IntRange(min=1),
    help="With --response: number of samples in a segment of the method welch.",
)
@click.option(
    "--dynamics",
    type=click.Path(path_type=Path),
    help="Keep the linear dynamics of this saved model; fit only hysteresis and creep.",
)
@click.option(
    "--closed-loop",
    type=click.Choice(["direct", "indirect", "joint"]),
    help="Approach to a record of a closed loop (default with a --reference or "
    "--dither: direct, or joint where the noise model of direct fails).",
)
@click.option(
    "--loop-controller",
    metavar="FILE|NAME",
    help="With --closed-loop indirect: controller that closed the loop, as the path of "
    "a gains.toml or its name in the catalogue.",
)
@click.option(
    "--among",
    help="With --model all: compare only these hysteresis models, separated by commas, "
    "and the linear models.",
)
@record_columns
@click.option(
    "--method",
    help="Method of the fit (default: the first that can fit the model). With "
    "--response: method that measures the response: welch, local_polynomial or robust.",
)
@click.option(
    "--order",
    type=click.IntRange(min=1),
    default=4,
    show_default=True,
    help="Number of states of a linear or neural model.",
)
@click.option(
    "--window",
    type=click.IntRange(min=1),
    default=20,
    show_default=True,
    help="Number p of past and future samples in the Hankel-Toeplitz regression.",
)
@click.option(
    "--oversample",
    type=click.IntRange(min=1),
    default=8,
    show_default=True,
    help="Simulated steps of bouc_wen per sample.",
)
@click.option(
    "--steps",
    type=click.IntRange(min=1),
    default=200,
    show_default=True,
    help="Largest number of optimiser steps; the methods output_error, steady_state "
    "and scheduled_frequency_response use it.",
)
@click.option(
    "--train", type=SampleRange(), help="Samples to fit (default: first half)."
)
@click.option(
    "--validate", type=SampleRange(), help="Samples to validate on (default: rest)."
)
@click.option(
    "--test",
    type=SampleRange(),
    help="With --model all: samples for a hold-out error.",
)
@common
def main(
    records,
    model,
    controller,
    gains,
    response,
    held,
    unit,
    amplitudes,
    realisations,
    skip,
    segment,
    dynamics,
    closed_loop,
    loop_controller,
    among,
    method,
    order,
    window,
    oversample,
    steps,
    train,
    validate,
    test,
    out,
    seed,
    quiet,
    **columns,
):
    """Fit a plant model to measured RECORDs of one stage.

    With --controller, measure how a device scales its gains: the input column is its
    error, the output column its voltage. With --response, fit a frequency response.

    A RECORD is a text file (.csv, .txt, .dat) or a .npz, .mat or .h5 file; with
    piezojax[lab] also a .tdms, .lvm or .xlsx file.

    Exit status 3 means that the model has an alarm. The alarms are printed first, and
    model.json loads only with accept_unsafe.
    """
    del seed  # the random starts of a fit have fixed seeds
    numbers = given("order", "window", "oversample", "steps")

    # JAX and its users are imported here, so that --help does not wait for them.
    def body(console):
        print_loading(console)
        from ..identification.estimators.estimate import Options
        from ..identification.make_fit import identify
        from ..identification.methods import method_for
        from ..identification.records.record import read_record
        from ..report.fit_page import fit_page
        from ..report.fit_pictures import write_fit
        from ..report.fit_tables import models_table
        from ..report.page import write_page

        if model == "help":
            console.print(models_table())
            return
        if not records:
            raise ValueError("give a RECORD to fit a model to")
        responses = ResponseOptions(
            method, held, unit, amplitudes, realisations, skip, segment
        )
        if gains and not controller:
            raise ValueError("--gain needs --controller")
        if responses.given() and not response:
            raise ValueError(f"{', '.join(responses.given())} need --response")
        if response and controller:
            raise ValueError("--response and --controller exclude each other")
        if dynamics and (response or controller or model == ALL):
            raise ValueError(
                "--dynamics needs one model: it excludes --response, --controller and "
                "--model all"
            )
        if response or controller:
            check_used("with --response or --controller", ())
        elif model != ALL:
            check_used(f"in the fit of {model}", method_for(model, method).uses)
        if response:
            fit_responses(console, records, columns, responses, out)
            return
        if model == ALL and method is not None:
            raise ValueError("--method needs one model; 'all' uses the default of each")
        if model != ALL and (among is not None or test):
            raise ValueError("--among and --test need --model all")
        loaded = [read_record(record, **columns) for record in records]
        print_columns(console, loaded)
        inside = None
        if loop_controller is not None:
            inside = controller_of(loop_controller, 1.0 / loaded[0].dt)
        held_dynamics = load_dynamics(dynamics)
        options = Options(
            order, window, oversample, steps, held_dynamics, closed_loop, inside
        )
        if controller is not None:
            measure(console, loaded)
            return
        if model == ALL:
            compare(console, loaded, options)
            return
        with Bar(console) as bar, results_folder(out, records[0].stem) as folder:
            fit = identify(
                loaded,
                model,
                method=method,
                train=train,
                validate=validate,
                options=options,
                progress=bar,
            )
            bar.stage("drawing")
            pictures = write_fit(fit, folder)
            page = fit_page(fit)
            write_page(page, folder, pictures)
        print_results(page, folder, console)
        exit_unsafe(page.alarms)

    def check_used(where, used):
        idle = [f"--{name}" for name in numbers if name not in used]
        if idle:
            raise ValueError(f"{', '.join(idle)}: not used {where}; leave it out")

    def controller_of(source, rate):
        from ..catalog import CONTROLLERS, at_rate
        from ..core.serial import load

        if source in CONTROLLERS:
            return at_rate(CONTROLLERS, source, rate)
        if not Path(source).is_file():
            raise ValueError(
                f"--loop-controller {source!r} is neither a file nor one of the "
                f"catalogue: {', '.join(CONTROLLERS)}"
            )
        # It ran on the stage when the record was made, whatever its alarms.
        return load(source, accept_unsafe=True)

    def measure(console, loaded):
        from ..core.files import write_json
        from ..identification.device_scale import device_scale
        from ..report.fit_tables import scale_table
        from ..report.page import Page, write_page

        if len(loaded) > 1:
            raise ValueError("--controller takes one RECORD")
        found = device_scale(controller, loaded[0], dict(gains))
        notes = [f"note: {note}" for note in found.notes]
        page = Page(f"gains of a {found.device}", (), [scale_table(found), *notes])
        with results_folder(out, records[0].stem) as folder:
            write_json(folder / "scale.json", found.model_dump())
            write_page(page, folder)
        print_results(page, folder, console)

    def compare(console, loaded, options):
        from ..identification.compare import identify_all
        from ..identification.unfinished import KEY
        from ..report.model_ranking import (
            ranking_page,
            write_ranking,
            write_ranking_so_far,
        )
        from ..report.page import write_page

        with (
            Bar(console) as bar,
            results_folder(out, records[0].stem, KEY) as folder,
        ):
            ranking = identify_all(
                loaded,
                hysteresis=None if among is None else among.split(","),
                train=train,
                validate=validate,
                test=test,
                options=options,
                progress=bar,
                done=lambda ranking: write_ranking_so_far(ranking, folder),
                folder=folder,
            )
            bar.finish()
            bar.stage("drawing")
            pictures = write_ranking(ranking, folder)
            page = ranking_page(ranking)
            write_page(page, folder, pictures)
        print_results(page, folder, console)
        if ranking.report.interrupted:
            console.print(
                f"the same command with --out {folder} goes on from these fits",
                soft_wrap=True,
            )
            exit_interrupted()
        exit_unsafe(page.alarms)

    run(quiet, body)
