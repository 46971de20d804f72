"""Virtual stenting of intracranial aneurysms, from a scan to a deployed device and the blood flow.

Each public name is imported on first use, so that ``import vstent`` is fast.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vstent.anatomy.morphology import morphology as morphology
    from vstent.anatomy.read import read_vessel as read_vessel
    from vstent.anatomy.restore.paths import on_path as on_path
    from vstent.anatomy.restore.restore import restore as restore
    from vstent.anatomy.segment import segment as segment
    from vstent.anatomy.trace import trace as trace
    from vstent.anatomy.trim import trim as trim
    from vstent.angiography.angiogram import AngiogramSettings as AngiogramSettings, angiogram as angiogram
    from vstent.deployment.deploy import deploy as deploy
    from vstent.deployment.measure import measure as measure
    from vstent.deployment.straightening import straighten as straighten
    from vstent.deployment.struts import struts as struts
    from vstent.devices.catalogue import catalogue as catalogue, find_design as find_design, find_size as find_size
    from vstent.devices.stent import Landing as Landing
    from vstent.devices.treatment import (
        Implant as Implant,
        Placing as Placing,
        Treatment as Treatment,
        read_treatment as read_treatment,
    )
    from vstent.flow.indices import compare as compare, indices as indices
    from vstent.flow.ostium import ostium as ostium
    from vstent.flow.settings import FlowSettings as FlowSettings, Numerics as Numerics
    from vstent.flow.simulation import simulate as simulate
    from vstent.geometry.image import Image as Image
    from vstent.io.images import read_image as read_image
    from vstent.plan.rank import rank as rank
    from vstent.reporting.page import report as report
    from vstent.study.pipeline import run as run
    from vstent.study.settings import (
        AnatomySettings as AnatomySettings,
        InputSettings as InputSettings,
        Settings as Settings,
    )

_NAMES = {
    "anatomy.read": "read_vessel",
    "io.images": "read_image",
    "anatomy.segment": "segment",
    "anatomy.trace": "trace",
    "anatomy.trim": "trim",
    "anatomy.restore.restore": "restore",
    "anatomy.restore.paths": "on_path",
    "anatomy.morphology": "morphology",
    "devices.catalogue": "catalogue find_design find_size",
    "deployment.deploy": "deploy",
    "deployment.straightening": "straighten",
    "deployment.struts": "struts",
    "deployment.measure": "measure",
    "flow.simulation": "simulate",
    "flow.indices": "compare indices",
    "flow.ostium": "ostium",
    "angiography.angiogram": "angiogram AngiogramSettings",
    "plan.rank": "rank",
    "devices.treatment": "read_treatment Treatment Implant Placing",
    "study.pipeline": "run",
    "reporting.page": "report",
    "geometry.image": "Image",
    "devices.stent": "Landing",
    "flow.settings": "FlowSettings Numerics",
    "study.settings": "InputSettings AnatomySettings Settings",
}
"""Public functions and data classes by the module that defines them."""
_HOMES = {name: f"vstent.{module}" for module, names in _NAMES.items() for name in names.split()}
"""Module that defines each of them."""

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """Import a public function or data class on first use."""
    if name not in _HOMES:
        raise AttributeError(f"module 'vstent' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    """Return the names of the module, those included that are imported on first use."""
    return sorted({*globals(), *__all__})
