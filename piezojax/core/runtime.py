"""Float64, XLA flags and compilation cache, set before JAX picks a backend."""

import os
import sys
import warnings
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

Version = tuple[int, ...]

_LATEST: Version = (0, 12, 1)
"""First version of jaxlib on which the flags have not been tried."""

# An unknown flag aborts the process, and releases remove flags without notice, even
# patch releases. Each is therefore set only for the versions of jaxlib that are known
# to accept it: from the first version given here up to the second, exclusive.
_CPU_FLAGS: dict[str, tuple[str, Version, Version]] = {
    # Without this option a scan with a carry above about 1 kB runs kernel by kernel,
    # which costs microseconds per step; with it the loop is one function. It is added
    # to extra options that the user gives.
    "xla_cpu_small_while_loop_byte_threshold": (
        "--xla_backend_extra_options="
        "xla_cpu_small_while_loop_byte_threshold=1000000000",
        (0, 9, 2),
        _LATEST,
    ),
    "xla_cpu_prefer_vector_width": (
        "--xla_cpu_prefer_vector_width=512",
        (0, 9, 2),
        _LATEST,
    ),
    "xla_cpu_copy_insertion_use_region_analysis": (
        "--xla_cpu_copy_insertion_use_region_analysis=true",
        (0, 9, 2),
        _LATEST,
    ),
    # The newer code generator takes up to twice the compile time; loops are not faster.
    "xla_cpu_use_fusion_emitters": (
        "--xla_cpu_use_fusion_emitters=false",
        (0, 10),
        (0, 11, 1),
    ),
}

CACHE_VARIABLE = "PIEZOJAX_COMPILATION_CACHE"
_JAX_CACHE_VARIABLE = "JAX_COMPILATION_CACHE_DIR"

MOST_KEPT = 1 << 30
"""Size of the folder of compiled programs, bytes, above which commands remove the
oldest ones."""


def _set(option: str, value: Any) -> None:
    # Importing JAX takes a second, and `--help` should not wait for it. JAX reads
    # options from the environment at its import.
    if jax := sys.modules.get("jax"):
        jax.config.update(option, value)
    else:
        os.environ[option.upper()] = str(value)


def _backend_is_running() -> bool:
    # Every public function of JAX that returns this starts the backend.
    if "jax" not in sys.modules:
        return False
    try:
        from jax._src import xla_bridge

        return bool(xla_bridge.backends_are_initialized())
    except (ImportError, AttributeError):
        return False


def _missing_flags(current: str, jaxlib: Version) -> list[str]:
    return [
        flag
        for name, (flag, since, before) in _CPU_FLAGS.items()
        if name not in current and since <= jaxlib < before
    ]


def configure() -> None:
    """Prepare JAX for closed-loop simulation; called once by ``import piezojax``.

    Switches JAX to float64, because float32 loses 14 nm in the slow filters of the
    controller. Appends the CPU flags above to the ``XLA_FLAGS`` of the user without
    replacing any. Stores compiled programs in the folder that the environment variable
    ``PIEZOJAX_COMPILATION_CACHE`` names, if any. Warns if a backend is already running,
    because XLA then ignores the flags and loops run 3 to 75 times slower.
    """
    _set("jax_enable_x64", True)
    jaxlib = _jaxlib()
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
    """Let threads simulate at the same time; return whether they can.

    By default JAX queues calls on the CPU, so that threads wait for each other on one
    core. The setting takes effect only before the backend starts, as in a command.
    """
    if not _backend_is_running():
        _set("jax_cpu_enable_async_dispatch", False)
        _side_by_side.append(True)
    return bool(_side_by_side)


_side_by_side: list[bool] = []


def keep_programs() -> None:
    """Keep compiled programs for the next command, in the user's folder of caches.

    ``CACHE_VARIABLE`` names another folder, or none if it is empty; a folder that JAX
    was given before stays. The oldest programs are removed above ``MOST_KEPT``. Nothing
    is kept if the folder cannot be written, and a damaged program is compiled again.
    """
    jax = sys.modules.get("jax")
    given = jax and jax.config.jax_compilation_cache_dir
    if given or CACHE_VARIABLE in os.environ or _JAX_CACHE_VARIABLE in os.environ:
        return
    from platformdirs import user_cache_path

    folder = user_cache_path("piezojax", appauthor=False) / "programs"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _remove_oldest(folder)
    except OSError:
        return
    if os.access(folder, os.W_OK):
        # JAX leaves out what it cannot read or write, with a warning.
        for text in ("reading", "writing"):
            warnings.filterwarnings(
                "ignore", f"Error {text} persistent compilation cache entry"
            )
        _use_cache(str(folder), _jaxlib())


def _remove_oldest(folder: Path) -> None:
    files = [(path, path.stat()) for path in folder.glob("*/*") if path.is_file()]
    size = 0
    for path, stat in sorted(files, key=lambda file: -file[1].st_mtime):
        size += stat.st_size
        if size > MOST_KEPT:
            path.unlink(missing_ok=True)


def _jaxlib() -> Version:
    parts = version("jaxlib").split(".")[:3]
    return tuple(int(part) for part in parts if part.isdigit())


@cache
def processor() -> str:
    """Return a name of the instructions of this processor, 12 characters."""
    import hashlib
    import platform

    cpu = platform.machine() + platform.processor()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            cpu += next((line for line in file if line.startswith("flags")), "")
    except OSError:
        pass
    return hashlib.sha256(cpu.encode()).hexdigest()[:12]


def _use_cache(folder: str, jaxlib: Version) -> None:
    # Code compiled by another version or for another CPU has crashed when loaded: the
    # name of the folder contains both.
    name = f"jax{version('jax')}-jaxlib{'.'.join(map(str, jaxlib))}-{processor()}"
    _set("jax_compilation_cache_dir", os.path.join(folder, name))
    _set("jax_persistent_cache_min_compile_time_secs", 0.2)
