"""Provenance: everything that it takes to repeat a run."""

import platform
from collections.abc import Iterable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from vstent.devices.catalogue import find_design
from vstent.flow.lattice.gpu import gpu_name
from vstent.study.ledger import key_of
from vstent.study.types import Settings

PACKAGES: Final = ("vstent", "numpy", "scipy", "numba", "vtk", "SimpleITK", "pydicom")
INPUT: Final = "input.json"
"""File in the case folder that says where the input lies: not for handing on, for its path may name the patient."""
METRICS: Final = "metrics.json"
RUN: Final = "run.json"


def provenance(path: Path, source: str, settings: Settings) -> dict[str, Any]:
    """Return versions, machine, devices, input with its hash `source`, and settings: all that a result depends on."""
    return {
        "versions": versions(),
        "machine": machine(settings),
        "devices": devices_of(settings.devices),
        "input": {"name": "DICOM folder" if path.is_dir() else path.name, "sha256": source},
        "settings": asdict(settings),
        "research_use_only": True,
    }


def versions() -> dict[str, str]:
    """Return the versions of everything that computes."""
    return {name: version(name) for name in PACKAGES} | {"python": platform.python_version()}


def machine(settings: Settings) -> dict[str, str]:
    """Return what of the machine can change the last bits of a number."""
    uses_gpu = settings.flow is not None and settings.flow.device_gpu
    return {"system": platform.system(), "processor": platform.machine()} | ({"gpu": gpu_name()} if uses_gpu else {})


def devices_of(names: Iterable[str]) -> dict[str, str]:
    """Return a fingerprint of every device's numbers: a catalogue can change."""
    return {name: key_of(find_design(name)) for name in names}
