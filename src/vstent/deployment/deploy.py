"""Deploy: an active contour grows to the wall, rows of a braid that cannot stretch follow it, wires are drawn on it."""

import time
from collections.abc import Sequence

import numpy as np

from vstent.deployment import sizing, wires
from vstent.deployment.advice import Gaps, advise
from vstent.deployment.braid import ConstantWire
from vstent.deployment.method import AbstractMethod, Course, Placement, Progress, laid_inside, run
from vstent.deployment.wall import landing_wall
from vstent.deployment.zhong2016 import Zhong2016
from vstent.devices.design import Design, Size
from vstent.devices.formulas import compacted
from vstent.devices.stent import Deployment, Landing, Stent
from vstent.errors import InputError
from vstent.geometry.vessel import Anatomy
from vstent.units import MM_PER_UM

METHODS: dict[str, type[ConstantWire] | type[Zhong2016]] = {"constant_wire": ConstantWire, "zhong2016": Zhong2016}
"""Ways to deploy, by name."""

APPOSED_GAP_MM = sizing.APPOSED_GAP_MM
propose_landing = sizing.propose_landing
propose_size = sizing.propose_size


def deploy(
    design: Design,
    anatomy: Anatomy,
    *,
    size: Size | None = None,
    landing: Landing | None = None,
    method: AbstractMethod | str = "constant_wire",
    compaction_fraction: float = 0.0,
    inside: Sequence[Stent] = (),
    progress: Progress | None = None,
) -> Deployment:
    """Deploy a device in the parent artery.

    Parameters
    ----------
    design : the device; see `vstent.devices.catalogue.catalogue`.
    anatomy : the artery, restored.
    size : the size; None proposes one.
    landing : where its center, proximal or distal end is to lie; None centers it on the neck of the largest aneurysm,
        or as near to it as the artery's ends let it lie.
    method : ``constant_wire``, ``zhong2016`` (the paper's contour and nothing else), or one with its own weights.
    compaction_fraction : part by which pushing shortens a braid against its natural length (pulling: below zero).
    inside : devices that lie in the artery already, in which this one opens where they overlap (telescoping).
    progress : called after every iteration with its number and the fraction of nodes terminated.

    Raises
    ------
    LandingError
        When the device does not fit the artery there.
    DeviceError
        When the device cannot be compacted so much.
    InputError
        When there is no such method, or its weights make the contour run away.

    Notes
    -----
    Length and ends are predictions: rows are as far apart as the wires, which cannot stretch, put them. Where the
    artery is wider than the free device, the device stays at its free diameter and the gap is in ``wall_gap_mm``.
    """
    began = time.perf_counter()
    chosen = _method(method).beside(design.wall_offset_um * MM_PER_UM)
    size = compacted(design, size or propose_size(design, anatomy), compaction_fraction)
    wall, is_patient = landing_wall(anatomy, inside, chosen.wall)

    def opened_at(there: Landing) -> Course:
        return run(chosen, Placement(design, size, there, anatomy, wall), progress)

    course = laid_inside(opened_at, propose_landing(design, anatomy, size)) if landing is None else opened_at(landing)
    nodes_mm = course.opened.contour.nodes_mm
    drawn = wires.draw(design, size, nodes_mm, wall)
    stent = Stent(design, size, nodes_mm, course.opened.abscissa_mm, drawn.points_mm, drawn.starts, drawn.diameter_um)
    contact = wall.contact(nodes_mm.reshape(-1, 3))
    gap_mm = np.maximum(contact.distance_mm - chosen.contour.dd_mm, 0.0).reshape(nodes_mm.shape[:2])
    is_at_patient = is_patient[contact.face].reshape(gap_mm.shape)
    return Deployment(
        stent=stent,
        outcome=course.outcome,
        advice=advise(anatomy, stent, course, Gaps(gap_mm, is_at_patient)),
        terminated_fraction=np.array(course.terminated_fraction),
        seconds=time.perf_counter() - began,
        wall_gap_mm=gap_mm,
        history_mm=np.array(course.history_mm),
        energy_mm2=np.array(course.energy_mm2),
    )


def _method(method: AbstractMethod | str) -> AbstractMethod:
    if isinstance(method, AbstractMethod):
        return method
    if method not in METHODS:
        raise InputError(f"There is no deployment method called {method!r}. Choose one of {', '.join(METHODS)}.")
    return METHODS[method]()
