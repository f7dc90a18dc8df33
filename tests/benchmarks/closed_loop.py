"""Bias and scatter of a mode that is identified from records of closed loops.

    python tests/benchmarks/closed_loop.py [--draws 20] [--excite reference] [--json F]

Three controllers hold a stage with one mode (``tests/oracles/closed_loop.py``, which
shares no code with piezojax) while strong coloured noise acts on its output. The
binary excitation is added to the reference, to the voltage, or to both. Frequency,
damping and gain of the mode and its response are estimated from each record by every
approach, by the estimator for open loops, and from a record of an open loop whose
input is what the excitation causes in the closed one. All see the same noise. The last
columns are errors of the response over 50 to 2000 Hz, rms values over the lines: that
of the mean over the draws and the scatter, for the model and for the spectral estimate.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1]))

from oracles import closed_loop

from piezojax import Record
from piezojax.control import PID, FilteredCommand
from piezojax.core.progress import Silent
from piezojax.dynamics import Notch
from piezojax.identification import METHODS, Options
from piezojax.identification.estimators.loop_response import loop_response

SAMPLES = 4096
REFERENCE, DITHER = 0.3, 1.0
"""Amplitudes of the excitations, um and V."""

NOISE = 0.005
"""White noise behind the noise on the output, um rms."""

REST = 50
"""Samples without excitation at the beginning of a record."""

TRUE = np.array([closed_loop.FREQUENCY, closed_loop.DAMPING, closed_loop.GAIN])
BAND = np.linspace(50.0, 2000.0, 200)
SEGMENT = 512
PATHS = ("dynamics.frequency", "dynamics.damping", "calibration.gain")
ROWS = ("open loop", "as open loop", "default", "direct", "indirect", "joint")


def controller_of(gains):
    """Return the controller as a System of piezojax."""
    pid = PID(
        gains.proportional,
        gains.integral,
        gains.derivative,
        gains.smooth,
        dt=closed_loop.DT,
    )
    if gains.notch is None:
        return pid
    shape = closed_loop.NOTCH_DAMPING, closed_loop.NOTCH_DEPTH
    return FilteredCommand(pid, Notch(gains.notch, *shape, closed_loop.DT))


def records_of(gains, excite, seed):
    """Return the record of the closed loop, and that of the open one."""
    draw = np.random.default_rng(seed)
    reference, dither = (
        size * draw.choice([-1.0, 1.0], SAMPLES) for size in (REFERENCE, DITHER)
    )
    reference[:REST] = dither[:REST] = 0.0
    reference = reference * (excite != "dither")
    dither = dither * (excite != "reference")
    noise = closed_loop.noise(draw, SAMPLES, NOISE)
    closed = closed_loop.run(gains, reference, dither, noise)
    quiet, _ = closed_loop.run(gains, reference, dither, np.zeros(SAMPLES))
    return (
        Record(
            *closed, closed_loop.DT, reference=reference, dither=dither, source="loop"
        ),
        Record(
            quiet, closed_loop.open_run(quiet, noise), closed_loop.DT, source="open"
        ),
    )


def fitted(record, approach=None, controller=None):
    """Return the mode of ``identify``, and how it was fitted."""
    estimate = METHODS["output_error"].estimate(
        "mode",
        [record],
        slice(0, record.samples),
        Options(closed_loop=approach, controller=controller),
        Silent(),
    )
    values = [estimate.parameters[path].value for path in PATHS]
    return np.array(values), estimate.closed_loop


def estimates(gains, excite, seed):
    """Return the mode by each approach, and the spectral responses in the band."""
    record, open_record = records_of(gains, excite, seed)
    naive = Record(record.input, record.output, record.dt, source="loop")
    controller = controller_of(gains)
    default, said = fitted(record)
    modes = {
        "open loop": fitted(open_record)[0],
        "as open loop": fitted(naive)[0],
        "default": default,
        "direct": default if said.startswith("direct") else fitted(record, "direct")[0],
        "indirect": fitted(record, "indirect", controller)[0],
        "joint": fitted(record, "joint")[0],
    }
    lines = np.fft.rfftfreq(SEGMENT, closed_loop.DT)
    kept = (lines >= BAND[0]) & (lines <= BAND[-1])
    spectra = {}
    for name, one, approach, inside in (
        ("open loop", open_record, "direct", None),
        ("as open loop", record, "direct", None),
        ("indirect", record, "indirect", controller),
        ("joint", record, "joint", None),
    ):
        found = loop_response(one, approach, inside, segment=SEGMENT)
        values = np.full(lines.size, np.nan, complex)
        values[np.isin(lines, found.frequency)] = found.response
        spectra[name] = values[kept]
    return modes, spectra, lines[kept], said


def response_error(values, exact):
    """Return the bias and the scatter of responses [draws, lines], rms over lines."""
    relative = values / exact - 1.0
    mean = relative.mean(axis=0)
    rms = [np.sqrt(np.nanmean(np.abs(x) ** 2)) for x in (mean, relative - mean)]
    return tuple(100.0 * float(x) for x in rms)


def main():
    """Run the draws and print one table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument(
        "--excite", choices=("reference", "dither", "both"), default="reference"
    )
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    console, rows = Console(width=150), []
    for controller, gains in closed_loop.CONTROLLERS.items():
        runs = [estimates(gains, arguments.excite, s) for s in range(arguments.draws)]
        lines = runs[0][2]
        direct = sum(said.startswith("direct") for *_, said in runs)
        console.print(
            f"{controller}: the default was direct in {direct} of {len(runs)} records"
        )
        for name in ROWS:
            modes = np.array([run[0][name] for run in runs])
            scale = 100.0 / TRUE
            bias = (modes.mean(axis=0) - TRUE) * scale
            scatter = modes.std(axis=0, ddof=1) * scale
            model = np.array([closed_loop.stage_response(BAND, *m) for m in modes])
            row = {
                "controller": controller,
                "estimate": name,
                "bias": bias.tolist(),
                "standard_error": (scatter / np.sqrt(len(runs))).tolist(),
                "scatter": scatter.tolist(),
                "model": response_error(model, closed_loop.stage_response(BAND)),
            }
            if name in runs[0][1]:
                values = np.array([run[1][name] for run in runs])
                exact = closed_loop.stage_response(lines)
                row["spectral"] = response_error(values, exact)
            rows.append(row)
    console.print(table_of(rows, arguments))
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


def table_of(rows, arguments):
    """Return the table: bias +- its standard error (scatter), in % of the truth."""
    table = Table(
        title=f"{arguments.draws} draws, excited by {arguments.excite}: bias +- its "
        "standard error (scatter of one record), % of the truth"
    )
    columns = ("controller", "estimate", "frequency", "damping", "gain")
    for column in (*columns, "model", "spectral"):
        table.add_column(column, justify="right")
    for row in rows:
        figures = zip(row["bias"], row["standard_error"], row["scatter"], strict=True)
        table.add_row(
            row["controller"],
            row["estimate"],
            *(
                f"{b:+.2f} +- {e:.2f} ({s:.2f}){'' if abs(b) <= 2 * e else ' !'}"
                for b, e, s in figures
            ),
            *(
                "{:.1f} ({:.1f})".format(*row[kind]) if kind in row else ""
                for kind in ("model", "spectral")
            ),
        )
    return table


if __name__ == "__main__":
    main()
