"""Stage with the largest gain of an assumed hysteresis."""

import equinox as eqx
import jax

from ..core.system import Affine
from ..signals.missing_hysteresis import steepest
from ..study import Case, Stage
from .data import own_stage


def steep_stage(case: Case) -> Stage | None:
    """Return the stage of ``case`` with the gain before a turn, stacked.

    The plant has the gain for small motions; ``steepest`` is the ratio. None without an
    assumed hysteresis, on several axes, and if no Affine gives the gain of the plant.
    """
    if case.assumed_hysteresis == 0.0 or case.study.axes is not None:
        return None
    leaves = jax.tree.leaves(case.loop.plant, is_leaf=_is_affine)
    place = next((i for i, leaf in enumerate(leaves) if _is_affine(leaf)), None)
    if place is None:
        return None
    return eqx.tree_at(
        lambda stage: jax.tree.leaves(stage.plant, is_leaf=_is_affine)[place].gain,
        own_stage(case.loop),
        replace_fn=lambda gain: steepest(case.assumed_hysteresis) * gain,
    )


def _is_affine(part: object) -> bool:
    return isinstance(part, Affine)
