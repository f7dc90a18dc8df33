"""Neural state-space model, for dynamics of unknown structure."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.arrays import as_array
from ..core.parameter import parameter
from ..core.root import root
from ..core.system import System


class NeuralStateSpace(System):
    """``x(k+1) = A x + B v + F tanh(G x + H v + b)``, ``y(k+1) = C x(k+1) + y_0``.

    v = u - u_0; a step maps u(k) to y(k+1). A single input or output is a scalar,
    several are vectors. Shapes, with n states and h neurons: ``state_matrix`` A [n, n],
    ``input_matrix`` B [n, m], ``output_matrix`` C [p, n], ``neuron_output`` F [n, h],
    ``neuron_state`` G [h, n], ``neuron_input`` H [h, m], ``neuron_bias`` b [h],
    ``input_offset`` u_0 [m] and ``output_offset`` y_0 [p] in the units of input and
    output; the states have none. Source: Suykens et al., Nonlinear system
    identification using neural state space models, 1995.

    Raises ValueError for shapes that do not match or non-finite numbers.
    """

    state_matrix: Float[Array, "n n"] = parameter("1", "A")
    input_matrix: Float[Array, "n m"] = parameter("1", "B")
    output_matrix: Float[Array, "p n"] = parameter("1", "C")
    neuron_output: Float[Array, "n h"] = parameter("1", "F")
    neuron_state: Float[Array, "h n"] = parameter("1", "G")
    neuron_input: Float[Array, "h m"] = parameter("1", "H")
    neuron_bias: Float[Array, " h"] = parameter("1", "b")
    input_offset: Float[Array, " m"] = parameter("1", "u_0")
    output_offset: Float[Array, " p"] = parameter("1", "y_0")

    def __check_init__(self):
        n, m, p = (
            len(self.state_matrix),
            len(self.input_offset),
            len(self.output_offset),
        )
        h = len(self.neuron_bias)
        for name, shape in {
            "state_matrix": (n, n),
            "input_matrix": (n, m),
            "output_matrix": (p, n),
            "neuron_output": (n, h),
            "neuron_state": (h, n),
            "neuron_input": (h, m),
            "neuron_bias": (h,),
            "input_offset": (m,),
            "output_offset": (p,),
        }.items():
            value = getattr(self, name)
            if value.shape != shape:
                raise ValueError(
                    f"{name} has shape {value.shape}; with {n} states, {h} neurons, "
                    f"{m} inputs and {p} outputs it must be {shape}"
                )

    def init(self, input: Any = 0.0) -> Float[Array, " n"]:
        """Return the state at rest under ``input``, by Newton's method from zero."""
        zero = jnp.zeros_like(self.state_matrix[0])
        rest = root(
            lambda given, state: given[0]._next(state, given[1]) - state,
            (self, as_array(input)),
            zero,
        )
        return jnp.where(jnp.isfinite(rest), rest, zero)

    def step(
        self, state: Float[Array, " n"], input: Any
    ) -> tuple[Float[Array, " n"], Any]:
        state = self._next(state, input)
        output = self.output_matrix @ state + self.output_offset
        return state, output[0] if len(output) == 1 else output

    def _next(self, state: Float[Array, " n"], input: Any) -> Float[Array, " n"]:
        moved = jnp.atleast_1d(as_array(input)) - self.input_offset
        neurons = jnp.tanh(
            self.neuron_state @ state + self.neuron_input @ moved + self.neuron_bias
        )
        linear = self.state_matrix @ state + self.input_matrix @ moved
        return linear + self.neuron_output @ neurons
