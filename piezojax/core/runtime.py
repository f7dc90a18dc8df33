"""Float64, XLA flags and compilation cache, set before JAX picks a backend."""

import os
import sys
import warnings
from importlib.metadata import version
from typing import Any

# Internal options: an unknown one aborts the process, so each is only set for the
# jaxlib versions, from the one here to _BEFORE, on which it was seen to parse.
_CPU_FLAGS = {
    # A scan whose carry exceeds about 1 kB is otherwise run kernel by kernel,
    # which costs microseconds a step; with this the loop is one function.
    # Given beside a user's own extra options, it is added to them.
    "xla_cpu_small_while_loop_byte_threshold": (
        "--xla_backend_extra_options="
        "xla_cpu_small_while_loop_byte_threshold=1000000000",
        (0, 9, 2),
    ),
    "xla_cpu_prefer_vector_width": ("--xla_cpu_prefer_vector_width=512", (0, 9, 2)),
    "xla_cpu_copy_insertion_use_region_analysis": (
        "--xla_cpu_copy_insertion_use_region_analysis=true",
        (0, 9, 2),
    ),
    # The newer code generator takes up to twice as long, and loops run no faster.
    "xla_cpu_use_fusion_emitters": ("--xla_cpu_use_fusion_emitters=false", (0, 10)),
}
_BEFORE = (0, 13)

CACHE_VARIABLE = "PIEZOJAX_COMPILATION_CACHE"


def _set(option: str, value: Any) -> None:
    # Importing JAX takes a second, which `--help` need not wait for: an option that is
    # set in the environment is read when JAX is imported.
    if jax := sys.modules.get("jax"):
        jax.config.update(option, value)
    else:
        os.environ[option.upper()] = str(value)


def _backend_is_running() -> bool:
    # JAX has no public question for this that does not itself start the backend.
    if "jax" not in sys.modules:
        return False
    try:
        from jax._src import xla_bridge

        return bool(xla_bridge.backends_are_initialized())
    except (ImportError, AttributeError):
        return False


def _missing_flags(current: str, jaxlib: tuple[int, ...]) -> list[str]:
    return [
        flag
        for name, (flag, since) in _CPU_FLAGS.items()
        if name not in current and since <= jaxlib < _BEFORE
    ]


def configure() -> None:
    """Prepare JAX for closed-loop simulation; called once by ``import piezojax``.

    Switches JAX to float64 (float32 loses 14 nm in the controller's slow filters),
    appends the CPU flags above to the user's own ``XLA_FLAGS`` without replacing any,
    and, if the environment names a folder in ``PIEZOJAX_COMPILATION_CACHE``, keeps
    compiled programs there. Warns when a backend is already running, because XLA then
    ignores the flags and loops run 3 to 75 times slower.
    """
    _set("jax_enable_x64", True)
    jaxlib = tuple(
        int(part) for part in version("jaxlib").split(".")[:3] if part.isdigit()
    )
    current = os.environ.get("XLA_FLAGS", "")
    missing = _missing_flags(current, jaxlib)
    if missing and _backend_is_running():
        warnings.warn(
            "piezojax was imported after JAX had started its backend: XLA ignores "
            "the flags that make the simulation loop fast. Import piezojax first.",
            RuntimeWarning,
            stacklevel=3,
        )
    elif missing:
        os.environ["XLA_FLAGS"] = " ".join([current, *missing]).strip()
    if folder := os.environ.get(CACHE_VARIABLE):
        _use_cache(folder, jaxlib)


def simulate_side_by_side() -> bool:
    """Let threads of this process simulate at the same time; says whether they can.

    Where JAX queues its calls on the CPU, they wait for each other, on one core. Takes
    effect only before the backend starts, as it does in a command.
    """
    if not _backend_is_running():
        _set("jax_cpu_enable_async_dispatch", False)
        _side_by_side.append(True)
    return bool(_side_by_side)


_side_by_side: list[bool] = []


def _use_cache(folder: str, jaxlib: tuple[int, ...]) -> None:
    # Compiled code of another version or CPU has crashed when loaded: key the folder.
    import hashlib
    import platform

    cpu = platform.machine() + platform.processor()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            cpu += next((line for line in file if line.startswith("flags")), "")
    except OSError:
        pass
    key = hashlib.sha256(cpu.encode()).hexdigest()[:12]
    name = f"jax{version('jax')}-jaxlib{'.'.join(map(str, jaxlib))}-{key}"
    _set("jax_compilation_cache_dir", os.path.join(folder, name))
    _set("jax_persistent_cache_min_compile_time_secs", 0.2)
