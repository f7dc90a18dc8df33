"""Fisher information of a record on the parameters of a plant."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.arrays import as_array
from ..core.paths import get, replace
from ..core.system import System
from .estimators.free_runs import free_run


class Unknowns(eqx.Module):
    """Parameters of ``plant`` at ``paths``, and the zero of the sensor, to estimate.

    Changes of the parameters count in multiples of ``scales``.
    """

    plant: System
    paths: tuple[str, ...] = eqx.field(static=True)
    scales: Float[Array, " n"]

    def at(self, changes: Float[Array, " n"]) -> System:
        """Return the plant with its parameters changed by ``changes``."""
        moved = {
            path: as_array(get(self.plant, path)) + scale * change
            for path, scale, change in zip(
                self.paths, self.scales, changes, strict=True
            )
        }
        return replace(self.plant, moved)

    def information(
        self, voltages: Float[Array, " samples"], noise: Float[Array, ""]
    ) -> Float[Array, "all all"]:
        """Return the Fisher information of a record on the changes and on the zero.

        The stage rests under the first of the ``voltages`` (V) before the record. The
        sensor adds white noise of the rms value ``noise``, in the unit of the output.
        The zero, last, is in that unit too. A plant of another class than the model, or
        coloured noise, leaves less information (Ljung, System Identification, 2nd ed.,
        7.4 and 9.3).
        """

        def output(changes):
            run = free_run(self.at(changes[:-1]), voltages, voltages[0])
            return run + changes[-1]

        jacobian = jax.jacfwd(output)(jnp.zeros(len(self.paths) + 1))
        return jacobian.T @ jacobian / noise**2
