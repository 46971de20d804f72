"""Deploy: an active contour grows to the wall, rows of a braid that cannot stretch follow it, wires are drawn on it."""

import time
from dataclasses import replace

import numpy as np

from vstent.deploy import braid, sizing, wires
from vstent.deploy.active_contour import ActiveContour, Progress
from vstent.deploy.wall import TreeWall
from vstent.device import Design, Size
from vstent.kernels.arrays import Floats
from vstent.stent import Deployment, Landing, Stent
from vstent.units import MM_PER_UM
from vstent.vessel import Anatomy

__all__ = ["APPOSED_GAP_MM", "ActiveContour", "deploy", "propose_landing", "propose_size"]

APPOSED_GAP_MM = 0.1
"""A node is apposed when the device's outer face is nearer to the wall than this."""
LOOSE_FRACTION = 0.05
"""Less of the device than this may stand off the wall without a word."""

propose_landing = sizing.propose_landing
propose_size = sizing.propose_size


def deploy(
    design: Design,
    anatomy: Anatomy,
    *,
    size: Size | None = None,
    landing: Landing | None = None,
    method: ActiveContour | None = None,
    progress: Progress | None = None,
) -> Deployment:
    """Deploy a device in the parent artery.

    Parameters
    ----------
    design : the device; see `vstent.device.catalogue`.
    anatomy : the artery, restored.
    size : the size; None proposes one.
    landing : where it is to lie; None centers it on the neck of the largest aneurysm.
    method : weights of the active contour (Zhong et al. 2016, eq. 1-7); its dd becomes the device's wire width.
    progress : called after every iteration with its number and the fraction of nodes terminated.

    Raises
    ------
    LandingError
        When the device does not fit the artery there.

    Notes
    -----
    Length and ends are predictions: rows are as far apart as the wires, which cannot stretch, put them. Where the
    artery is wider than the free device, the device stays at its free diameter and the gap is in ``wall_gap_mm``.
    """
    began = time.perf_counter()
    size = size or propose_size(design, anatomy)
    landing = landing or propose_landing(design, anatomy, size)
    method = replace(method or ActiveContour(), dd_mm=design.wall_offset_um * MM_PER_UM)
    wall = TreeWall(anatomy.landing_surface)
    settled = braid.settle(braid.Expansion(design, size, landing, anatomy, method, wall), progress)
    drawn = wires.draw(design, size, settled.nodes_mm, wall)
    stent = Stent(design, size, settled.nodes_mm, settled.abscissa_mm, drawn.points_mm, drawn.starts, drawn.diameter_um)
    _, distance_mm, face = anatomy.landing_surface.closest(settled.nodes_mm.reshape(-1, 3))
    gap_mm = np.maximum(distance_mm - method.dd_mm, 0.0).reshape(settled.nodes_mm.shape[:2])
    is_wall = ~anatomy.is_restored[anatomy.landing_surface.faces[face]].all(axis=1)
    return Deployment(
        stent=stent,
        outcome=settled.outcome,
        advice=_advice(stent, settled, gap_mm.ravel()[is_wall]),
        terminated_fraction=np.array(settled.terminated_fraction),
        seconds=time.perf_counter() - began,
        wall_gap_mm=gap_mm,
        history_mm=np.array(settled.history_mm),
    )


def _advice(stent: Stent, settled: braid.Settled, gap_mm: Floats) -> str:
    """One sentence: where the device lies, and what to do when it does not fit; gaps (n,) at the patient's own wall."""
    lies = (
        f"{stent.design.name} {stent.size.label} lies from {stent.proximal_abscissa_mm:.1f} to "
        f"{stent.distal_abscissa_mm:.1f} mm of the parent artery, {stent.deployed_length_mm:.1f} mm long"
    )
    if settled.outcome == "iteration_limit":
        done = settled.terminated_fraction[-1]
        return f"{lies}, but only {done:.0%} of its contour reached the wall: raise the iteration limit or tau."
    loose = float((gap_mm > APPOSED_GAP_MM).mean()) if gap_mm.size else 0.0
    if loose <= LOOSE_FRACTION:
        return f"{lies}, and {1 - loose:.0%} of it lies against the wall."
    wider = any(size.diameter_mm > stent.size.diameter_mm for size in stent.design.sizes)
    return (
        f"{lies}, and {loose:.0%} of it stands off the wall, by up to {gap_mm.max():.2f} mm: its free diameter is "
        f"{stent.size.free_diameter_mm:.2f} mm; choose {'a wider size' if wider else 'a device that is made wider'}."
    )
