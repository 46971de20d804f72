"""Coils in OpenFOAM: porous zones of similar resistance, cut from the mesh by nested surfaces around their region."""

from typing import Any, Final

import numpy as np
from scipy import ndimage

from vstent.flow.case import FlowCase, Sheet
from vstent.flow.openfoam.dictionary import foam_file
from vstent.flow.openfoam.setup import FoamSetup
from vstent.kernels.arrays import Floats
from vstent.kernels.voxels import isosurface
from vstent.units import M_PER_MM

BANDS: Final = 6
"""Number of zones, each of which has about the same number of samples of the region."""
DARCY, FORCHHEIMER = "d", "f"
"""Entries of the resistance in OpenFOAM, in 1/m2 and 1/m: mu d u + rho f |u| u / 2 per length."""


def regions(case: FlowCase) -> list[Sheet]:
    """Return the media of a case that are regions."""
    return [one for one in case.media if len(one.normals) and not one.normals.any()]


def porous_files(case: FlowCase, setup: FoamSetup) -> tuple[dict[str, str], dict[str, dict[str, Floats]]]:
    """Return the files that make zones of regions and let them resist, by path, and the surfaces that cut the zones."""
    surfaces: dict[str, dict[str, Floats]] = {}
    actions: list[dict[str, Any]] = []
    models: dict[str, Any] = {}
    for region in regions(case):
        for number, (corners_mm, darcy, forchheimer) in enumerate(_bands(case, region), start=1):
            name = f"coils_{number}"
            surfaces[name] = {name: corners_mm}
            inside: dict[str, Any] = {
                "file": f'"{setup.dialect.surfaces}/{name}.stl"',
                "outsidePoints": [tuple((case.vessel.inlet.center_mm * M_PER_MM).tolist())],
            }
            inside |= {"useSurfaceOrientation": True, "includeCut": False, "includeInside": True}
            inside |= {"includeOutside": False, "nearDistance": -1, "curvature": -100}
            cells = {"name": name, "type": "cellSet"}
            actions.append(cells | {"action": "new", "source": "surfaceToCell", "sourceInfo": inside})
            if number > 1:  # the surface of the band before has this one within it
                before = cells | {"name": f"coils_{number - 1}", "action": setup.dialect.taken_off}
                actions.append(before | {"source": "cellToCell", "sourceInfo": {"set": name}})
            axes = {"type": "axesRotation", "e1": (1, 0, 0), "e2": (0, 1, 0)}
            resists = {DARCY: (darcy,) * 3, FORCHHEIMER: (forchheimer,) * 3}
            system = {"type": "cartesian", "origin": (0, 0, 0), "coordinateRotation": axes}
            where = {"selectionMode": "cellZone", "cellZone": name, "type": "DarcyForchheimer"}
            kind = setup.dialect.porosity
            models[name] = {"type": kind, f"{kind}Coeffs": where | resists | {"coordinateSystem": system}}
    for name in surfaces:
        zone = {"name": name, "type": "cellZoneSet", "action": "new", "source": "setToCellZone"}
        actions.append(zone | {"sourceInfo": {"set": name}})
    if not surfaces:
        return {}, {}
    note = "Resistance of coils by bands of their local density; d in 1/m2, f in 1/m."
    files = {
        "system/topoSetDict": foam_file("topoSetDict", {"actions": actions}),
        f"constant/{setup.dialect.models}": foam_file(setup.dialect.models, models, note=note),
    }
    return files, surfaces


def _bands(case: FlowCase, region: Sheet) -> list[tuple[Floats, float, float]]:
    """Return bands of a region from the least resistance on, with the means of d (1/m2) and f (1/m) in them.

    Corners (f, 3, 3), in mm, are those of the surface around a band and all later ones.
    """
    spacing_mm = float(np.cbrt(region.area_mm2[0]))  # of the volumes that samples of a region stand for
    low_mm = region.points_mm.min(axis=0) - 3 * spacing_mm
    at = np.rint((region.points_mm - low_mm) / spacing_mm).astype(int)
    field: Floats = np.zeros(at.max(axis=0) + 4)
    darcy = region.normal_resistance_Pa_s_m / (case.blood.viscosity_Pa_s * M_PER_MM)
    field[tuple(at.T)] = np.log(darcy)
    edge = field == 0.0
    field[edge] = ndimage.grey_dilation(field, size=(3, 3, 3))[edge]  # cells at the wall are in the region too
    edges = np.quantile(np.log(darcy), np.linspace(0, 1, BANDS + 1))
    number = np.clip(np.searchsorted(edges, np.log(darcy), side="right") - 1, 0, BANDS - 1)
    found = []
    for band in range(BANDS):
        index, faces = isosurface(field.astype(np.float32), float(edges[band] if band else 0.5 * edges[0]))
        here = number == band
        forchheimer = 0.5 * region.inertial_loss[here].mean() / M_PER_MM
        found.append(((low_mm + index * spacing_mm)[faces], float(darcy[here].mean()), float(forchheimer)))
    return found
