"""Classes from outside the package: registered, listed, fitted, saved and loaded."""

import subprocess
import sys
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest

import piezojax as pj
from piezojax.core import registry
from piezojax.core.recipe import Extent, Fittable, Part, Recipe, scaled_range
from piezojax.core.serial import to_data
from piezojax.identification.candidates import parts_at
from piezojax.identification.chain import structure


def line(name="straight", place="hysteresis", base=pj.hysteresis.Hysteresis):
    """Return a new class without memory: y = slope x."""

    class Straight(base, Fittable):
        part: ClassVar[Part] = Part(name, place, "A straight line")

        dynamic: ClassVar[bool] = issubclass(base, pj.hysteresis.Hysteresis)

        slope: pj.core.arrays.Scalar = pj.core.parameter.parameter("um/V", "slope")

        @classmethod
        def recipe(cls, extent: Extent) -> Recipe:
            return Recipe(
                cls(extent.slope),
                {"slope": scaled_range(extent.slope, 0.0, 3.0)},
                ({},),
            )

        def init(self, input=0.0):
            return ()

        def step(self, state, input):
            return state, self.slope * jnp.asarray(input)

        def inverse(self, lower, upper):
            return pj.hysteresis.InverseHysteresis(self, lower, upper)

    return Straight


@pytest.fixture
def fresh(monkeypatch):
    """Restore the registry after the test."""
    registry.kinds()
    monkeypatch.setattr(registry, "_registered", dict(registry._registered))


def test_a_registered_class_is_listed_tried_and_fitted(fresh):
    kind = pj.register(line())
    assert list(registry.parts()).index("straight") == len(parts_at("hysteresis")) - 1
    assert parts_at("hysteresis")[-1] == "straight"
    x = np.sin(0.1 * np.arange(100))
    shape = structure("straight", pj.Record(x, 2.0 * x, 1e-3))
    assert shape.system.names == ("hysteresis", "calibration")
    assert isinstance(shape.system.parts[0], kind)


def test_a_registered_class_is_saved_and_loaded(fresh, tmp_path):
    kind = pj.register(line())
    pj.save(kind(2.0) >> pj.dynamics.FirstOrderLag(1e-3, 1e-4), tmp_path / "a.json")
    back = pj.load(tmp_path / "a.json")
    assert isinstance(back.parts[0], kind)
    assert float(back.parts[0].slope) == 2.0


def test_an_unregistered_class_is_not_saved(tmp_path):
    message = "Straight cannot be saved; register its class with piezojax.regis"
    with pytest.raises(ValueError, match=message):
        pj.save(line()(2.0), tmp_path / "a.json")
    with pytest.raises(ValueError, match=message):
        to_data(pj.Series((pj.Affine(1.0), line()(2.0))))
    assert not list(tmp_path.iterdir())


def test_invalid_systems_are_not_saved(tmp_path):
    lag = pj.core.paths.replace(
        pj.dynamics.FirstOrderLag(1e-3, 1e-4), {"time_constant": -1.0}
    )
    with pytest.raises(ValueError, match=r"a\.toml: time_constant in s is -1"):
        pj.save(lag, tmp_path / "a.toml")
    assert not list(tmp_path.iterdir())


def test_bad_names_and_places_are_refused(fresh):
    with pytest.raises(ValueError, match="place is 'attic'; it must be one of hyster"):
        pj.register(line(place="attic"))
    with pytest.raises(ValueError, match="name is 'lag', the name of FirstOrderLag"):
        pj.register(line("lag"))
    taken = type("PID", (pj.hysteresis.BoucWen,), {})
    with pytest.raises(ValueError, match=r"the name PID is taken by piezojax\.control"):
        pj.register(taken)


def test_an_entry_point_registers_its_classes(tmp_path):
    (tmp_path / "outside.py").write_text(
        "import equinox as eqx\n"
        "from piezojax import System\n"
        "class Outside(System):\n"
        "    def init(self, input=0.0):\n        return ()\n"
        "    def step(self, state, input):\n        return state, input\n"
        "class Another(Outside):\n    pass\n"
    )
    info = tmp_path / "outside-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Name: outside\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[piezojax.extensions]\nall = outside\none = outside:Another\n"
    )
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "from piezojax.core.registry import kinds\n"
        "print('Outside' in kinds(), 'Another' in kinds())\n"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ran.stdout.split() == ["True", "True"], ran.stderr
