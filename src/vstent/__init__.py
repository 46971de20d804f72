"""vstent: virtual stenting of intracranial aneurysms, from a scan to a deployed device and the blood flow.

The verbs are loaded when they are first used: importing vstent costs nothing. A stage's module and its verb share a
name: `vstent.trace` is the verb, also once the module is loaded, and `from vstent.trace import ...` reaches the module.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vstent.deploy import deploy as deploy
    from vstent.device import catalogue as catalogue
    from vstent.device import find_design as find_design
    from vstent.flow import simulate as simulate
    from vstent.io.images import read_image as read_image
    from vstent.io.surfaces import read_surface as read_surface
    from vstent.measure import measure as measure
    from vstent.measure import morphology as morphology
    from vstent.rank import rank as rank
    from vstent.repair import repair as repair
    from vstent.report import report as report
    from vstent.restore import restore as restore
    from vstent.segment import segment as segment
    from vstent.struts import struts as struts
    from vstent.study import run as run
    from vstent.trace import trace as trace
    from vstent.trim import trim as trim

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
    "rank": "vstent.rank",
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


class _Package(ModuleType):
    """A package that a submodule, when it is loaded, does not enter under the name of a verb."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOMES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
