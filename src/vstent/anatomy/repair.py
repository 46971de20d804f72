"""Repair a surface from a file: make it one oriented manifold whose open loops are the ends of the vessel."""

from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from vstent.anatomy.bulge import bulging, prominence_of_surface
from vstent.errors import VesselError
from vstent.geometry.surface import Surface
from vstent.kernels import topology, triangles
from vstent.kernels.arrays import Floats, Ints
from vstent.units import counted, place

WELD_OF_EXTENT: Final = 1e-6
"""Vertices closer than this fraction of the bounding box's diagonal are merged."""
ALWAYS_HOLE_OF_DIAMETER: Final = 0.1
"""A loop shorter than a circle of this fraction of the vessel's mean diameter is a hole."""
WALL_HOLE_OF_DIAMETER: Final = 0.5
"""A loop up to this fraction of the mean diameter is a hole if the wall lies in its plane; at an end the wall is
perpendicular to the plane."""
SLIT_ROUNDNESS: Final = 0.4
"""A loop with less area than this fraction of the circle of equal length is a slit, and no end of an artery."""
LONGEST_PATCHED: Final = 120
"""Holes with more vertices are closed by a fan: the run time of the least-area patch grows with the cube of their
number."""
NOTABLE_OF_AREA: Final = 0.02
"""Removed pieces larger than this fraction of the area are reported one by one."""
CONVERGING: Final = 0.25
"""Mean component of the wall's normal along an opening's axis above which the wall converges to it."""


def repair(surface: Surface, *, at_mm: Floats | None = None) -> tuple[Surface, tuple[str, ...]]:
    """Repair a surface and report what was changed.

    Duplicate vertices are merged, degenerate and duplicate faces are dropped, and faces are oriented consistently and
    outward. Non-manifold edges and vertices are separated, one piece is kept, and holes in the wall are closed. No
    vertex is moved. The result is an outward-oriented manifold with boundary, and its open loops are the ends of the
    vessel.

    Parameters
    ----------
    surface : any triangle mesh in mm.
    at_mm : (3,) point in mm near the piece to keep, small debris ignored; the piece of largest area where not given.

    Returns
    -------
    surface : repaired surface.
    notes : one sentence for each change; empty for a sound surface.

    Raises
    ------
    VesselError
        When nothing is left of the surface.
    """
    if not len(surface.faces):
        raise VesselError("The surface has no triangles. Check the file.")
    one_piece = partial(_one_piece, at_mm=at_mm)
    mesh = _Mesh(surface.vertices_mm, surface.faces)
    notes: tuple[str, ...] = ()
    for _ in range(2):  # closing a hole at a pinched vertex leaves needle faces, and a second pass removes them
        for step in (_welded, _cleaned, _opened, _turned, _unzipped, one_piece, _outward, _filled):
            mesh = step(mesh)
            if len(mesh.faces) < 4:
                raise VesselError(
                    "No surface is left after repair: all its faces are degenerate or loose. Check the file."
                )
        notes = notes or mesh.notes
        if not notes:
            break
    return Surface(*triangles.compact(mesh.vertices, mesh.faces)), notes


@dataclass(frozen=True, eq=False)
class _Mesh:
    """A mesh during repair, with the notes on the steps so far."""

    vertices: Floats
    """(n, 3) positions in mm."""
    faces: Ints
    """(m, 3) vertex indices."""
    notes: tuple[str, ...] = ()
    """One sentence for each change."""

    def after(self, vertices: Floats, faces: Ints, note: str = "") -> "_Mesh":
        """Return the mesh after a step, with the note on that step."""
        return _Mesh(vertices, faces, (*self.notes, note) if note else self.notes)


def _welded(mesh: _Mesh) -> _Mesh:
    """Return the mesh with duplicate vertices merged, and those of triangles that miss each other."""
    vertices, faces = triangles.compact(mesh.vertices, mesh.faces)
    extent = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    welded, faces = topology.weld(vertices, faces, WELD_OF_EXTENT * extent)
    n = len(vertices) - len(welded)
    note = (
        f"{counted(n, 'duplicate vertex', 'duplicate vertices')} merged (closer than {WELD_OF_EXTENT * extent:.1g} mm)."
    )
    mesh = mesh.after(welded, faces, note if n else "")
    faces, width_mm = topology.without_cracks(welded, faces)
    note = f"The triangles of the file do not meet: vertices up to {width_mm:.1g} mm apart were merged."
    return mesh.after(welded, faces, note if width_mm else "")


def _cleaned(mesh: _Mesh) -> _Mesh:
    """Return the mesh without degenerate and duplicate faces."""
    ordered = np.sort(mesh.faces, axis=1)
    is_degenerate = (ordered[:, :-1] == ordered[:, 1:]).any(axis=1)
    is_sound = topology.sound_faces(mesh.faces)
    n_degenerate = int(is_degenerate.sum())
    n_duplicate = int((~is_sound).sum()) - n_degenerate
    done = [counted(n_duplicate, "duplicate face")] * (n_duplicate > 0)
    done += [counted(n_degenerate, "degenerate face")] * (n_degenerate > 0)
    return mesh.after(mesh.vertices, mesh.faces[is_sound], f"{' and '.join(done)} dropped." if done else "")


def _opened(mesh: _Mesh) -> _Mesh:
    """Return the mesh without membranes across the lumen and fins."""
    faces = mesh.faces
    while (is_inner := topology.inner_sheets(mesh.vertices, faces)).any():
        faces = faces[~is_inner]
    n = len(mesh.faces) - len(faces)
    return mesh.after(mesh.vertices, faces, f"{counted(n, 'face')} of sheets inside the lumen removed." if n else "")


def _turned(mesh: _Mesh) -> _Mesh:
    """Return the mesh with consistently oriented faces."""
    faces, turned = topology.oriented(mesh.faces)
    n = int(turned.sum())
    mesh = mesh.after(mesh.vertices, faces, f"{counted(n, 'face')} reoriented." if n else "")
    is_clash = topology.clashing(faces)
    n = int(is_clash.sum())
    note = f"{counted(n, 'face')} without a consistent orientation removed."
    return mesh.after(mesh.vertices, faces[~is_clash], note if n else "")


def _unzipped(mesh: _Mesh) -> _Mesh:
    """Return the mesh with non-manifold edges and vertices separated."""
    n_edges = int((topology.edges_of(mesh.faces).n_uses > 2).sum())
    vertices, faces = topology.unzipped(mesh.vertices, mesh.faces)
    while (is_bad := topology.overused(faces)).any():
        vertices, faces = topology.unzipped(vertices, faces[~is_bad])
    n_vertices, n_faces = len(np.unique(faces)) - len(np.unique(mesh.faces)), len(mesh.faces) - len(faces)
    what = counted(n_edges, "non-manifold edge") if n_edges else "Pinched vertices"
    dropped = f", {counted(n_faces, 'face')} dropped" if n_faces else ""
    note = f"{what} separated ({counted(n_vertices, 'vertex', 'vertices')} duplicated{dropped})."
    return mesh.after(vertices, faces, note if n_edges or n_vertices > 0 else "")


def _one_piece(mesh: _Mesh, at_mm: Floats | None) -> _Mesh:
    """Return the mesh with one piece: the one nearest to a point (3,), else that with a bulge, else the largest."""
    label = topology.face_components(mesh.faces)
    area = np.bincount(label, triangles.areas(mesh.vertices[mesh.faces]))
    if len(area) <= 1:
        return mesh
    order = np.argsort(-area)
    notable = [k for k in order if k == order[0] or area[k] > NOTABLE_OF_AREA * area.sum()]

    def piece(k: int) -> Surface:
        return Surface(mesh.vertices, mesh.faces[label == k])

    if at_mm is None:
        kept = bulging(area, lambda k: prominence_of_surface(piece(k)))
    else:
        kept = min(notable, key=lambda k: piece(k).closest(at_mm[None])[1][0])
    left = [
        f"{area[k]:.1f} mm2 about {place(mesh.vertices[np.unique(mesh.faces[label == k])].mean(axis=0))}"
        for k in notable
        if k != kept
    ]
    note = f"{counted(len(area) - 1, 'loose piece')} removed ({area[kept] / area.sum():.1%} of the area kept)"
    note += f", the largest of them {', '.join(left)}; choose another piece by a point near it (--at)." if left else "."
    if at_mm is None and kept != order[0]:
        note += " The piece with a bulge was kept, not the largest one."
    return mesh.after(mesh.vertices, mesh.faces[label == kept], note)


def _outward(mesh: _Mesh) -> _Mesh:
    """Return the mesh with its faces oriented outward."""
    vertices, faces = triangles.cap(mesh.vertices, mesh.faces, triangles.boundary_loops(mesh.vertices, mesh.faces))
    if triangles.volume(vertices[faces]) >= 0:
        return mesh
    return mesh.after(mesh.vertices, mesh.faces[:, ::-1], "The surface was inside out; all faces were reversed.")


def _filled(mesh: _Mesh) -> _Mesh:
    """Return the mesh with the holes in its wall closed."""
    loops = triangles.boundary_loops(mesh.vertices, mesh.faces)
    vertices, faces = triangles.cap(mesh.vertices, mesh.faces, loops)
    diameter = 4 * triangles.volume(vertices[faces]) / float(triangles.areas(mesh.vertices[mesh.faces]).sum())
    wall_normal = triangles.vertex_normals(mesh.vertices, mesh.faces)
    is_hole = [_is_hole(mesh.vertices[loop], wall_normal[loop], diameter) for loop in loops]
    holes = [loop for loop, is_closed in zip(loops, is_hole, strict=True) if is_closed]
    ends = [loop for loop, is_closed in zip(loops, is_hole, strict=True) if not is_closed]
    notes = []
    if holes:
        widest_mm = max(triangles.perimeter(mesh.vertices[loop]) for loop in holes)
        notes.append(f"{counted(len(holes), 'hole')} in the wall closed (the largest {widest_mm:.2g} mm around).")
    area_vectors = [triangles.polygon_area_vector(_without_teeth(mesh.vertices[loop])) for loop in ends]
    area_mm2 = np.array([float(np.linalg.norm(vector)) for vector in area_vectors])
    closed, dome = list(holes), -1
    if len(ends) > 2 and (area_mm2 == area_mm2.max()).sum() == 1:
        # A sac that is cut open: the wall converges to the loop, yet it is wider than all other openings. The end of an
        # artery has walls along it, also where it is cut obliquely; a branch is narrower than its parent.
        widest = int(area_mm2.argmax())
        loop, axis = ends[widest], area_vectors[widest]
        center_mm = triangles.polygon_centroid(mesh.vertices[loop])
        beside_mm = mesh.vertices[mesh.faces[np.isin(mesh.faces, loop).any(axis=1)]].mean(axis=(0, 1))
        axis = axis * (np.sign(axis @ (center_mm - beside_mm)) / np.linalg.norm(axis))
        if (wall_normal[loop] @ axis).mean() > CONVERGING:
            dome = widest
            closed.append(loop)
            notes.append(
                f"The widest opening, at {place(center_mm)}, is a sac that is cut open: the wall "
                "converges to it. It was closed with a flat cap, so the sac is too small by the part that is missing."
            )
    for k, loop in enumerate(ends):
        points = mesh.vertices[loop]
        if k != dome and _is_in_wall(points, wall_normal[loop]):
            notes.append(
                f"The opening {triangles.perimeter(points) / np.pi:.1f} mm wide at "
                f"{place(triangles.polygon_centroid(points))} faces sideways out of the wall. If no artery leaves "
                "there, close it in the surface."
            )
    filled_vertices, filled_faces = mesh.vertices, mesh.faces
    for loop in closed:
        filled_vertices, filled_faces = _fill(filled_vertices, filled_faces, loop)
    return mesh.after(filled_vertices, filled_faces, " ".join(notes))


def _is_hole(points: Floats, wall_normal: Floats, diameter: float) -> bool:
    """Return whether a loop is a hole in the wall: tiny, a slit, or small with the wall in its plane."""
    width = triangles.perimeter(points) / np.pi
    smooth = _without_teeth(points)
    size = float(np.linalg.norm(triangles.polygon_area_vector(smooth)))
    is_slit = 4 * np.pi * size < SLIT_ROUNDNESS * triangles.perimeter(smooth) ** 2
    if width < ALWAYS_HOLE_OF_DIAMETER * diameter or is_slit:
        return True
    return width < WALL_HOLE_OF_DIAMETER * diameter and _is_in_wall(points, wall_normal)


def _is_in_wall(points: Floats, wall_normal: Floats) -> bool:
    """Return whether the wall around a loop (n, 3) lies in its plane; at an end it is perpendicular to the plane."""
    area = triangles.polygon_area_vector(_without_teeth(points))
    return float(np.abs(wall_normal @ area).mean()) > 0.7 * float(np.linalg.norm(area))


def _without_teeth(points: Floats) -> Floats:
    """Return a loop (n, 3) with its sawtooth removed by weights 1/4, 1/2, 1/4, where it has enough vertices."""
    for _ in range(2 if len(points) >= 8 else 0):
        points = 0.25 * (np.roll(points, 1, axis=0) + 2 * points + np.roll(points, -1, axis=0))
    return points


def _fill(vertices: Floats, faces: Ints, loop: Ints) -> tuple[Floats, Ints]:
    """Return the mesh with a loop closed by a least-area patch, or by a fan where it is long or no patch exists."""
    ring = loop[::-1]
    if len(ring) <= LONGEST_PATCHED:
        number = np.full(faces.max() + 1, -1)
        number[ring] = np.arange(len(ring))
        edges = number[triangles.directed_edges(faces)]
        a, b = edges[(edges >= 0).all(axis=1)].T
        is_joined = np.zeros((len(ring), len(ring)), dtype=bool)
        is_joined[a, b] = is_joined[b, a] = True
        patch = topology.least_area(vertices[ring], is_joined)
        if patch is not None:
            return vertices, np.concatenate([faces, ring[patch]]).astype(np.int32)
    return triangles.cap(vertices, faces, [loop])
