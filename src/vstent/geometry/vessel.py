"""Data classes of an artery: `Opening`, `Centerline`, `Vessel`, `Aneurysm`, `Candidate`, `Path` and `Anatomy`."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from vstent.geometry.surface import Surface
from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Bools, Floats, freeze
from vstent.units import place


@dataclass(frozen=True, eq=False)
class Opening:
    """A flat end of the vessel through which blood enters or leaves."""

    center_mm: Floats
    """(3,) centroid of the section."""
    normal: Floats
    """(3,) unit normal, out of the lumen."""
    area_mm2: float
    """Area of the section."""
    role: str
    """``inlet`` where the parent artery begins; ``inlet_2``, ``inlet_3``, ... in the order given; ``outlet_1``,
    ``outlet_2``, ... from the widest outlet to the narrowest."""

    def __post_init__(self) -> None:
        freeze(self, "center_mm normal", np.float64, (3,))

    @property
    def diameter_mm(self) -> float:
        """Diameter of the circle of the same area."""
        return float(2 * np.sqrt(self.area_mm2 / np.pi))

    @property
    def described(self) -> str:
        """Width and position as text: ``3.5 mm wide at (1.0, -2.5, 30.2) mm``."""
        return f"{self.diameter_mm:.1f} mm wide at {place(self.center_mm)}"

    @property
    def is_inlet(self) -> bool:
        """Whether blood enters through it."""
        return self.role.startswith("inlet")

    def away_mm(self, point_mm: Floats) -> float:
        """Return the distance of a point (3,) from its center, in mm."""
        return float(np.linalg.norm(self.center_mm - point_mm))


def roles(n_inlets: int, n_outlets: int) -> list[str]:
    """Return the roles of a vessel's openings in their order: inlets first, then outlets."""
    inlets = ["inlet", *(f"inlet_{k}" for k in range(2, n_inlets + 1))]
    return [*inlets, *(f"outlet_{k}" for k in range(1, n_outlets + 1))]


def murray_shares(openings: Sequence[Opening]) -> Floats:
    """Return the fraction of the flow through each opening (k,), as its diameter cubed (Murray 1926, PNAS 12:207)."""
    cubes = np.array([opening.diameter_mm**3 for opening in openings])
    return np.asarray(cubes / cubes.sum())


@dataclass(frozen=True, eq=False)
class Centerline:
    """A curve along the lumen with the maximum inscribed sphere at every point."""

    points_mm: Floats
    """(n, 3) points, from the inlet to another opening."""
    inscribed_radius_mm: Floats
    """(n,) radius of the maximum inscribed sphere."""

    def __post_init__(self) -> None:
        freeze(self, "points_mm", np.float64, (-1, 3))
        freeze(self, "inscribed_radius_mm", np.float64, (len(self.points_mm),))

    @cached_property
    def abscissa_mm(self) -> Floats:
        """(n,) arc length from the first point."""
        return curves.arc_length(self.points_mm)

    @property
    def length_mm(self) -> float:
        """Length of the whole curve."""
        return float(self.abscissa_mm[-1])

    @cached_property
    def frames(self) -> Floats:
        """(n, 3, 3) tangent and two normals as rows, parallel-transported (no twist)."""
        return curves.parallel_frames(self.points_mm)

    def at(self, abscissa_mm: Floats) -> Floats:
        """Return the points (k, 3) in mm at arc lengths (k,) in mm, linear between points."""
        return curves.interpolate(self.abscissa_mm, self.points_mm, abscissa_mm)

    def nearest_abscissa_mm(self, points_mm: Floats) -> Floats:
        """Return the arc length (k,) in mm of the nearest curve point for each of the points (k, 3) in mm."""
        return curves.project(self.points_mm, points_mm)[0]


@dataclass(frozen=True, eq=False)
class Vessel:
    """A lumen with named openings and, once traced, its centerlines."""

    lumen: Surface
    """The wall, open at every opening."""
    openings: tuple[Opening, ...] = ()
    """The inlet, further inlets in the order given, and the outlets from the widest to the narrowest; empty before
    tracing."""
    centerlines: tuple[Centerline, ...] = ()
    """One centerline from the inlet to each of `far_ends`, in their order; empty before tracing."""
    notes: tuple[str, ...] = ()
    """Findings, assumptions and repairs so far, one sentence each."""
    threshold_band_mm: float = 0.0
    """Change of a diameter where the threshold of the scan changes by 5 % of the step from tissue to lumen; a lower
    threshold gives a larger diameter. 0 for a vessel that is not from a scan."""
    blur_mm: float | None = None
    """Standard deviation of the point spread with which the scan shows the wall; None where unknown."""
    voxel_mm: float | None = None
    """Edge length of a cube with the volume of a voxel; None for a vessel from a surface."""
    is_oriented: bool = True
    """Whether left, right, front and back are known (see `Image`)."""

    @property
    def closed(self) -> Surface:
        """The lumen with every open loop capped: its inside is blood."""
        return self.lumen.closed

    @property
    def inlet(self) -> Opening:
        """The opening where the parent artery and the centerlines begin."""
        return self.openings[0]

    @property
    def far_ends(self) -> tuple[Opening, ...]:
        """The openings where the centerlines end: all but the inlet."""
        return self.openings[1:]

    @property
    def inlets(self) -> tuple[Opening, ...]:
        """The openings through which blood enters: the inlet and further given ones."""
        return tuple(opening for opening in self.openings if opening.is_inlet)

    @property
    def outlets(self) -> tuple[Opening, ...]:
        """The openings through which blood leaves."""
        return tuple(opening for opening in self.openings if not opening.is_inlet)

    def of_inlets_and_outlets(self, values: Floats) -> tuple[Floats, Floats]:
        """Split values (k,) of all openings into those of the inlets (i,) and those of the outlets (k - i,)."""
        n_inlets = len(self.inlets)
        return values[:n_inlets], values[n_inlets:]


@dataclass(frozen=True, eq=False)
class NeckPlane:
    """The plane that separates a sac from all arteries, at which sacs are compared and sized."""

    normal: Floats
    """(3,) unit normal, toward the dome."""
    rim_mm: Floats
    """(k, 3) closed curve in which it cuts the wall (the last point joins the first)."""
    area_band_mm2: tuple[float, float]
    """Smallest and largest area of the sections by planes that separate them nearly as well."""
    bulge_fraction: float = 1.0
    """Fraction of the wall that rises above the arteries which is beyond the plane."""

    def __post_init__(self) -> None:
        freeze(self, "normal", np.float64, (3,))
        freeze(self, "rim_mm", np.float64, (-1, 3))

    @property
    def center_mm(self) -> Floats:
        """(3,) centroid of the section."""
        return triangles.polygon_centroid(self.rim_mm)

    @property
    def area_mm2(self) -> float:
        """Area of the section."""
        return float(np.linalg.norm(triangles.polygon_area_vector(self.rim_mm)))


@dataclass(frozen=True, eq=False)
class Aneurysm:
    """A sac and the neck that connects it to the artery."""

    sac: Surface
    """The lumen outside the landing surface, closed across the neck."""
    neck: Surface
    """The surface that closes the sac; its normals point into the sac."""
    neck_mm: Floats
    """(k, 3) closed curve where the sac leaves the artery (the last point joins the first)."""
    plane: NeckPlane | None = None
    """Plane of the neck; None where no plane separates the sac from all arteries."""

    def __post_init__(self) -> None:
        freeze(self, "neck_mm", np.float64, (-1, 3))

    @cached_property
    def mean_plane(self) -> NeckPlane:
        """Mean plane of the neck curve; its rim is that curve."""
        vector_mm2 = triangles.polygon_area_vector(self.neck_mm)
        area_mm2 = float(np.linalg.norm(vector_mm2))
        inward = self.sac.vertices_mm.mean(axis=0) - triangles.polygon_centroid(self.neck_mm)
        return NeckPlane(vector_mm2 / area_mm2 * np.sign(inward @ vector_mm2), self.neck_mm, (area_mm2, area_mm2))


@dataclass(frozen=True, eq=False)
class Candidate:
    """A bulge of the wall that may be an aneurysm: its class and the reasons for it."""

    kind: str
    """``saccular aneurysm``, ``branch stump``, ``infundibulum``, ``bleb`` or ``artifact``."""
    point_mm: Floats
    """(3,) point inside it, by which it can be chosen."""
    reasons: tuple[str, ...]
    """Reasons for the class, one clause each."""

    def __post_init__(self) -> None:
        freeze(self, "point_mm", np.float64, (3,))

    @property
    def is_aneurysm(self) -> bool:
        """Whether it is used as an aneurysm unless another one is chosen."""
        return self.kind == "saccular aneurysm"

    @property
    def described(self) -> str:
        """Class, position and reasons as one clause."""
        return f"{self.kind} at {place(self.point_mm)}: {', '.join(self.reasons)}"


PARENT: Final = "parent"
"""Name of the path along the parent artery."""
BEYOND_MM: Final = 1e-6
"""Rounding of abscissae, mm."""


@dataclass(frozen=True, eq=False)
class Path:
    """A way on which an implant is placed: an axis, and the surface against which the implant expands."""

    name: str
    """``parent`` for the parent artery; see `vstent.anatomy.restore.paths` for others."""
    axis: Centerline
    """Axis from the proximal to the distal end; its radius is the distance to the landing surface."""
    section_radius_mm: Floats
    """(n,) radius of the circle with the area of the landing surface's section at every axis point."""
    landing_surface: Surface
    """The way with sac and side branches closed, as an open tube."""
    is_restored: Bools
    """(v,) whether each vertex of the landing surface closes a neck or an ostium and is not the patient's own wall."""
    continued_mm: tuple[float, float] = (0.0, 0.0)
    """Lengths at the proximal and distal end of the axis, mm, that are assumed: the patient's artery ends before."""

    def __post_init__(self) -> None:
        freeze(self, "section_radius_mm", np.float64, (len(self.axis.points_mm),))
        freeze(self, "is_restored", np.bool_, (len(self.landing_surface.vertices_mm),))

    @property
    def own_mm(self) -> tuple[float, float]:
        """Where the patient's artery begins and ends on the axis, in mm."""
        return self.continued_mm[0], self.axis.length_mm - self.continued_mm[1]

    @cached_property
    def is_continued(self) -> Bools:
        """(v,) whether each vertex of the landing surface is in a continuation of the artery."""
        if not any(self.continued_mm):
            return np.zeros(len(self.is_restored), dtype=bool)
        first_mm, last_mm = self.own_mm
        abscissa_mm = self.axis.abscissa_mm
        beyond = (abscissa_mm < first_mm - BEYOND_MM) | (abscissa_mm > last_mm + BEYOND_MM)
        return np.repeat(beyond, len(self.is_restored) // len(abscissa_mm))

    @cached_property
    def is_patient_face(self) -> Bools:
        """(f,) whether each triangle of the landing surface is the patient's own wall."""
        faces = self.landing_surface.faces
        return np.asarray(~self.is_restored_face & ~self.is_continued[faces].any(axis=1))

    @cached_property
    def is_restored_face(self) -> Bools:
        """(f,) whether all corners of each triangle of the landing surface are restored."""
        return np.asarray(self.is_restored[self.landing_surface.faces].all(axis=1))

    def span_mm(self, aneurysm: Aneurysm) -> tuple[float, float]:
        """Return the abscissae, in mm, between which the neck of a sac lies along this path."""
        abscissa_mm = self.axis.nearest_abscissa_mm(aneurysm.neck_mm)
        return float(abscissa_mm.min()), float(abscissa_mm.max())


@dataclass(frozen=True, eq=False)
class Anatomy:
    """A traced vessel with its sacs, and the paths on which implants are placed."""

    vessel: Vessel
    """The patient's lumen with sac and branches, through which blood flows."""
    paths: tuple[Path, ...]
    """The ways on which implants are placed; the first is that of the parent artery."""
    aneurysms: tuple[Aneurysm, ...]
    """The sacs found, the largest first; empty for a healthy artery."""
    notes: tuple[str, ...] = ()
    """Findings and assumptions, one sentence each."""
    candidates: tuple[Candidate, ...] = ()
    """Every bulge that was examined, with its class."""

    @property
    def parent(self) -> Path:
        """The path along the parent artery."""
        return self.paths[0]
