"""How far traced and segmented vessels are from what is known of them; the tests assert it, the benchmark prints it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from vstent import phantoms
from vstent.anatomy.repair import repair
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.segment import segment
from vstent.anatomy.trace import trace
from vstent.geometry.image import Image
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Centerline, Vessel
from vstent.io.surfaces import read_surface
from vstent.kernels import curves, triangles
from vstent.phantoms import Phantom, Scanner

PHANTOMS = (
    phantoms.tube(),
    phantoms.tube(end_radius_mm=1.2),
    phantoms.torus_arc(),
    phantoms.siphon(),
    phantoms.bifurcation(),
)
NAMES = ("tube", "tapered tube", "torus", "siphon", "bifurcation")
SECTION_RAYS = 24
REACHED_MM = 1.0
"""An end is reached by a line that comes as near as this: programs stop at different distances from an opening."""


@dataclass(frozen=True)
class TraceErrors:
    """Errors of the centerlines of one phantom, in mm."""

    mean_mm: float
    max_mm: float
    radius_mm: float
    """Mean absolute error of the inscribed radius."""


def trace_errors(phantom: Phantom, vessel: Vessel) -> TraceErrors:
    """Compare centerlines with the axes, where the vessel is one round tube, a diameter away from its ends."""
    distance, radius = [], []
    for line in vessel.centerlines:
        inner = _inner(line)
        axis, place, off = _nearest_axis(phantom, line.points_mm[inner])
        whole = _is_whole(phantom, axis, place)
        distance.append(off[whole])
        radius.append(line.inscribed_radius_mm[inner][whole] - _true_radius_mm(phantom, axis, place)[whole])
    off_mm, error_mm = np.concatenate(distance), np.concatenate(radius)
    return TraceErrors(float(off_mm.mean()), float(off_mm.max()), float(np.abs(error_mm).mean()))


def _inner(line: Centerline) -> np.ndarray:
    margin = 2 * line.inscribed_radius_mm
    return (line.abscissa_mm > margin[0]) & (line.abscissa_mm < line.length_mm - margin[-1])


def _nearest_axis(phantom: Phantom, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tube (n,) whose axis is nearest to each of (n, 3) points, abscissa (n,) on it and distance (n,)."""
    feet = [curves.project(tube.points_mm, points_mm) for tube in phantom.tubes]
    place, distance = (np.stack([foot[k] for foot in feet]) for k in (0, 1))
    axis = distance.argmin(axis=0)
    every = np.arange(len(points_mm))
    return axis, place[axis, every], distance[axis, every]


def _true_radius_mm(phantom: Phantom, axis: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Radius (n,) of the sphere about an axis point that touches the wall: less than the section's where it tapers."""
    result = np.zeros(len(place))
    for k, tube in enumerate(phantom.tubes):
        slope = np.gradient(tube.inscribed_radius_mm, tube.abscissa_mm)
        radius = tube.inscribed_radius_mm / np.sqrt(1 + slope**2)
        result[axis == k] = np.interp(place[axis == k], tube.abscissa_mm, radius)
    return result


def _is_whole(phantom: Phantom, axis: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Tell where no other part of the phantom opens the wall within a radius along the axis."""
    result = np.zeros(len(place), dtype=bool)
    for k, tube in enumerate(phantom.tubes):
        frames = curves.parallel_frames(tube.points_mm)
        angle = np.linspace(0, 2 * np.pi, SECTION_RAYS, endpoint=False)
        ring = np.cos(angle)[:, None, None] * frames[:, 1] + np.sin(angle)[:, None, None] * frames[:, 2]
        wall = tube.points_mm + tube.inscribed_radius_mm[:, None] * ring
        depth = phantom.implicit_mm(wall.reshape(-1, 3))[0].reshape(SECTION_RAYS, -1).min(axis=0)
        opened = tube.abscissa_mm[depth < -0.02 * tube.inscribed_radius_mm]
        mine = np.flatnonzero(axis == k)
        reach = np.interp(place[mine], tube.abscissa_mm, tube.inscribed_radius_mm)
        gap = np.abs(place[mine, None] - opened).min(axis=1, initial=np.inf)
        result[mine] = gap > reach
    return result


def traced(phantom: Phantom, surface: Surface) -> Vessel:
    """Trace a phantom's exact surface from the end that is its inlet."""
    return trace(Vessel(surface), inlet_mm=phantom.ends[0][0])


def halved(phantom: Phantom, surface: Surface) -> Surface:
    """A phantom's exact surface with every triangle in four, the new vertices on the true wall too.

    Triangles keep their shapes, so that errors tell their order; a mesh made anew lies otherwise in the wall.
    """
    ends = np.sort(triangles.directed_edges(surface.faces), axis=1)
    edges, number = np.unique(ends, axis=0, return_inverse=True)
    middle = surface.vertices_mm[edges].mean(axis=1)
    for _ in range(3):
        value, gradient = phantom.implicit_mm(middle)
        middle = middle - value[:, None] * gradient
    a, b, c = surface.faces.T
    ab, bc, ca = (len(surface.vertices_mm) + number.ravel()).reshape(3, -1)
    faces = [np.stack(corner, axis=1) for corner in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))]
    return Surface(np.concatenate([surface.vertices_mm, middle]), np.concatenate(faces))


@dataclass(frozen=True)
class WallErrors:
    """Errors of a segmented wall, in voxels."""

    diameter_bias: float
    """Twice the mean signed distance to the true wall."""
    p95: float
    """95 % of the wall is nearer to the true one than this."""


def wall_errors(phantom: Phantom, scanner: Scanner, seed: int = 1) -> WallErrors:
    """Segment a synthetic scan of a phantom and compare the wall with the true one."""
    surface = segment(phantoms.scan(phantom, np.random.default_rng(seed), scanner=scanner)).lumen
    off_mm = phantom.implicit_mm(surface.vertices_mm)[0]
    weight = np.bincount(surface.faces.ravel(), np.repeat(surface.areas_mm2, 3), minlength=len(off_mm))
    bias_mm, p95_mm = 2 * np.average(off_mm, weights=weight), np.percentile(np.abs(off_mm), 95)
    return WallErrors(float(bias_mm) / scanner.voxel_mm, float(p95_mm) / scanner.voxel_mm)


@dataclass(frozen=True)
class ReferenceErrors:
    """Distance of our centerlines from another program's, outside the sac, in mm."""

    n_outlets: int
    n_reference: int
    """Lines of the reference."""
    n_reached: int
    """How many ends of the reference's lines one of ours passes."""
    mean_mm: float
    p95_mm: float
    max_mm: float
    radius_mm: float
    """Mean absolute difference of the inscribed radius."""


def reference_errors(folder: Path, case: str) -> ReferenceErrors:
    """Trace a real case and compare with the VMTK centerlines beside it, outside the sac and off the ends."""
    vessel = trace(Vessel(repair(read_surface(folder / f"{case}.vtp")[0])[0]))
    lines = read_centerlines(folder / f"{case}_centerlines.vtp")
    sacs = [aneurysm.sac for aneurysm in restore(vessel).aneurysms]
    points = np.concatenate([line.points_mm for line in lines])
    tips = np.array([line.points_mm[-1] for line in lines])
    own = np.concatenate([line.points_mm for line in vessel.centerlines])
    off, radius = [], []
    for line in vessel.centerlines:
        if cKDTree(points).query(line.points_mm[-1])[0] > REACHED_MM:
            continue  # an outlet that the reference leaves out
        kept = _inner(line) & _is_off(line, sacs)
        feet = [curves.project(other.points_mm, line.points_mm[kept]) for other in lines]
        distance = np.stack([foot[1] for foot in feet])
        pairs = zip(feet, lines, strict=True)
        theirs = np.stack([np.interp(f[0], other.abscissa_mm, other.inscribed_radius_mm) for f, other in pairs])
        nearest, every = distance.argmin(axis=0), np.arange(int(kept.sum()))
        off.append(distance[nearest, every])
        radius.append(np.abs(line.inscribed_radius_mm[kept] - theirs[nearest, every]))
    off_mm = np.concatenate(off)
    reached = cKDTree(own).query(tips)[0] < REACHED_MM
    return ReferenceErrors(
        len(vessel.outlets),
        len(lines),
        int(reached.sum()),
        float(off_mm.mean()),
        float(np.percentile(off_mm, 95)),
        float(off_mm.max()),
        float(np.concatenate(radius).mean()),
    )


def _is_off(line: Centerline, sacs: Sequence[Surface]) -> np.ndarray:
    """Tell which points (n,) of a line are farther than a diameter from every sac's wall, and outside of it."""
    result = np.ones(len(line.points_mm), dtype=bool)
    for sac in sacs:
        result &= sac.signed_distance(line.points_mm) > 2 * line.inscribed_radius_mm
    return result


def read_centerlines(path: Path) -> list[Centerline]:
    """Centerlines as VMTK writes them."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    reader = vtkXMLPolyDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    data = reader.GetOutput()
    points = vtk_to_numpy(data.GetPoints().GetData()).astype(float)
    radius = vtk_to_numpy(data.GetPointData().GetArray("MaximumInscribedSphereRadius")).astype(float)
    starts = vtk_to_numpy(data.GetLines().GetOffsetsArray())
    order = vtk_to_numpy(data.GetLines().GetConnectivityArray())
    pieces = np.split(order, starts[1:-1])
    return [Centerline(points[piece], radius[piece]) for piece in pieces]


def large_scan(n: int = 256, voxel_mm: float = 0.2) -> Image:
    """Synthetic scan of n^3 voxels about the demo's artery."""
    image = phantoms.scan(phantoms.demo_phantom(), np.random.default_rng(0), scanner=Scanner(voxel_mm, 0.2))
    rng = np.random.default_rng(1)
    voxels = rng.normal(100, 80, (n, n, n)).astype(np.int16)
    size = np.minimum(image.voxels.shape, n)
    part = tuple(slice(0, k) for k in size)
    voxels[part] = image.voxels[part]
    return Image(voxels, image.affine_mm)
