"""Export of a System as an FMU 2.0 for co-simulation, as in Simulink or Modelica.

Standard: Functional Mock-up Interface 2.0.4, Modelica Association, 2022.
"""

import hashlib
import platform
import shutil
import subprocess
import tempfile
import zipfile
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import jax
import numpy as np

from ..core.about import About
from ..core.files import fresh_folder, write_bytes
from ..core.profile import COMPILING_C, stage
from ..core.system import System
from .c_project import CProject
from .fmu_template import FMU
from .slots import Interface, expressions

PLATFORMS = {"Linux": ("linux64", "so"), "Darwin": ("darwin64", "dylib")}
"""Folder and extension of a binary by operating system."""

FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared")

EPOCH = (2000, 1, 1, 0, 0, 0)
"""Timestamp of all files in the FMU, so that equal gains give equal bytes."""


class Variable(NamedTuple):
    """A real variable: its name, its expression in C, and its attributes in the FMU."""

    name: str
    place: str
    causality: str
    start: float | None
    meaning: str = ""


def write_fmu(
    system: System, interface: Interface, folder: Path, name: str, about: About
) -> list[Path]:
    """Write ``system`` to the new ``folder`` as an FMU 2.0; return its path.

    The FMU holds the C source and a binary for this platform. Its step is one sample; a
    communication step of several samples holds the inputs. Real parameters can be set.
    A signal of ``init`` that is not an input of ``step``, such as the voltage applied
    at the start, is a parameter as well.

    Raises ValueError if ``about`` has no sampling rate, without a C compiler ``cc``, on
    an unsupported platform, and in the cases of ``write_c``.
    """
    if about.rate_Hz is None:
        raise ValueError("an FMU needs the sampling rate, and the file names none")
    if platform.system() not in PLATFORMS:
        raise ValueError(f"there is no FMU for {platform.system()} yet")
    compiler = shutil.which("cc")
    if compiler is None:
        raise ValueError("an FMU has a binary: install a C compiler (cc)")
    code = CProject(system, interface, name, about)
    variables = _variables(code)
    sources = {f"{name}.h": code.header(), f"{name}.c": code.source()}
    guid = hashlib.sha256("".join(sources.values()).encode()).hexdigest()[:32]
    sources["fmu.c"] = _interface(code, variables, guid, about.rate_Hz)
    place, extension = PLATFORMS[platform.system()]
    with tempfile.TemporaryDirectory() as scratch:
        for file, text in sources.items():
            (Path(scratch) / file).write_text(text, encoding="utf-8")
        binary = f"{name}.{extension}"
        command = [compiler, *FLAGS, "-o", binary, "fmu.c", f"{name}.c", "-lm"]
        with stage(COMPILING_C):
            done = subprocess.run(command, cwd=scratch, capture_output=True, text=True)
        if done.returncode:
            raise ValueError(f"{compiler} fails: {done.stderr.strip()}")
        files = {
            "modelDescription.xml": _description(code, variables, guid, about.rate_Hz),
            f"binaries/{place}/{binary}": (Path(scratch) / binary).read_bytes(),
            **{f"sources/{file}": text for file, text in sources.items()},
        }
        packed = Path(scratch) / "packed"
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            for file, content in files.items():
                archive.writestr(zipfile.ZipInfo(file, EPOCH), content)
        path = fresh_folder(folder) / f"{name}.fmu"
        write_bytes(path, packed.read_bytes())
    return [path]


def _variables(code: CProject) -> list[Variable]:
    """Return parameters, inputs and outputs in the order of their value references."""
    found = []
    for slot, values in zip(code.parameters, code.values, strict=True):
        if not np.issubdtype(slot.dtype, np.floating):
            continue
        names = expressions([slot], "")
        places = expressions([slot], "this->parameters.")
        found += [
            Variable(each, place, "parameter", float(value), code.meaning(slot))
            for each, place, value in zip(names, places, values, strict=True)
        ]
    inputs = {slot.name for slot in code.inputs}
    starts = [float(x) for x in jax.tree.leaves(code.interface.start)]
    at = {slot.name: x for slot, x in zip(code.starts, starts, strict=True)}
    for slot in code.starts:
        if slot.name not in inputs:
            place = f"this->start_{slot.name}"
            meaning = "value before the first sample"
            found.append(
                Variable(
                    f"start_{slot.name}", place, "parameter", at[slot.name], meaning
                )
            )
    for slot in code.inputs:
        start = at.get(slot.name, 0.0)
        found.append(Variable(slot.name, f"this->{slot.name}", "input", start))
    for slot in code.outputs:
        found.append(Variable(slot.name, f"this->{slot.name}", "output", None))
    return found


def _interface(
    code: CProject, variables: list[Variable], guid: str, rate: float
) -> str:
    """Return the C source of the FMI functions."""
    inputs = [slot.name for slot in code.inputs]
    starts = [slot.name for slot in code.starts if slot.name not in inputs]
    outputs = [slot.name for slot in code.outputs]
    begin = "".join(
        f", this->{slot.name if slot.name in inputs else 'start_' + slot.name}"
        for slot in code.starts
    )
    given = ["&this->parameters", *(f"this->{name}" for name in inputs)]
    found = [f"this->{name}" for name in outputs]
    return FMU.format(
        name=code.name,
        guid=guid,
        dt=repr(1.0 / rate),
        fields="\n".join(
            f"    double {name};"
            for name in [*inputs, *(f"start_{n}" for n in starts), *outputs]
        ),
        output=code.output_variable,
        cases="\n".join(
            f"    case {number}: return &this->{variable.place.partition('->')[2]};"
            for number, variable in enumerate(variables)
        ),
        defaults="\n".join(
            f"    {variable.place} = {float(variable.start or 0.0)!r};"
            for variable in variables
            if "parameters." not in variable.place
        ),
        settable=sum(variable.causality != "output" for variable in variables),
        begin=begin,
        rest=code.step_block(["&state", *given], found),
        step=code.step_call(["&this->state", *given], found),
    )


def _description(
    code: CProject, variables: list[Variable], guid: str, rate: float
) -> str:
    """Return the text of modelDescription.xml."""
    root = ElementTree.Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=code.name,
        guid=guid,
        description=" ".join(code.head()),
        generationTool=f"piezojax {code.about.piezojax}",
        numberOfEventIndicators="0",
    )
    ElementTree.SubElement(
        root,
        "CoSimulation",
        modelIdentifier=code.name,
        canHandleVariableCommunicationStepSize="true",
        canNotUseMemoryManagementFunctions="false",
    )
    step = repr(1.0 / rate)
    ElementTree.SubElement(root, "DefaultExperiment", startTime="0.0", stepSize=step)
    table = ElementTree.SubElement(root, "ModelVariables")
    for number, variable in enumerate(variables):
        kinds = {"parameter": "tunable", "input": "discrete", "output": "discrete"}
        fixed = variable.name.startswith("start_") and variable.causality == "parameter"
        row: dict[str, Any] = {
            "name": variable.name,
            "valueReference": str(number),
            "causality": variable.causality,
            "variability": "fixed" if fixed else kinds[variable.causality],
        }
        if variable.meaning:
            row["description"] = variable.meaning
        element = ElementTree.SubElement(table, "ScalarVariable", row)
        start = {} if variable.start is None else {"start": repr(variable.start)}
        ElementTree.SubElement(element, "Real", start)
    structure = ElementTree.SubElement(root, "ModelStructure")
    for part in ("Outputs", "InitialUnknowns"):
        listed = ElementTree.SubElement(structure, part)
        for number, variable in enumerate(variables, 1):
            if variable.causality == "output":
                ElementTree.SubElement(listed, "Unknown", index=str(number))
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'
