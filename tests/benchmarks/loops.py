"""Picture of the loop of every hysteresis model.

    python tests/benchmarks/loops.py --out loops.png

Each model, with the parameters of choice_records.py, is driven slowly from 0 to 100 V
and back, then up with the same small loop four times; rate-dependent models are driven
again forty times as fast. There is no lag or noise.
"""

import argparse
from pathlib import Path

import choice_records
import jax
import numpy as np

import piezojax
from piezojax.report.figures import AFTER, BEFORE, add_title, figure, plot_style, write

CORNERS = (0, 100, 0, *4 * (65, 35), 100, 0)
SLOW, FAST = 4.0, 0.1  # samples per volt
ACROSS = 5

OTHERS = {
    "bouc_wen": lambda: piezojax.hysteresis.BoucWen(
        alpha=0.14, beta_gamma=0.012, beta_delta=-0.004, nu=1.3
    ),
}
"""Models without a record in choice.py."""

RATED = (
    "rate_dependent_prandtl_ishlinskii",
    "rate_dependent_preisach",
    "learned_operator",
)
FORCES = ("bouc_wen",)


def hysteresis(name):
    """The model ``name`` by itself."""
    if name in OTHERS:
        return OTHERS[name]()
    return choice_records.truth(name)[0].parts[0]


def followed(system, samples_a_volt):
    """Return input and output along the corners."""
    path = choice_records.strokes(CORNERS, samples_a_volt)
    path = np.concatenate([[CORNERS[0]], path])
    run = jax.jit(lambda x: piezojax.simulate(system, x, system.init(x[0]))[1])
    return path, np.asarray(run(path))


def picture():
    """Return the picture with a panel for each model."""
    names = [*choice_records.NAMES, *OTHERS]
    down = -(-len(names) // ACROSS)
    drawn = figure(2.3 * ACROSS, 2.2 * down)
    panels = drawn.subplots(down, ACROSS, sharex=True)
    for ax in panels.flat[len(names) :]:
        ax.set_visible(False)
    for ax, name in zip(panels.flat, names, strict=False):
        system = hysteresis(name)
        paces = [("slow", SLOW, AFTER)]
        if name in RATED:
            paces.append(("40 times as fast", FAST, BEFORE))
        for label, pace, colour in paces:
            ax.plot(*followed(system, pace), color=colour, lw=0.9, label=label)
        if len(paces) > 1:
            ax.legend(fontsize=6.5)
        ax.set_title(name, fontsize=7.0)
        force = name in FORCES
        ax.set_ylabel("force (N)" if force else "displacement (µm)", fontsize=7.0)
        ax.set_xlabel("displacement (µm)" if force else "input (V)", fontsize=7.0)
        ax.tick_params(labelbottom=True)
    add_title(
        drawn, "Loops of the hysteresis models, a small loop four times on the way"
    )
    return drawn


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    chosen = parser.parse_args()
    with plot_style():
        write(picture(), chosen.out)


if __name__ == "__main__":
    main()
