"""Provenance: everything needed to repeat a run."""

import platform
from collections.abc import Iterable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from vstent.devices.catalogue import find_design
from vstent.flow.lattice.gpu import gpu_name
from vstent.study.folder import LAYOUT
from vstent.study.settings import Settings
from vstent.study.store import digest

PACKAGES: Final = ("vstent", "numpy", "scipy", "numba", "vtk", "SimpleITK", "pydicom")
"""Packages whose versions are recorded."""
METRICS: Final = "metrics.json"
"""File of the case folder with all metrics."""


def provenance(path: Path, source: str, settings: Settings) -> dict[str, Any]:
    """Return everything that a result depends on.

    Parameters
    ----------
    path : the input.
    source : its SHA-256.
    settings : settings of the study.

    Returns versions, machine, devices, input with its hash, and settings.
    """
    return {
        "layout": LAYOUT,
        "versions": versions(),
        "machine": machine(settings),
        "devices": devices_of(settings.devices),
        "input": {"name": "DICOM folder" if path.is_dir() else path.name, "sha256": source},
        "settings": asdict(settings),
        "research_use_only": True,
    }


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that compute."""
    return {name: version(name) for name in PACKAGES} | {"python": platform.python_version()}


def machine(settings: Settings) -> dict[str, str]:
    """Return the properties of the machine that can change the last digits of a result."""
    uses_gpu = settings.flow is not None and settings.flow.numerics.device_gpu
    return {"system": platform.system(), "processor": platform.machine()} | ({"gpu": gpu_name()} if uses_gpu else {})


def devices_of(names: Iterable[str]) -> dict[str, str]:
    """Return a digest of the catalogue data of every device, because a catalogue can change."""
    return {name: digest(find_design(name)) for name in names}
