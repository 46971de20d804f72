"""Deploy a device: an active contour grows to the wall, rows follow the constant wire length, and wires are drawn."""

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vstent.deployment import forks, wires
from vstent.deployment.advice import advise
from vstent.deployment.basket import deploy_basket
from vstent.deployment.braid import ConstantWire
from vstent.deployment.coils import deploy_coils
from vstent.deployment.method import AbstractMethod, Course, Placement, Progress, Zhong2016, laid_inside, run
from vstent.deployment.nested import kept_inside
from vstent.deployment.sizing import propose_landing as propose_landing, propose_size as propose_size
from vstent.devices.catalogue import find_design
from vstent.devices.design import Basket, Coil, Design, Size
from vstent.devices.formulas import compacted
from vstent.devices.stent import Coils, Deployment, Landing, Stent
from vstent.errors import InputError, LandingError
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Floats
from vstent.units import MM_PER_UM

METHODS: dict[str, type[ConstantWire] | type[Zhong2016]] = {"constant_wire": ConstantWire, "zhong2016": Zhong2016}
"""Deployment methods by name."""


def deploy(  # noqa: PLR0913 one keyword for each thing that can be chosen
    design: Design | str,
    anatomy: Anatomy,
    *,
    size: Size | None = None,
    landing: Landing | None = None,
    method: AbstractMethod | str = "constant_wire",
    compaction_fraction: float = 0.0,
    inside: Sequence[Stent] = (),
    beside: Sequence[str] = (),
    progress: Progress | None = None,
) -> Deployment:
    """Deploy a device on the first path of an artery, the parent artery, or a basket in the largest sac.

    Parameters
    ----------
    design : Design or str
        The device, or its key or name in the catalogue.
    anatomy : Anatomy
        The restored artery.
    size : Size, optional
        Size of the device; None proposes one.
    landing : Landing, optional
        Where the center, the proximal or the distal end lies. None centers the device on the neck of the largest
        aneurysm, or as near to it as the ends of the artery allow. A basket is landed with its proximal end, at a
        height above the middle of the neck; None is 0.
    method : AbstractMethod or str, optional
        ``constant_wire``, ``zhong2016`` (the contour of the paper alone), or a method with other weights.
    compaction_fraction : float, optional
        Fraction by which pushing shortens a braid relative to its natural length; negative when pulled.
    inside : sequence of Stent, optional
        Devices that are already in the artery. Where they overlap, this device opens inside them (telescoping), and it
        passes through a cell of those that lie on another path (a Y at a fork).
    beside : sequence of str, optional
        Names of the paths of devices side by side with this one; each gets its share of the artery (kissing).
    progress : callable, optional
        Called after every iteration with its number and the fraction of nodes terminated.

    Returns
    -------
    Deployment
        The deployed device, its gaps to the wall and the record of the iterations.

    Raises
    ------
    LandingError
        The device does not fit the artery at this place.
    DeviceError
        There is no such device, or it cannot be compacted by this fraction.
    InputError
        There is no such method, or the contour diverges because its weights are too large.

    Notes
    -----
    Length and ends are predictions: the wires cannot stretch, and they set the distance between rows. Where the artery
    is wider than the free device, the device keeps its free diameter, and ``wall_gap_mm`` holds the gap.
    """
    began = time.perf_counter()
    design = find_design(design) if isinstance(design, str) else design
    if isinstance(design, Coil):
        return deploy_coils(design, anatomy, inside=inside)
    if any(isinstance(one, Coils) for one in inside):
        raise LandingError(f"Coils come last in a treatment: give {design.name} before them.")
    baskets = [one for one in (design, *(stent.design for stent in inside)) if isinstance(one, Basket)]
    if inside and baskets:
        raise LandingError(f"{baskets[0].name} lies in a sac alone: give it a treatment of its own.")
    if isinstance(design, Basket):
        return deploy_basket(design, anatomy, size, landing or Landing(0.0, "proximal"))
    if isinstance(method, str):
        if method not in METHODS:
            raise InputError(f"There is no deployment method called {method!r}. Choose one of {', '.join(METHODS)}.")
        method = METHODS[method]()
    dd_mm = design.wall_offset_um * MM_PER_UM
    chosen = replace(method, contour=replace(method.contour, dd_mm=dd_mm))
    size = compacted(design, size or propose_size(design, anatomy), compaction_fraction)
    start_mm = landing.abscissa_mm if landing and landing.anchor == "proximal" else -np.inf
    along = forks.way(anatomy, inside, beside, start_mm)
    wall = along.wall

    def opened_at(there: Landing) -> Course:
        there = replace(there, abscissa_mm=along.from_plain_mm(there.abscissa_mm))
        return run(chosen, Placement(design, size, there, along.anatomy, wall), progress)

    course = laid_inside(opened_at, propose_landing(design, anatomy, size)) if landing is None else opened_at(landing)
    nodes_mm, crowns = course.opened.contour.nodes_mm, course.opened.crowns
    rows_mm = along.to_plain_mm(course.opened.abscissa_mm)

    def drawn(nodes_mm: Floats) -> Stent:
        found = wires.draw(design, size, nodes_mm, wall, crowns)
        return Stent(design, size, nodes_mm, rows_mm, *found, crowns.shift_mm, anatomy.parent.name)

    nested = course.opened.abscissa_mm < along.nested_to_mm
    stent = kept_inside(drawn(nodes_mm), drawn, inside, anatomy.parent.landing_surface, nested)
    contact = wall.contact(stent.nodes_mm.reshape(-1, 3))
    gap_mm = np.maximum(contact.distance_mm - dd_mm, 0.0).reshape(nodes_mm.shape[:2])
    return Deployment(
        stent=stent,
        outcome=course.outcome,
        advice=advise(anatomy, stent, course, gap_mm, along.is_patient[contact.face].reshape(gap_mm.shape)),
        terminated_fraction=np.array(course.terminated_fraction),
        seconds=time.perf_counter() - began,
        wall_gap_mm=gap_mm,
        history_mm=np.array(course.history_mm),
        energy_mm2=np.array(course.energy_mm2),
    )
