"""Compiled C functions that XLA calls on a CPU."""

import ctypes
import functools
import hashlib
import platform
import shutil
import subprocess
import tempfile
import threading
from collections import defaultdict
from contextlib import suppress
from pathlib import Path
from string import Template
from typing import Any

import jax

from ..core.files import write_bytes
from ..core.profile import COMPILING_C, stage
from ..core.runtime import processor

WIDE = ("-mprefer-vector-width=512",)
"""Flag for processors with AVX-512, without effect on other x86 processors.

gcc writes functions with the attribute ``simd`` for the widest vectors alone. Loops
over narrower vectors, its choice for some processors, would call them for each lane:
the Jacobian of three Dahl frictions would take 3.5 times as long."""

FLAGS = (
    *("-std=gnu11", "-march=native", "-fPIC", "-shared", "-w", "-ftree-vectorize"),
    # The code needs neither errno nor floating-point traps.
    *("-fno-math-errno", "-fno-trapping-math"),
    # Without it gcc gives up SIMD in a loop that reads or writes more than 1000 arrays.
    "--param=loop-max-datarefs-for-datadeps=100000",
    *(WIDE if platform.machine() in ("x86_64", "AMD64") else ()),
)

QUICK = 2000
"""Number of lines from which a source is compiled with fewer optimisations.

This takes half the time, and such a loop is not slower. Without ``-fgcse``, which takes
a tenth of the time, it would be up to 2.5 times slower."""

CALL = Template("""
#include "xla/ffi/api/c_api.h"

static XLA_FFI_Buffer *buffer(void **all, int64_t place)
{
    return all[place];
}

static double *data(void **all, int64_t place)
{
    return buffer(all, place)->data;
}

XLA_FFI_Error *call(XLA_FFI_CallFrame *frame)
{
    __auto_type more = frame->extension_start;  /* its type depends on the version */
    if (more && more->type == XLA_FFI_Extension_Metadata) {
        XLA_FFI_Metadata *about = ((XLA_FFI_Metadata_Extension *)more)->metadata;
        about->api_version.major_version = XLA_FFI_API_MAJOR;
        about->api_version.minor_version = XLA_FFI_API_MINOR;
        return NULL;
    }
    void **in = frame->args.args, **out = frame->rets.rets;
    const int64_t *sizes = buffer(in, 3)->dims;
    const char *failure = run_blocks(
        sizes[0], sizes[1], sizes[2], buffer(in, 5)->dims[0],
        data(in, 0), data(in, 1), data(in, 2), data(in, 3), data(in, 4)$rows,
        data(out, 0), data(out, 1), data(out, 2), data(out, 3));
    if (!failure)
        return NULL;
    XLA_FFI_Error_Create_Args error = {
        .struct_size = XLA_FFI_Error_Create_Args_STRUCT_SIZE,
        .message = failure,
        .errc = XLA_FFI_Error_Code_RESOURCE_EXHAUSTED,
    };
    return frame->api->XLA_FFI_Error_Create(&error);
}
""")
"""Function that XLA calls, written for the C interface of XLA.

XLA first asks for the version of the interface, in an extension of the call."""

_locks: defaultdict[str, threading.Lock] = defaultdict(threading.Lock)
_libraries: dict[str, ctypes.CDLL] = {}

_DIGEST = hashlib.sha256().digest_size


class CompileError(RuntimeError):
    """A source could not be compiled or loaded."""


@functools.cache
def compiler() -> str | None:
    """Return the path of a C compiler, preferably gcc, or None if there is none."""
    return shutil.which("gcc") or shutil.which("cc")


def registered(text: str, rows: int) -> str:
    """Return the name under which XLA knows the function ``run_blocks`` of a source.

    ``rows`` is its number of arrays of inputs. The library is kept in the folder of
    compiled programs of JAX, if there is one. Raises CompileError if the source cannot
    be compiled or loaded.
    """
    text = _called(text, rows)
    # Machines of a cluster may share the folder: the name depends on the processor.
    key = "".join((text, *_flags(text), processor()))
    name = "piezojax_" + hashlib.sha256(key.encode()).hexdigest()[:24]
    with _locks[name]:
        if name not in _libraries:
            library = _kept(name) or _compiled(name, text)
            call = jax.ffi.pycapsule(library.call)
            jax.ffi.register_ffi_target(name, call, platform="cpu")
            _libraries[name] = library
    return name


def _flags(text: str) -> tuple[str, ...]:
    """Return the flags of the compiler for a source."""
    level = ("-O2",) if text.count("\n") < QUICK else ("-O1", "-fgcse")
    return *level, *FLAGS


def _called(text: str, rows: int) -> str:
    """Return a source with the function that XLA calls."""
    pointers = "".join(f", data(in, {5 + i})" for i in range(rows))
    return text + CALL.substitute(rows=pointers)


def _path(name: str) -> Path | None:
    config: Any = jax.config
    folder = config.jax_compilation_cache_dir
    return Path(folder) / f"{name}.so" if folder else None


def _kept(name: str) -> ctypes.CDLL | None:
    """Return the library of an earlier process, or None if missing or damaged."""
    path = _path(name)
    try:
        content = path.read_bytes() if path else b""
        # The digest follows the content, where loaders do not look.
        if hashlib.sha256(content[:-_DIGEST]).digest() != content[-_DIGEST:]:
            return None
        return ctypes.CDLL(str(path))
    except OSError:
        return None


@stage(COMPILING_C)
def _compiled(name: str, text: str) -> ctypes.CDLL:
    flags = *_flags(text), f"-I{jax.ffi.include_dir()}"
    command = [str(compiler()), *flags, "-o", "run.so", "run.c", "-lm"]
    with tempfile.TemporaryDirectory() as scratch:
        source, library = Path(scratch) / "run.c", Path(scratch) / "run.so"
        source.write_text(text, encoding="utf-8")
        try:
            subprocess.run(
                command, cwd=scratch, capture_output=True, text=True, check=True
            )
            loaded = ctypes.CDLL(str(library))
        except subprocess.CalledProcessError as error:
            lines = [x for x in error.stderr.splitlines() if "error" in x]
            reason = lines[0] if lines else f"status {error.returncode}"
            raise CompileError(f"{command[0]} fails: {reason}") from None
        except OSError as error:
            raise CompileError(f"the compiled loop cannot be used: {error}") from None
        _keep(name, library.read_bytes())
    return loaded


def _keep(name: str, content: bytes) -> None:
    path = _path(name)
    if path is not None:
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, content + hashlib.sha256(content).digest())
