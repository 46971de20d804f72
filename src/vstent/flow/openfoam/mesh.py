"""OpenFOAM dictionaries of the mesh: a block of cubes, cut to the vessel by snappyHexMesh."""

from collections.abc import Mapping, Sequence
from math import ceil, log2
from typing import Any

import numpy as np

from vstent.flow.case import FlowCase
from vstent.flow.openfoam.dictionary import foam_file
from vstent.flow.openfoam.setup import BASE_LEVEL, FoamSetup
from vstent.kernels.arrays import Floats
from vstent.units import M_PER_MM

LUMEN, ENDS, NECK, STRUTS = "lumen", "ends", "neck", "struts"
"""Names of the surfaces: the whole boundary with named regions, its flat ends, the ostium, the device."""
NECK_REACH = 2.0
"""Distance from the neck, in grid spacings, within which cells are halved."""
CELLS_ACROSS_END = 8
"""Minimum number of cells across an opening; with fewer, snappyHexMesh may close it."""
SNAPPING = {
    "nSmoothPatch": 3,
    "tolerance": 2.0,
    "nSolveIter": 50,
    "nRelaxIter": 5,
    "nFeatureSnapIter": 10,
    "implicitFeatureSnap": False,
    "explicitFeatureSnap": True,
    "multiRegionFeatureSnap": False,
}
"""Settings that move the cells to the surface."""
LAYERS = {
    "expansionRatio": 1.2,
    "finalLayerThickness": 0.4,
    "minThickness": 0.1,
    "nGrow": 0,
    "featureAngle": 130,
    "slipFeatureAngle": 30,
    "nRelaxIter": 5,
    "nSmoothSurfaceNormals": 3,
    "nSmoothNormals": 3,
    "nSmoothThickness": 10,
    "maxFaceThicknessRatio": 0.5,
    "maxThicknessToMedialRatio": 0.3,
    "minMedianAxisAngle": 90,
    "minMedialAxisAngle": 90,
    "nBufferCellsNoExtrude": 0,
    "nLayerIter": 30,
}
"""Settings of the flat layers along the wall."""
QUALITY = {
    "maxNonOrtho": 60,
    "maxBoundarySkewness": 20,
    "maxInternalSkewness": 4,
    "maxConcave": 80,
    "minVol": 1e-20,
    "minTetQuality": 1e-20,
    "minArea": -1,
    "minTwist": 0.02,
    "minDeterminant": 0.001,
    "minFaceWeight": 0.05,
    "minVolRatio": 0.01,
    "minTriangleTwist": -1,
    "nSmoothScale": 4,
    "errorReduction": 0.75,
    "relaxed": {"maxNonOrtho": 70},
}
"""Quality limits; volumes and areas, in m3 and m2, suit cells of a few hundredths of a millimetre."""


def block_mesh(vertices_mm: Floats, cell_size_mm: float) -> str:
    """Return blockMeshDict: cubes `2**BASE_LEVEL` times the grid spacing, with a margin around the vertices (n, 3)."""
    size_mm = cell_size_mm * 2**BASE_LEVEL
    low = vertices_mm.min(axis=0) - size_mm * np.array([1.1327, 1.2171, 1.1733])
    count = np.ceil((vertices_mm.max(axis=0) - low) / size_mm + 1).astype(int)
    a, b = low * M_PER_MM, (low + count * size_mm) * M_PER_MM
    corners = [(a[0], a[1]), (b[0], a[1]), (b[0], b[1]), (a[0], b[1])]
    sides = ["(0 4 7 3)", "(1 2 6 5)", "(0 1 5 4)", "(3 7 6 2)", "(0 3 2 1)", "(4 5 6 7)"]
    entries = {
        "convertToMeters": 1,
        "vertices": [(float(x), float(y), float(z)) for z in (a[2], b[2]) for x, y in corners],
        "blocks": ["hex", tuple(range(8)), tuple(int(n) for n in count), "simpleGrading", (1, 1, 1)],
        "edges": [],
        "boundary": ["background", {"type": "patch", "faces": sides}],
        "mergePatchPairs": [],
    }
    return foam_file("blockMeshDict", entries, note="Lengths in m; snappyHexMesh cuts the vessel out of this block.")


def snappy(case: FlowCase, setup: FoamSetup, patches: Mapping[str, str], sections: Sequence[Floats]) -> str:
    """Return snappyHexMeshDict, from the kind of every patch and the polygon (k, 3) in mm of every opening."""
    narrow = _narrow_ends(case, setup, sections)
    has_neck, size_mm = case.ostium is not None, setup.cell_size_mm
    files = {LUMEN: {"regions": {name: {"name": name} for name in patches}}}
    levels = dict.fromkeys(patches, BASE_LEVEL) | {name: level for name, (level, _) in narrow.items()}
    regions = {name: {"level": (levels[name],) * 2, "patchInfo": {"type": kind}} for name, kind in patches.items()}
    surfaces: dict[str, Any] = {LUMEN: {"level": (BASE_LEVEL, BASE_LEVEL), "regions": regions}}
    inside = {LUMEN: setup.dialect.refined_inside(BASE_LEVEL)}
    inside |= {f"before_{name}": setup.dialect.refined_inside(level) for name, (level, _) in narrow.items()}
    if has_neck:
        files[NECK] = {}
        inside[NECK] = {"mode": "distance", "levels": [(NECK_REACH * size_mm * M_PER_MM, BASE_LEVEL + 1)]}
    if setup.struts is not None:
        files[STRUTS] = {"regions": {STRUTS: {"name": STRUTS}}}
        surfaces[STRUTS] = {"level": (BASE_LEVEL + setup.levels_at_struts,) * 2, "patchInfo": {"type": "wall"}}
    geometry = {name: {"type": "triSurfaceMesh", "file": f'"{name}.stl"', **more} for name, more in files.items()}
    cylinders = {f"before_{name}": cylinder for name, (_, cylinder) in narrow.items()}
    inlet = case.vessel.inlet
    # A point in the inlet's straight extension that is not on a plane of the background grid.
    point_mm = sections[0].mean(axis=0) - inlet.normal * 0.1137 * inlet.diameter_mm
    entries = {
        "castellatedMesh": True,
        "snap": True,
        "addLayers": setup.layers > 0,
        "geometry": {LUMEN: geometry.pop(LUMEN)} | cylinders | geometry,
        "castellatedMeshControls": {
            "maxLocalCells": 20_000_000,
            "maxGlobalCells": 50_000_000,
            "minRefinementCells": 10,
            "maxLoadUnbalance": 0.1,
            "nCellsBetweenLevels": 2,
            "features": [{"file": f'"{ENDS}.eMesh"', "level": BASE_LEVEL}],
            "refinementSurfaces": surfaces,
            "resolveFeatureAngle": 30,
            "refinementRegions": inside,
            setup.dialect.inside_point: _metres(point_mm),
            "allowFreeStandingZoneFaces": True,
        },
        "snapControls": SNAPPING,
        "addLayersControls": {
            "relativeSizes": True,
            "layers": {name: {"nSurfaceLayers": setup.layers} for name, kind in patches.items() if kind == "wall"},
            **LAYERS,
        },
        "meshQualityControls": QUALITY,
        "writeFlags": [],
        "mergeTolerance": 1e-6,
    }
    return foam_file("snappyHexMeshDict", entries)


def _narrow_ends(case: FlowCase, setup: FoamSetup, sections: Sequence[Floats]) -> dict[str, tuple[int, dict[str, Any]]]:
    """Return level of refinement, and a cylinder one diameter long, at openings with less than `CELLS_ACROSS_END`."""
    narrow = {}
    for opening, section_mm in zip(case.vessel.openings, sections, strict=True):
        halvings = max(0, ceil(log2(CELLS_ACROSS_END * setup.cell_size_mm / opening.diameter_mm)))
        if not halvings:
            continue
        end_mm = section_mm.mean(axis=0)
        along = (end_mm - opening.center_mm) / np.linalg.norm(end_mm - opening.center_mm)
        cylinder = {
            "type": "searchableCylinder",
            "point1": _metres(opening.center_mm - opening.diameter_mm * along),
            "point2": _metres(end_mm),
            "radius": 0.75 * opening.diameter_mm * M_PER_MM,
        }
        narrow[opening.role] = BASE_LEVEL + halvings, cylinder
    return narrow


def _metres(point_mm: Floats) -> tuple[float, ...]:
    """Return a point (3,) in m."""
    return tuple(float(x) for x in point_mm * M_PER_MM)
