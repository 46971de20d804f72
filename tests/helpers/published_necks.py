"""Patients of AneuriskWeb with a published neck each: a planar polygon on the wall; and how far a neck found is off."""

import csv
import time
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from vstent.anatomy.morphology import morphology
from vstent.anatomy.read import read_vessel
from vstent.anatomy.restore.plane import Wall, cut_at
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.errors import VstentError
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy, Aneurysm
from vstent.kernels import sections, triangles

N_SAMPLES = 30_000
"""Points of the grid on which the overlap of two sacs is counted."""


@dataclass(frozen=True)
class Patient:
    """A patient with the published neck and measures of its sac."""

    file: Path
    """Wall; the neck lies beside it."""
    kind: str
    """LAT: on the side of an artery. TER: at a fork."""
    volume_mm3: float
    """Published volume of the sac."""

    @cached_property
    def neck_mm(self) -> np.ndarray:
        """(k, 3) published neck."""
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

        reader = vtkXMLPolyDataReader()
        reader.SetFileName(str(self.file.with_name(f"{self.file.stem}_neck.vtp")))
        reader.Update()
        points = vtk_to_numpy(reader.GetOutput().GetPoints().GetData()).astype(float)
        return points[vtk_to_numpy(reader.GetOutput().GetPolys().GetConnectivityArray())]

    @property
    def center_mm(self) -> np.ndarray:
        """(3,) centroid of the published neck."""
        return triangles.polygon_centroid(self.neck_mm)

    def sac_of(self, lumen: Surface) -> Surface:
        """Return the part of a lumen beyond the published neck, on the side without openings."""
        vector = triangles.polygon_area_vector(self.neck_mm)
        wall = sections.sheet(lumen.vertices_mm, lumen.faces, np.zeros((len(lumen.faces), 3)))
        sacs = []
        for normal in (vector, -vector) / np.linalg.norm(vector):
            inside = self.neck_mm + 0.2 * normal
            seeds = lumen.closest(inside)[2]
            seed = int(seeds[((lumen.corners_mm[seeds] - self.center_mm) @ normal).min(axis=1).argmax()])
            if sections.beyond(wall, seed, self.center_mm[None], normal[None])[1][0]:
                sacs.append(cut_at(Wall(wall, seed), self.center_mm, normal)[0])
        return min(sacs, key=lambda sac: abs(sac.volume_mm3 - self.volume_mm3))


@dataclass(frozen=True)
class Compared:
    """A sac and its neck, found without any help, beside the published ones."""

    case: str
    kind: str
    seconds: float
    """CPU time from the wall to the anatomy."""
    published: tuple[float, float]
    """Published volume of the sac (mm3) and area of the neck polygon (mm2)."""
    measured_mm3: float
    """Volume beyond the published neck in our own measuring."""
    said: str = ""
    """Why there is no sac."""
    volumes: tuple[float, float] = (np.nan, np.nan)
    """Volume of the sac as it is closed and beyond its neck plane, relative to the published one."""
    areas: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    """Area of the section by the neck plane, of the neck curve projected, and of the neck surface, relative to the
    published neck."""
    angle_rad: tuple[float, float] = (np.nan, np.nan)
    """Angle between the published neck and the neck plane, and the mean plane of the neck curve."""
    away: tuple[float, float] = (np.nan, np.nan)
    """Distances of the middles of plane and curve from the published one, in published neck diameters."""
    overlap: tuple[float, float] = (np.nan, np.nan)
    """Intersection over union with the sac beyond the published neck: of the sac as it is closed, and of the part of
    it beyond its plane."""


def patients(folder: Path) -> list[Patient]:
    """Return the patients of a folder with `published.csv`."""
    with (folder / "published.csv").open() as file:
        rows = list(csv.DictReader(file))
    return [Patient(folder / f"{row['case']}.vtp", row["type"], float(row["sac_volume_mm3"])) for row in rows]


def compared(patient: Patient) -> Compared:
    """Find the sac of a patient and compare it with the published one."""
    began = time.process_time()
    whole = trace(read_vessel(patient.file))
    failed, anatomy = "", None
    try:
        anatomy = restore(trim(whole))
    except VstentError as error:
        failed = str(error)
    seconds = time.process_time() - began
    true = patient.sac_of(whole.lumen)
    area_mm2 = float(np.linalg.norm(triangles.polygon_area_vector(patient.neck_mm)))
    known = patient.file.stem, patient.kind, seconds, (patient.volume_mm3, area_mm2), true.volume_mm3
    if anatomy is None or not anatomy.aneurysms:
        return Compared(*known, said=failed or "no sac")
    return Compared(*known, "", *_beside(patient, anatomy, true, area_mm2))


def _beside(patient: Patient, anatomy: Anatomy, true: Surface, area_mm2: float) -> tuple[tuple[float, ...], ...]:
    sac, measures = anatomy.aneurysms[0], morphology(anatomy)
    assert sac.plane is not None
    curve = triangles.polygon_area_vector(sac.neck_mm)
    normal = triangles.polygon_area_vector(patient.neck_mm) / area_mm2
    centers = sac.plane.center_mm, triangles.polygon_centroid(sac.neck_mm)
    cosines = sac.plane.normal @ normal, curve @ normal / np.linalg.norm(curve)
    names = "neck_plane_area_mm2", "neck_area_mm2", "neck_surface_area_mm2"
    return (
        tuple(measures[name] / patient.volume_mm3 for name in ("sac_volume_mm3", "sac_plane_volume_mm3")),
        tuple(measures[name] / area_mm2 for name in names),
        tuple(float(np.arccos(min(abs(cosine), 1.0))) for cosine in cosines),
        tuple(float(np.linalg.norm(at - patient.center_mm)) / np.sqrt(4 * area_mm2 / np.pi) for at in centers),
        _overlaps(sac, true),
    )


def _overlaps(aneurysm: Aneurysm, true: Surface) -> tuple[float, ...]:
    sac, plane = aneurysm.sac, aneurysm.plane
    both = np.concatenate([sac.vertices_mm, true.vertices_mm])
    low, high = both.min(axis=0), both.max(axis=0)
    step = np.cbrt(np.prod(high - low) / N_SAMPLES)
    axes = [np.arange(a + 0.5 * step, b, step) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    ours, theirs = sac.signed_distance(points) < 0, true.signed_distance(points) < 0
    # A sac closed by its plane is beyond it, pouches included.
    is_flat = np.abs((aneurysm.neck_mm - plane.center_mm) @ plane.normal).max() < 1e-6
    beyond = ours & (is_flat | ((points - plane.center_mm) @ plane.normal > 0))
    return tuple(float((one & theirs).sum() / (one | theirs).sum()) for one in (ours, beyond))
