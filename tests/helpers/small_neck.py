"""A short tube with a sac on a small neck, and the part of a device that lies over it."""

from dataclasses import replace

import numpy as np

import vstent
from vstent import phantoms
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.deployment.struts import is_over_restored
from vstent.devices.design import Design
from vstent.flow.case import FlowCase
from vstent.flow.problem import flow_case
from vstent.flow.settings import FlowSettings
from vstent.geometry.vessel import Vessel


def covered(design: Design, settings: FlowSettings) -> FlowCase:
    """Return the flow with a device over the neck."""
    tube = phantoms.with_sac(
        phantoms.tube(length_mm=24.0, radius_mm=1.4),
        abscissa_mm=12.0,
        width_mm=3.0,
        neck_mm=2.2,
        direction=np.array([1.0, 0.0, 0.0]),
    )
    whole = trace(Vessel(phantoms.phantom_surface(tube, edge_mm=0.2)))
    anatomy = restore(whole)
    stent = vstent.deploy(design, anatomy).stent
    case = flow_case(anatomy, (stent,), settings)
    media = tuple(sheet.part(is_over_restored(stent, anatomy, sheet.points_mm)) for sheet in case.media)
    return replace(case, vessel=trim(whole, upstream_mm=5.0, downstream_mm=3.0), media=media)
