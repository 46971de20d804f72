"""Virtual stenting of intracranial aneurysms, from a scan to a deployed device and the blood flow.

Each function is imported on first use, so that ``import vstent`` is fast.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vstent.anatomy.morphology import morphology as morphology
    from vstent.anatomy.repair import repair as repair
    from vstent.anatomy.restore.restore import restore as restore
    from vstent.anatomy.segment import segment as segment
    from vstent.anatomy.trace import trace as trace
    from vstent.anatomy.trim import trim as trim
    from vstent.angiography.angiogram import angiogram as angiogram
    from vstent.deployment.deploy import deploy as deploy
    from vstent.deployment.measure import measure as measure
    from vstent.deployment.struts import struts as struts
    from vstent.devices.catalogue import catalogue as catalogue
    from vstent.devices.catalogue import find_design as find_design
    from vstent.flow.simulation import simulate as simulate
    from vstent.io.images import read_image as read_image
    from vstent.io.surfaces import read_surface as read_surface
    from vstent.plan.rank import rank as rank
    from vstent.reporting.page import report as report
    from vstent.study.pipeline import run as run

_HOMES = {
    "read_image": "vstent.io.images",
    "read_surface": "vstent.io.surfaces",
    "segment": "vstent.anatomy.segment",
    "repair": "vstent.anatomy.repair",
    "trace": "vstent.anatomy.trace",
    "trim": "vstent.anatomy.trim",
    "restore": "vstent.anatomy.restore.restore",
    "morphology": "vstent.anatomy.morphology",
    "catalogue": "vstent.devices.catalogue",
    "find_design": "vstent.devices.catalogue",
    "deploy": "vstent.deployment.deploy",
    "struts": "vstent.deployment.struts",
    "measure": "vstent.deployment.measure",
    "simulate": "vstent.flow.simulation",
    "angiogram": "vstent.angiography.angiogram",
    "rank": "vstent.plan.rank",
    "run": "vstent.study.pipeline",
    "report": "vstent.reporting.page",
}
"""Module that defines each public function."""

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """Import a public function on first use."""
    if name not in _HOMES:
        raise AttributeError(f"module 'vstent' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
