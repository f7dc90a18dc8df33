"""Autoregressive moving-average dynamics of any order."""

import itertools
from typing import ClassVar

import numpy as np

from ..core.arrays import Scalar, ScalarLike, Scalars, as_array, as_scalars
from ..core.parameter import parameter
from ..core.recipe import Extent, Fittable, Part, Recipe, Resonance
from ..core.space import Range


class ARMA(Fittable):
    """``y(k) = sum_i autoregressive[i] y(k-1-i) + sum_i moving[i] x(k-i)``, (3.30).

    ``autoregressive`` holds a_1, a_2, ... with the sign of the thesis (on the
    right-hand side), ``moving`` holds b_0, b_1, ...; x and y have the units of the
    neighbours in the chain. The state is that of the transposed direct form, which is
    the smallest: element i is the contribution of past samples to the output i + 1
    samples ahead. Raises ValueError for empty ``moving`` or non-finite coefficients.
    """

    part: ClassVar[Part] = Part(
        "arma", "dynamics", "Second-order dynamics (3.30) with two zeros"
    )

    autoregressive: Scalars = parameter(
        "1", "coefficients of past outputs", converter=as_scalars
    )
    moving: Scalars = parameter("1", "coefficients of the input", converter=as_scalars)

    def __check_init__(self):
        if not self.moving:
            raise ValueError("moving is empty; it must hold at least b_0")

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        return Recipe(
            cls((0.9, -0.2), (0.3, 0.0, 0.0)),
            {
                "autoregressive.0": Range(-2.0, 2.0),
                "autoregressive.1": Range(-1.0, 1.0),
                **{f"moving.{i}": Range(-3.0, 3.0) for i in range(3)},
            },
            [_sampled(mode, extent.dt) for mode in extent.modes]
            or [
                {"autoregressive.0": 2.0 * p, "autoregressive.1": -p * p, "moving.0": q}
                for p, q in ((0.3, 0.49), (0.8, 0.04))
            ],
            gain="moving.0",
        )

    def dc_gain(self) -> Scalar:
        """Return output over input at rest."""
        return as_array(sum(self.moving) / (1.0 - sum(self.autoregressive)))

    def poles(self) -> np.ndarray:
        """Return the poles in the z plane (concrete parameters only)."""
        return np.roots([1.0, *(-float(a) for a in self.autoregressive)])

    def zeros(self) -> np.ndarray:
        """Return the zeros in the z plane (concrete parameters only)."""
        return np.roots([float(b) for b in self.moving])

    def init(self, input: ScalarLike = 0.0) -> tuple[Scalar, ...]:
        input = as_array(input)
        terms = self._past(input, self.dc_gain() * input)
        return tuple(itertools.accumulate(reversed(terms)))[::-1]

    def step(
        self, state: tuple[Scalar, ...], input: ScalarLike
    ) -> tuple[tuple[Scalar, ...], Scalar]:
        input = as_array(input)
        output = self.moving[0] * input
        if not state:
            return state, output
        output = output + state[0]
        *terms, last = self._past(input, output)
        later = (x + rest for x, rest in zip(terms, state[1:], strict=True))
        return (*later, last), output

    def _past(self, input: Scalar, output: Scalar) -> list[Scalar]:
        """Return the contributions of one sample to the outputs 1, 2, ... samples
        later."""
        fed_back = [a * output for a in self.autoregressive]
        fed_forward = [b * input for b in self.moving[1:]]
        longer, shorter = sorted((fed_back, fed_forward), key=len, reverse=True)
        both = [x + y for x, y in zip(longer, shorter, strict=False)]
        return both + longer[len(shorter) :]


def _sampled(mode: Resonance, dt: float) -> dict[str, float]:
    """Return the coefficients of ``mode``, by path, for a held input."""
    angle = 2.0 * np.pi * mode.frequency * dt
    turn = np.sqrt(1.0 - mode.damping**2)
    pole = np.exp(angle * (-mode.damping + 1j * turn))
    # The first sample of the step response.
    first = 1.0 - pole.real - mode.damping / turn * pole.imag
    a1, a2 = 2.0 * pole.real, -(abs(pole) ** 2)
    rest = 1.0 - a1 - a2 - first
    paths = ("autoregressive.0", "autoregressive.1", "moving.0", "moving.1")
    return dict(zip(paths, map(float, (a1, a2, first, rest)), strict=True))


def scaled_to_dc(model: ARMA, gain: ScalarLike) -> ARMA:
    """Return ``model`` with its numerator scaled so that its DC gain is ``gain``."""
    factor = gain / model.dc_gain()
    return ARMA(model.autoregressive, tuple(b * factor for b in model.moving))
