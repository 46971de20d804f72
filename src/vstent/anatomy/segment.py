"""Segment a scan: find the wall of the contrast-filled lumen."""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import ndtr

from vstent.anatomy.bulge import bulging, prominence, similar
from vstent.anatomy.masks import prepared
from vstent.errors import VesselError
from vstent.geometry.image import Image
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Vessel
from vstent.io.surfaces import GIANT_DIAMETER_MM, VESSEL_DIAMETER_MM
from vstent.kernels import smoothing, topology, triangles
from vstent.kernels.arrays import Bools, Floats
from vstent.kernels.voxels import isosurface
from vstent.units import place

FEWEST_VOXELS: Final = 300
"""A lumen of fewer voxels is noise."""
NOTABLE_PIECE: Final = 0.02
"""Pieces with less than this fraction of the voxels of the largest piece near the given point are ignored."""
BAND: Final = 0.05
"""Assumed uncertainty of the threshold, as a fraction of the step from tissue to lumen."""
FARTHEST_MM: Final = 5.0
"""Largest distance of the lumen from the given point, in mm."""
AROUND_MM: Final = 15.0
"""Where a point is given, the first threshold is computed from the scan within this distance of it, in mm."""
FILLS: Final = 0.2
"""An object that fills more than this fraction of the scan, and is wider than vessels, is a head or a field of view."""
AIR_MM: Final = 2.0
"""Voxels this close to surrounding air or padding, in mm, are not used to find a vessel's threshold."""
MOST_GROUNDS: Final = 3
"""Largest number of intensity levels below that of the vessel: padding, air and tissue."""
MOST_FACES: Final = 120_000
"""Meshes with more triangles are decimated to this number."""
SMOOTHING_STEPS: Final = 12
"""Iterations of Taubin smoothing."""
PASS_BAND: Final = 0.1
"""Pass band of Taubin smoothing."""
CURVATURE_ROUNDS: Final = 25
"""Number of averages of the wall's curvature with that of neighbouring vertices, over about three voxels."""
CREVICE_ROUNDS: Final = 4
"""A crevice between two parts of the vessel is where the curvature is concave after this many averages."""
CREVICE_RINGS: Final = 3
"""Number of rings of vertices by which a crevice is widened."""
PROFILE_VOXELS: Final = 4.0
"""Length of the profiles across the wall, into the lumen and into the tissue, in voxels."""
PROFILES: Final = 8000
"""Largest number of profiles across the wall."""


def segment(image: Image, *, threshold: float | None = None, at_mm: Floats | None = None) -> Vessel:
    """Find the wall of the lumen as an iso-surface of the scan.

    The wall is smoothed (Taubin 1995). The change of volume by smoothing is measured, reported and corrected.

    Parameters
    ----------
    image : scan in which blood is brighter than the surrounding tissue, mask or label map (see `prepared`).
    threshold : intensity of the wall; where not given, half way between tissue and lumen, see `propose`.
    at_mm : (3,) point in or near the requested vessel in mm; the largest vessel where not given.

    Returns
    -------
    vessel : wall of the lumen in LPS mm, open where it meets the border of the scan, without named openings. Its notes
        state how the threshold was found and how the diameter depends on it.

    Raises
    ------
    VesselError
        When no lumen is found: no object of sufficient size is brighter than the threshold or near the point, or the
        object is wider than any artery.
    """
    image = prepared(image, is_united=threshold is None)
    if threshold is None:
        lumen, note, profile = propose(image, at_mm=at_mm)
    else:
        lumen = _lumen(image, float(threshold), at_mm)
        profile = _profile(lumen)
        note = f"Threshold {threshold:.4g} as given; the proposed one is {profile.wall_level:.4g}."
    if 2 * profile.radius_mm > GIANT_DIAMETER_MM:
        middle_mm = lumen.affine_mm[:3] @ [*(0.5 * (np.array(lumen.field.shape) - 1)), 1.0]
        raise VesselError(
            f"At threshold {lumen.threshold:.4g} the object near {place(middle_mm)} is {2 * profile.radius_mm:.0f} "
            f"mm wide, and no artery is wider than {GIANT_DIAMETER_MM:g} mm: it is the head, bone or the field of "
            "view. Set another threshold (--threshold), choose a point in the artery (--at), or crop the scan "
            "where the two touch."
        )
    rough = _wall(lumen)
    surface, volume_mm3 = _taubin(rough), rough.closed.volume_mm3
    lost = volume_mm3 - surface.closed.volume_mm3
    vertices_mm = surface.vertices_mm + (lost / surface.area_mm2) * surface.vertex_normals
    surface = Surface(vertices_mm, surface.faces)
    if threshold is None:
        surface = _unblurred(surface, profile)
    size = " x ".join(f"{h:.3g}" for h in image.spacing_mm)
    share = lumen.n_voxels / lumen.n_above
    count = f"The lumen has {lumen.n_voxels} voxels of {size} mm, {share:.0%} of all voxels above the threshold."
    if lumen.others_mm:
        count += f" Another object of similar size lies about {place(lumen.others_mm[0])}: --at chooses it."
    # The uncertainty is relative to the step, not to the threshold, because the zero of a scan's intensities is
    # arbitrary.
    off = BAND * (profile.lumen - profile.tissue)
    band_mm = 2 * off / profile.slope_per_mm
    band = f"A change of the threshold by {off:.3g} ({BAND:.0%} of the step from tissue to lumen) changes diameters by "
    band += f"±{band_mm:.3f} mm ({band_mm / lumen.voxel_mm:.2f} voxel)."
    smoothing_note = f"Smoothing changed the volume by {-lost / volume_mm3:+.2%}; the change was corrected."
    notes = [*image.notes, note, band, count, smoothing_note]
    if len(surface.faces) > MOST_FACES:  # reduced by quadric error (Garland and Heckbert 1997, SIGGRAPH)
        import fast_simplification

        fine, mesh = surface, (np.array(surface.vertices_mm), np.array(surface.faces))
        surface = Surface(*fast_simplification.simplify(*mesh, target_count=MOST_FACES))
        change = surface.closed.volume_mm3 / fine.closed.volume_mm3 - 1
        notes.append(f"{len(fine.faces)} triangles reduced to {len(surface.faces)} (volume {change:+.2%}).")
    return Vessel(
        surface,
        notes=tuple(notes),
        threshold_band_mm=band_mm,
        blur_mm=profile.blur_mm,
        voxel_mm=lumen.voxel_mm,
        is_oriented=image.is_oriented,
    )


@dataclass(frozen=True, eq=False)
class Lumen:
    """Voxels of one vessel, and the intensity of its wall."""

    field: NDArray[np.float32]
    """(i, j, k) intensities of the part of the scan around the vessel; other vessels are set below the threshold."""
    affine_mm: Floats
    """(4, 4) transform from an index in `field` to LPS mm."""
    threshold: float
    """Intensity of the wall."""
    n_voxels: int
    """Number of voxels in the vessel."""
    n_above: int
    """Number of voxels of the whole scan above the threshold."""
    others_mm: tuple[Floats, ...] = ()
    """Centers (3,) of the boxes around other objects of similar size, in LPS mm."""

    @property
    def voxel_mm(self) -> float:
        """Edge length in mm of a cube with the volume of a voxel."""
        return float(np.abs(np.linalg.det(self.affine_mm[:3, :3])) ** (1 / 3))


def propose(image: Image, *, at_mm: Floats | None = None) -> tuple[Lumen, str, "Profile"]:
    """Return the vessel at a proposed threshold, or that near a point (3,), a note, and the profile across its wall.

    Vessels are far less than a tenth of the voxels, so the histogram of the scan does not show them. The threshold is
    found in two steps:

    1. The first threshold is the mean intensity weighted with the squared gradient (Kittler, Illingworth and Foeglein
       1985, Comput. Vis. Graph. Image Process. 30:125).
    2. The vessel found with it is sampled by profiles along the normals of its wall. The threshold is half way between
       the medians of tissue and lumen, the full width at half maximum (Hoogeveen, Bakker and Viergever 1998; journal
       and page not verified).

    The wall of a cylinder of radius R, blurred with standard deviation s, is not at one half but at Phi(-s / (2 R)) of
    the step (mean curvature flow, to first order), where Phi is the standard normal distribution. The slope of the
    profile gives s. R is that of the whole vessel; `_unblurred` corrects branches and sacs.
    """
    # The strongest edges of a scan may be those between head and air, or between field of view and padding. The object
    # above such a threshold fills the scan, and the next threshold is computed within that object.
    voxels = image.voxels
    if at_mm is not None:
        box = _box_around(image, at_mm, AROUND_MM)
        voxels = voxels[box] if min(side.stop - side.start for side in box) > 2 else voxels
    lumen = _lumen(image, _edge_level(voxels), at_mm)
    profile = _profile(lumen)
    for _ in range(MOST_GROUNDS):
        if 2 * profile.radius_mm <= VESSEL_DIAMETER_MM[1] or lumen.n_voxels < FILLS * image.voxels.size:
            break
        to_air_mm = ndimage.distance_transform_edt(~(voxels < lumen.threshold), sampling=image.spacing_mm)
        lumen = _lumen(image, _edge_level(voxels, to_air_mm > AIR_MM), at_mm)
        profile = _profile(lumen)
    profile = _profile(replace(lumen, threshold=profile.wall_level))
    lumen = _lumen(image, profile.wall_level, at_mm)
    note = (
        f"Threshold {lumen.threshold:.4g} proposed: half way between tissue ({profile.tissue:.4g}) and lumen "
        f"({profile.lumen:.4g}), corrected for the curvature of the wall and a blur of {profile.blur_mm:.2g} "
        "mm."
    )
    return lumen, note, profile


# -- voxels ------------------------------------------------------------------------------------------------------------


def _box_around(image: Image, at_mm: Floats, reach_mm: float) -> tuple[slice, ...]:
    """Return the box of voxels within reach of a point (3,), clipped to the scan."""
    reach = np.ceil(reach_mm / image.spacing_mm).astype(int) + 1
    middle = np.round(image.to_index(np.asarray(at_mm, dtype=np.float64)[None])[0]).astype(int)
    low = np.clip(middle - reach, 0, image.voxels.shape)
    return tuple(map(slice, low, np.clip(middle + reach + 1, low, image.voxels.shape)))


def _edge_level(voxels: NDArray[Any], is_within: Bools | None = None) -> float:
    """Return the mean intensity weighted with the squared gradient above noise, where `is_within` holds."""
    if min(voxels.shape) < 3:
        raise VesselError(
            f"A scan of {' x '.join(map(str, voxels.shape))} voxels is too thin to contain a lumen. Give the "
            "whole scan."
        )
    middle = (slice(1, -1, 2),) * 3
    squared = np.zeros(voxels[middle].shape, dtype=np.float32)
    for axis in range(3):
        ahead, behind = list(middle), list(middle)
        ahead[axis], behind[axis] = slice(2, None, 2), slice(0, -2, 2)
        squared += (voxels[tuple(ahead)].astype(np.float32) - voxels[tuple(behind)].astype(np.float32)) ** 2
    counts = np.ones(squared.shape, dtype=bool) if is_within is None else is_within[middle]
    noise = float(np.median(squared[counts])) if counts.any() else 0.0
    weight = np.where(counts & (squared > 8 * noise), squared, 0.0).astype(np.float64)
    if not weight.sum() > 0:
        raise VesselError(
            "The scan has no edges and therefore no contrast-filled lumen. Check that it is the right series."
        )
    return float((weight * voxels[middle]).sum() / weight.sum())


def _lumen(image: Image, threshold: float, at_mm: Floats | None) -> Lumen:
    """Return connected voxels above the threshold: the piece near a point, else that with a bulge or the largest."""
    above = image.voxels >= threshold
    if above.all():
        raise VesselError(
            f"No voxel is below threshold {threshold:.4g} (intensities range from {image.voxels.min()} to "
            f"{image.voxels.max()}). Set another threshold (--threshold)."
        )
    label, n_components = ndimage.label(above)
    size = np.bincount(label[above], minlength=n_components + 1)
    if size.max(initial=0) < FEWEST_VOXELS:
        raise VesselError(
            f"At threshold {threshold:.4g} the largest object has {size.max(initial=0)} voxels (intensities "
            f"range from {image.voxels.min()} to {image.voxels.max()}). Set another threshold (--threshold)."
        )

    def box_of(number: int) -> tuple[slice, ...]:
        return ndimage.find_objects(label, max_label=number)[number - 1]

    if at_mm is None:
        chosen = bulging(size, lambda k: prominence(label[box_of(k)] == k, image.spacing_mm))
    else:
        box = _box_around(image, at_mm, FARTHEST_MM)
        # Voxels are counted near the point only: the bone of a head has a hundred times as many voxels as an artery.
        n_near = np.bincount(label[box].ravel(), minlength=len(size))
        n_near[size < FEWEST_VOXELS] = 0
        index = np.argwhere(np.isin(label[box], np.flatnonzero(n_near > NOTABLE_PIECE * n_near.max())))
        index += [side.start for side in box]
        distance_mm = np.linalg.norm(image.to_mm(index.astype(np.float64)) - at_mm, axis=1)
        if distance_mm.min(initial=np.inf) > FARTHEST_MM:
            raise VesselError(
                f"There is no lumen within {FARTHEST_MM:g} mm of {place(at_mm)}: nothing notable there is brighter "
                f"than threshold {threshold:.4g}. Check the point, which is in LPS mm (--at), or set "
                "another threshold (--threshold)."
            )
        chosen = int(label[tuple(index[distance_mm.argmin()])])
    margin = int(PROFILE_VOXELS) + 2  # the length of the profiles
    sides = zip(box_of(chosen), label.shape, strict=True)
    box = tuple(slice(max(0, s.start - margin), min(n, s.stop + margin)) for s, n in sides)
    part = label[box]
    field = image.voxels[box].astype(np.float32)
    below = np.float32(threshold - 0.5 * max(float(field.max()) - threshold, 1e-6))
    field[(part > 0) & (part != chosen)] = below
    affine = np.array(image.affine_mm)
    affine[:3, 3] = image.to_mm(np.array([[s.start for s in box]]))[0]
    others = [box_of(k) for k in similar(size) if k != chosen]
    middles = [image.to_mm(np.array([[0.5 * (s.start + s.stop - 1) for s in other]]))[0] for other in others]
    return Lumen(field, affine, threshold, int(size[chosen]), int(size.sum()), tuple(middles))


# -- profiles across the wall ------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Profile:
    """Intensity across the wall, from lumen to tissue."""

    lumen: float
    """Median intensity in the lumen, where the vessel is thick."""
    tissue: float
    """Median intensity in the tissue."""
    slope_per_mm: float
    """Steepest slope around half height, per mm."""
    radius_mm: float
    """Hydraulic radius 2 V / A of the vessel."""
    voxel_mm: float
    """Edge length in mm of a cube with the volume of a voxel."""

    @property
    def blur_mm(self) -> float:
        """Standard deviation in mm of the Gaussian blur that turns a step into this slope.

        Linear interpolation between voxels adds a variance of voxel^2 / 6, which is subtracted because it is not the
        scan's.
        """
        read_mm = (self.lumen - self.tissue) / (np.sqrt(2 * np.pi) * self.slope_per_mm)
        return float(np.sqrt(max(read_mm**2 - self.voxel_mm**2 / 6, 0.0)))

    @property
    def wall_level(self) -> float:
        """Intensity at the wall of a blurred cylinder."""
        share = float(ndtr(-0.5 * min(self.blur_mm / self.radius_mm, 1.0)))
        return self.tissue + share * (self.lumen - self.tissue)


def _profile(lumen: Lumen) -> Profile:
    """Return the median profile along the normals of the smoothed wall."""
    surface = _taubin(_wall(lumen))
    some = np.random.default_rng(0).permutation(len(surface.vertices_mm))[:PROFILES]
    depth_mm = np.arange(-PROFILE_VOXELS, PROFILE_VOXELS + 0.01, 0.25) * lumen.voxel_mm
    points = surface.vertices_mm[some, None] + depth_mm[:, None] * surface.vertex_normals[some, None]
    inverse = np.linalg.inv(lumen.affine_mm)
    index = points.reshape(-1, 3) @ inverse[:3, :3].T + inverse[:3, 3]
    value = ndimage.map_coordinates(lumen.field, index.T, order=1, mode="nearest").reshape(len(some), -1)
    # Profiles count where they stay in the lumen on their inner side; where hardly any do, the deeper half.
    n_within = (value[:, depth_mm < 0] >= lumen.threshold).sum(axis=1)
    stays = n_within == (depth_mm < 0).sum()
    value = value[stays if stays.mean() > 0.05 else n_within >= np.median(n_within)]
    course, outer = np.median(value, axis=0), depth_mm > 0.55 * PROFILE_VOXELS * lumen.voxel_mm
    # The plateau is where the blur has the least effect. In a thin vessel that is its axis, not the deepest sample.
    plateau, tissue = float(course.max()), float(np.median(value[:, outer]))
    steps, height = -np.gradient(course, depth_mm), float(np.ptp(course))
    near = np.abs(course - 0.5 * (plateau + tissue)) <= 0.35 * np.ptp(course)
    slope = max(float(steps[near].max(initial=0.0)), 1e-6 * height + 1e-300)
    radius_mm = 2 * lumen.n_voxels * lumen.voxel_mm**3 / surface.area_mm2
    return Profile(plateau, tissue, slope, radius_mm, lumen.voxel_mm)


# -- mesh --------------------------------------------------------------------------------------------------------------


def _wall(lumen: Lumen) -> Surface:
    """Return the outermost iso-surface in LPS mm, oriented outward; cavities in the lumen are left out."""
    index, faces = isosurface(lumen.field, lumen.threshold)
    label = topology.face_components(faces)
    area = np.bincount(label, triangles.areas(index[faces]))
    index, faces = triangles.compact(index, faces[label == area.argmax()])
    if np.linalg.det(lumen.affine_mm[:3, :3]) < 0:
        faces = faces[:, ::-1]
    return Surface(index @ lumen.affine_mm[:3, :3].T + lumen.affine_mm[:3, 3], faces)


def _taubin(surface: Surface) -> Surface:
    """Return the smoothed surface."""
    vertices = smoothing.taubin(surface.vertices_mm, surface.faces, iterations=SMOOTHING_STEPS, pass_band=PASS_BAND)
    return Surface(vertices, surface.faces)


def _unblurred(surface: Surface, profile: Profile) -> Surface:
    """Return the wall shifted by s^2 times the excess of its mean curvature over that of the whole vessel."""
    # The threshold is right for the radius of the whole vessel. With it, a thin branch is too narrow and a sac too
    # wide. No shift exceeds half a voxel. A crevice curves more sharply than the blur resolves and has no relation to
    # the curvature of the adjacent wall, so it is left out of the average.
    curvature = smoothing.mean_curvature(surface.vertices_mm, surface.faces, rounds=CREVICE_ROUNDS)
    mean = smoothing.averaging(len(curvature), surface.faces)
    is_wall = curvature > 0
    for _ in range(CREVICE_RINGS):
        is_wall &= mean @ is_wall.astype(np.float64) > 1.0 - 1e-9
    total, weight = np.where(is_wall, curvature, 0.0), is_wall.astype(np.float64)
    for _ in range(CURVATURE_ROUNDS):
        total, weight = mean @ total, mean @ weight
    typical = 0.5 / profile.radius_mm
    curvature = np.where(weight > 1e-3, total / np.maximum(weight, 1e-3), typical)
    shift_mm = profile.blur_mm**2 * (curvature - typical)
    shift_mm = np.clip(shift_mm, -0.5 * profile.voxel_mm, 0.5 * profile.voxel_mm)
    return Surface(surface.vertices_mm + shift_mm[:, None] * surface.vertex_normals, surface.faces)
