"""OpenFOAM dictionaries of the mesh: a block of cubes, cut to the vessel by snappyHexMesh."""

from dataclasses import dataclass
from math import ceil, log2
from typing import Any

import numpy as np

from vstent.flow.openfoam.dictionary import foam_file
from vstent.flow.openfoam.setup import BASE_LEVEL, FEATURES, FoamSetup
from vstent.kernels.arrays import Floats
from vstent.units import M_PER_MM

LUMEN, ENDS, NECK, STRUTS = "lumen", "ends", "neck", "struts"
"""Names of the surfaces: the whole boundary with named regions, its flat ends, the ostium, the device."""
NECK_REACH = 2.0
"""Distance from the neck, in grid spacings, within which cells are refined."""


CELLS_ACROSS_END = 8
"""Minimum number of cells across an opening; with fewer, snappyHexMesh may close it."""


@dataclass(frozen=True, eq=False)
class End:
    """An opening and the straight piece of vessel before it."""

    begin_mm: Floats
    """(3,) point on its axis, inside the vessel."""
    end_mm: Floats
    """(3,) centre of the opening."""
    diameter_mm: float
    """Diameter of the opening."""

    def levels(self, cell_size_mm: float) -> int:
        """Return how many times the cells there must be halved."""
        return max(0, ceil(log2(CELLS_ACROSS_END * cell_size_mm / self.diameter_mm)))


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


def feature_extract(setup: FoamSetup) -> tuple[str, str]:
    """Return name and text of the dictionary that extracts the rims of the flat ends."""
    rims = {"includedAngle": 150, "geometricTestOnly": True}
    subset = {"subsetFeatures": {"nonManifoldEdges": False, "openEdges": True}}
    if setup.flavour == "org":
        entries: dict[str, Any] = {"surfaces": [f'"{ENDS}.stl"']} | rims | subset
    else:
        entries = {f"{ENDS}.stl": {"extractionMethod": "extractFromSurface"} | rims | subset | {"writeObj": False}}
    name = f"{FEATURES[setup.flavour]}Dict"
    return name, foam_file(name, entries)


def snappy(
    setup: FoamSetup, patches: dict[str, str], ends: dict[str, End], inside_mm: Floats, *, has_neck: bool
) -> str:
    """Return snappyHexMeshDict.

    Shapes: `inside_mm` (3,).
    """
    walls = [name for name, kind in patches.items() if kind == "wall"]
    narrow = {name: end for name, end in ends.items() if end.levels(setup.cell_size_mm)}
    entries = {
        "castellatedMesh": True,
        "snap": True,
        "addLayers": setup.layers > 0,
        "geometry": _geometry(setup, patches, narrow, has_neck),
        "castellatedMeshControls": _castellated(setup, patches, narrow, inside_mm, has_neck),
        "snapControls": _snap(),
        "addLayersControls": _layers(setup, walls),
        "meshQualityControls": _quality(),
        "writeFlags": [],
        "mergeTolerance": 1e-6,
    }
    return foam_file("snappyHexMeshDict", entries)


def _geometry(setup: FoamSetup, patches: dict[str, str], narrow: dict[str, End], has_neck: bool) -> dict[str, Any]:
    """Return the surfaces and cylinders that snappyHexMesh uses."""

    def surface(name: str) -> dict[str, Any]:
        return {"type": "triSurfaceMesh", "file": f'"{name}.stl"'}

    regions = {name: {"name": name} for name in patches}
    result: dict[str, Any] = {LUMEN: surface(LUMEN) | {"regions": regions}}
    result |= {_before(name): _cylinder(end) for name, end in narrow.items()}
    if has_neck:
        result[NECK] = surface(NECK)
    if setup.struts is not None:
        result[STRUTS] = surface(STRUTS) | {"regions": {STRUTS: {"name": STRUTS}}}
    return result


def _before(name: str) -> str:
    """Return the name of the refinement region at an opening."""
    return f"before_{name}"


def _cylinder(end: End) -> dict[str, Any]:
    """Return a cylinder around an opening and the piece of vessel before it."""
    first, second = (tuple(float(x) for x in point * M_PER_MM) for point in (end.begin_mm, end.end_mm))
    return {
        "type": "searchableCylinder",
        "point1": first,
        "point2": second,
        "radius": 0.75 * end.diameter_mm * M_PER_MM,
    }


def _castellated(
    setup: FoamSetup, patches: dict[str, str], narrow: dict[str, End], inside_mm: Floats, has_neck: bool
) -> dict[str, Any]:
    """Return the refinement settings."""
    finer = {name: BASE_LEVEL + end.levels(setup.cell_size_mm) for name, end in narrow.items()}
    level = (BASE_LEVEL, BASE_LEVEL)
    regions = {
        name: {"level": (finer.get(name, BASE_LEVEL),) * 2, "patchInfo": {"type": kind}}
        for name, kind in patches.items()
    }
    surfaces: dict[str, Any] = {LUMEN: {"level": level, "regions": regions}}
    inside = {LUMEN: _inside(setup, BASE_LEVEL)} | {_before(name): _inside(setup, n) for name, n in finer.items()}
    if has_neck and setup.neck_levels:
        reach_m = NECK_REACH * setup.cell_size_mm * M_PER_MM
        inside[NECK] = {"mode": "distance", "levels": [(reach_m, BASE_LEVEL + setup.neck_levels)]}
    if setup.struts is not None:
        finest = BASE_LEVEL + setup.levels_at_struts
        surfaces[STRUTS] = {"level": (finest, finest), "patchInfo": {"type": "wall"}}
    point = tuple(float(x) for x in inside_mm * M_PER_MM)
    return {
        "maxLocalCells": 20_000_000,
        "maxGlobalCells": 50_000_000,
        "minRefinementCells": 10,
        "maxLoadUnbalance": 0.1,
        "nCellsBetweenLevels": 2,
        "features": [{"file": f'"{ENDS}.eMesh"', "level": BASE_LEVEL}],
        "refinementSurfaces": surfaces,
        "resolveFeatureAngle": 30,
        "refinementRegions": inside,
        "insidePoint" if setup.flavour == "org" else "locationInMesh": point,
        "allowFreeStandingZoneFaces": True,
    }


def _inside(setup: FoamSetup, level: int) -> dict[str, Any]:
    """Return a refinement level for the inside of a surface."""
    return {"mode": "inside"} | ({"level": level} if setup.flavour == "org" else {"levels": [(1e15, level)]})


def _snap() -> dict[str, Any]:
    """Return the snapping settings."""
    return {
        "nSmoothPatch": 3,
        "tolerance": 2.0,
        "nSolveIter": 50,
        "nRelaxIter": 5,
        "nFeatureSnapIter": 10,
        "implicitFeatureSnap": False,
        "explicitFeatureSnap": True,
        "multiRegionFeatureSnap": False,
    }


def _layers(setup: FoamSetup, walls: list[str]) -> dict[str, Any]:
    """Return the layer settings."""
    return {
        "relativeSizes": True,
        "layers": {name: {"nSurfaceLayers": setup.layers} for name in walls},
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


def _quality() -> dict[str, Any]:
    """Return the mesh quality limits."""
    # Volumes and areas, in m3 and m2, suit cells of a few hundredths of a millimetre.
    return {
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
