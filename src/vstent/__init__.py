"""vstent: virtual stenting of intracranial aneurysms, from a scan to a deployed device and the blood flow.

The verbs are loaded when they are first used: importing vstent costs nothing.
"""

from importlib import import_module
from typing import Any

_HOMES = {
    "read_image": "vstent.io.images",
    "read_surface": "vstent.io.surfaces",
    "segment": "vstent.segment",
    "repair": "vstent.repair",
    "trace": "vstent.trace",
    "trim": "vstent.trim",
    "restore": "vstent.restore",
    "deploy": "vstent.deploy",
    "struts": "vstent.struts",
    "simulate": "vstent.flow",
    "measure": "vstent.measure",
    "morphology": "vstent.measure",
    "catalogue": "vstent.device",
    "find_design": "vstent.device",
    "run": "vstent.study",
    "report": "vstent.report",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'vstent' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
