"""Common parts of the commands that move a stage."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from ..stages import Motion, Stage
    from ..stages.learning import LearningFilter
    from ..tuning.result import Result

stage_option: Callable = click.option(
    "--stage",
    "name",
    required=True,
    metavar="NAME",
    help="Stage: host:port (as printed by python -m piezojax.emulate), nv200:host, or "
    "module:function of your own stage.",
)


def tuned_gains(
    results: Path, named: Path | None = None
) -> "tuple[Result, dict[str, float], Sequence[Motion]]":
    """Return result, gains and motions of a folder of ``tune``.

    The paths of the gains are relative to the controller. ``named`` is the file of the
    study, by default the one in the folder. Raises ValueError for gains with an alarm,
    a folder without gains, and a study that lacks one of the tuned references.
    """
    from ..core.serial import load
    from ..stages.of_study import motions_of
    from ..study import load as load_study
    from ..tuning.result import GAINS_FILE, STUDY_FILE, load_result

    result = load_result(results)
    load(results / GAINS_FILE)  # refuses gains with an alarm
    promised = dict(result.holdout.per_reference_rms_um)
    if result.unseen is not None:
        promised |= result.unseen.per_reference_rms_um
    gains = {
        path.removeprefix("controller."): value for path, value in result.gains.items()
    }
    promised = {name: error for name, error in promised.items() if error is not None}
    study = named or results / STUDY_FILE
    motions = motions_of(load_study(study), study.parent, promised)
    known = {motion.name for motion in motions}
    if missing := [name for name in promised if name not in known]:
        raise ValueError(
            f"{study} has no reference {missing[0]}: it is not the study of {results}"
        )
    return result, gains, motions


def learning_law(results: Path, named: Path | None) -> "LearningFilter":
    """Return the learning filter of the loop in a folder of ``tune``.

    ``named`` is the file of its study, by default the one in the folder. Raises
    ValueError as ``study.read`` and ``load`` do.
    """
    import numpy as np

    from ..stages.learning import learning_filter
    from ..tuning.result import load_loop

    case, loop = load_loop(results, named)
    bound = case.plant_about.error_bound
    reference = float(np.max(case.margin_reference))
    return learning_filter(loop, reference, case.study.dt, bound, case.margin_duration)


@contextmanager
def connected(name: str) -> "Iterator[Stage]":
    """Yield the stage ``name``; close its connection at the end.

    After an error, the connection is abandoned instead, which makes the stage safe.
    Raises ValueError, one line, for a StageError.
    """
    from ..stages import ConnectedStage, StageError, stage_of

    stage = None
    try:
        stage = stage_of(name)
        yield stage
        if isinstance(stage, ConnectedStage):
            stage.close()
    except BaseException as error:
        if isinstance(stage, ConnectedStage):
            stage.abandon()
        if isinstance(error, StageError):
            raise ValueError(str(error)) from None
        raise
