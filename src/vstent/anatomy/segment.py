"""Segment a scan: find the wall of the contrast-filled lumen."""

from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

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
from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.kernels.isosurface import isosurface
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
    lumen, notes, profile = propose(image, at_mm=at_mm) if threshold is None else _at(image, float(threshold), at_mm)
    _refuse_wide(lumen, profile)
    surface, smooth_note = _smooth(_wall(lumen))
    if threshold is None:
        surface = _unblurred(surface, profile)
    surface, decimation_notes = _decimated(surface)
    size = " x ".join(f"{h:.3g}" for h in image.spacing_mm)
    share = lumen.n_voxels / lumen.n_above
    found = f"The lumen has {lumen.n_voxels} voxels of {size} mm, {share:.0%} of all voxels above the threshold."
    if lumen.others_mm:
        found += f" Another object of similar size lies about {place(lumen.others_mm[0])}: --at chooses it."
    # The uncertainty is relative to the step, not to the threshold, because the zero of a scan's intensities is
    # arbitrary.
    off = BAND * (profile.lumen - profile.tissue)
    band_mm = 2 * off / profile.slope_per_mm
    band = f"A change of the threshold by {off:.3g} ({BAND:.0%} of the step from tissue to lumen) changes diameters by "
    band += f"+-{band_mm:.3f} mm ({band_mm / lumen.voxel_mm:.2f} voxel)."
    all_notes = (*image.notes, *notes, band, found, smooth_note, *decimation_notes)
    return Vessel(
        surface,
        notes=all_notes,
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


def propose(image: Image, *, at_mm: Floats | None = None) -> tuple[Lumen, tuple[str, ...], "Profile"]:
    """Propose a threshold for the wall of the lumen.

    Vessels are far less than a tenth of the voxels, so the histogram of the scan does not show them. The threshold is
    found in two steps:

    1. The first threshold is the mean intensity weighted with the squared gradient (Kittler et al. 1985).
    2. The vessel found with it is sampled by profiles along the normals of its wall. The threshold is half way between
       the medians of tissue and lumen, the full width at half maximum (Hoogeveen et al. 1998).

    The wall of a cylinder of radius R, blurred with standard deviation s, is not at one half but at Phi(-s / (2 R)) of
    the step (mean curvature flow, to first order), where Phi is the standard normal distribution. The slope of the
    profile gives s. R is that of the whole vessel; `_unblurred` corrects branches and sacs.

    Parameters
    ----------
    image : scan in which blood is brighter than the surrounding tissue.
    at_mm : (3,) point in or near the requested vessel in mm; the largest vessel where not given.

    Returns
    -------
    lumen : voxels of the vessel, with the proposed threshold.
    notes : how the threshold was found.
    profile : median profile across the wall.

    References
    ----------
    Kittler, Illingworth and Foeglein 1985, Comput. Vis. Graph. Image Process. 30:125.

    Hoogeveen, Bakker and Viergever 1998 (journal and page not verified).
    """
    first, profile = _first(image, at_mm)
    second = replace(first, threshold=profile.wall_level)
    profile = _profile(second)
    lumen = _lumen(image, profile.wall_level, at_mm)
    note = (
        f"Threshold {lumen.threshold:.4g} proposed: half way between tissue ({profile.tissue:.4g}) and lumen "
        f"({profile.lumen:.4g}), corrected for the curvature of the wall and a blur of {profile.blur_mm:.2g} "
        "mm."
    )
    return lumen, (note,), profile


def _at(image: Image, threshold: float, at_mm: Floats | None) -> tuple[Lumen, tuple[str, ...], "Profile"]:
    """Return the lumen at a given threshold, a note, and the profile across its wall."""
    lumen = _lumen(image, threshold, at_mm)
    profile = _profile(lumen)
    note = f"Threshold {threshold:.4g} as given; the proposed one is {profile.wall_level:.4g}."
    return lumen, (note,), profile


def _refuse_wide(lumen: Lumen, profile: "Profile") -> None:
    """Raise a VesselError if the object is wider than any artery."""
    if 2 * profile.radius_mm <= GIANT_DIAMETER_MM:
        return
    middle_mm = lumen.affine_mm[:3] @ [*(0.5 * (np.array(lumen.field.shape) - 1)), 1.0]
    raise VesselError(
        f"At threshold {lumen.threshold:.4g} the object near {place(middle_mm)} is {2 * profile.radius_mm:.0f} "
        f"mm wide, and no artery is wider than {GIANT_DIAMETER_MM:g} mm: it is the head, bone or the field of "
        "view. Set another threshold (--threshold), choose a point in the artery (--at), or crop the scan "
        "where the two touch."
    )


# -- voxels ------------------------------------------------------------------------------------------------------------


def _first(image: Image, at_mm: Floats | None) -> tuple[Lumen, "Profile"]:
    """Return the vessel at a first threshold, and the profile across its wall."""
    # The strongest edges of a scan may be those between head and air, or between field of view and padding. The object
    # above such a threshold fills the scan, and the next threshold is computed within that object.
    voxels = image.voxels[_around(image, at_mm)]
    lumen = _lumen(image, _edge_level(voxels), at_mm)
    profile = _profile(lumen)
    for _ in range(MOST_GROUNDS):
        is_wide = 2 * profile.radius_mm > VESSEL_DIAMETER_MM[1]
        if not is_wide or lumen.n_voxels < FILLS * image.voxels.size:
            break
        is_within = _clear_of(voxels < lumen.threshold, image.spacing_mm)
        lumen = _lumen(image, _edge_level(voxels, is_within), at_mm)
        profile = _profile(lumen)
    return lumen, profile


def _around(image: Image, at_mm: Floats | None) -> tuple[slice, ...]:
    """Return the box of voxels within `AROUND_MM` of a point (3,); the whole scan without a point or far from it."""
    whole = tuple(slice(0, n) for n in image.voxels.shape)
    if at_mm is None:
        return whole
    low, high = _reach(image, at_mm, AROUND_MM)
    return tuple(map(slice, low, high)) if (high - low > 2).all() else whole


def _reach(image: Image, at_mm: Floats, reach_mm: float) -> tuple[Ints, Ints]:
    """Return the first (3,) and last-plus-one (3,) voxel index of a box around a point (3,), clipped to the scan."""
    reach = np.ceil(reach_mm / image.spacing_mm).astype(int) + 1
    middle = np.round(image.to_index(np.asarray(at_mm, dtype=np.float64)[None])[0]).astype(int)
    low = np.clip(middle - reach, 0, image.voxels.shape)
    return low, np.clip(middle + reach + 1, low, image.voxels.shape)


def _clear_of(is_ground: Bools, spacing_mm: Floats) -> Bools:
    """Return whether each voxel is farther than `AIR_MM` from the background."""
    return np.asarray(ndimage.distance_transform_edt(~is_ground, sampling=spacing_mm) > AIR_MM)


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


class _Pieces(NamedTuple):
    """Connected pieces above a threshold."""

    label: NDArray[Any]
    """(i, j, k) number of the piece of each voxel, 0 for none."""
    size: NDArray[Any]
    """(pieces + 1,) number of voxels in each piece; 0 in the first entry."""
    threshold: float
    """Intensity above which voxels belong to a piece."""


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
    pieces = _Pieces(label, size, threshold)
    if at_mm is None:
        chosen = bulging(size, lambda k: prominence(label[_box(label, k)] == k, image.spacing_mm))
    else:
        chosen = _nearest(image, pieces, np.asarray(at_mm, dtype=np.float64))
    box = _with_margin(_box(label, chosen), label.shape)
    part = label[box]
    field = image.voxels[box].astype(np.float32)
    below = np.float32(threshold - 0.5 * max(float(field.max()) - threshold, 1e-6))
    field[(part > 0) & (part != chosen)] = below
    affine = np.array(image.affine_mm)
    affine[:3, 3] = image.to_mm(np.array([[s.start for s in box]]))[0]
    others = [_box(label, k) for k in similar(size) if k != chosen]
    middles = [image.to_mm(np.array([[0.5 * (s.start + s.stop - 1) for s in box]]))[0] for box in others]
    return Lumen(field, affine, threshold, int(size[chosen]), int(size.sum()), tuple(middles))


def _box(label: NDArray[Any], number: int) -> tuple[slice, ...]:
    """Return the bounding box of a piece."""
    found: tuple[slice, ...] = ndimage.find_objects(label, max_label=number)[number - 1]
    return found


def _nearest(image: Image, pieces: _Pieces, at_mm: Floats) -> int:
    """Return the number of the piece nearest to a point (3,), small debris ignored."""
    low, high = _reach(image, at_mm, FARTHEST_MM)
    part = pieces.label[tuple(map(slice, low, high))]
    # Voxels are counted near the point only: the bone of a head has a hundred times as many voxels as an artery.
    n_near = np.bincount(part.ravel(), minlength=len(pieces.size))
    n_near[pieces.size < FEWEST_VOXELS] = 0
    index = np.argwhere(np.isin(part, np.flatnonzero(n_near > NOTABLE_PIECE * n_near.max())))
    distance = (
        np.linalg.norm(image.to_mm((low + index).astype(np.float64)) - at_mm, axis=1)
        if len(index)
        else np.array([np.inf])
    )
    if distance.min() > FARTHEST_MM:
        place = ", ".join(f"{v:.1f}" for v in at_mm)
        raise VesselError(
            f"There is no lumen within {FARTHEST_MM:g} mm of ({place}) mm: nothing notable there is brighter "
            f"than threshold {pieces.threshold:.4g}. Check the point, which is in LPS mm (--at), or set "
            "another threshold (--threshold)."
        )
    return int(part[tuple(index[distance.argmin()])])


def _with_margin(box: tuple[slice, ...], shape: tuple[int, ...]) -> tuple[slice, ...]:
    """Return a box widened by the length of the profiles, clipped to the scan."""
    margin = int(PROFILE_VOXELS) + 2
    return tuple(slice(max(0, s.start - margin), min(n, s.stop + margin)) for s, n in zip(box, shape, strict=True))


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
    value = value[_is_thick(value, depth_mm, lumen)]
    course, outer = np.median(value, axis=0), depth_mm > 0.55 * PROFILE_VOXELS * lumen.voxel_mm
    # The plateau is where the blur has the least effect. In a thin vessel that is its axis, not the deepest sample.
    plateau, tissue = float(course.max()), float(np.median(value[:, outer]))
    slope = _slope(course, depth_mm, 0.5 * (plateau + tissue))
    radius_mm = 2 * lumen.n_voxels * lumen.voxel_mm**3 / surface.area_mm2
    return Profile(plateau, tissue, slope, radius_mm, lumen.voxel_mm)


def _is_thick(value: NDArray[Any], depth_mm: Floats, lumen: Lumen) -> Bools:
    """Return whether each profile (n,) stays in the lumen on its inner side; the deeper half where hardly any do."""
    stays = value[:, depth_mm < 0].min(axis=1) >= lumen.threshold
    if stays.mean() > 0.05:
        return stays
    within = (value[:, depth_mm < 0] >= lumen.threshold).sum(axis=1)
    return within >= np.median(within)


def _slope(profile: NDArray[Any], depth_mm: Floats, level: float) -> float:
    """Return the steepest descent of a profile around a level, per mm."""
    steps = -np.gradient(profile, depth_mm)
    near = np.abs(profile - level) <= 0.35 * np.ptp(profile)
    return max(float(steps[near].max(initial=0.0)), 1e-6 * float(np.ptp(profile)) + 1e-300)


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


def _smooth(rough: Surface) -> tuple[Surface, str]:
    """Return the smoothed surface with its volume restored, and a note."""
    volume = _capped_volume_mm3(rough)
    smooth = _taubin(rough)
    lost = volume - _capped_volume_mm3(smooth)
    vertices = smooth.vertices_mm + (lost / smooth.area_mm2) * smooth.vertex_normals
    return Surface(
        vertices, smooth.faces
    ), f"Smoothing changed the volume by {-lost / volume:+.2%}; the change was corrected."


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


def _decimated(fine: Surface) -> tuple[Surface, tuple[str, ...]]:
    """Return a mesh reduced to `MOST_FACES` by quadric error (Garland and Heckbert 1997, SIGGRAPH), and a note."""
    if len(fine.faces) <= MOST_FACES:
        return fine, ()
    import fast_simplification

    vertices, faces = fast_simplification.simplify(
        np.array(fine.vertices_mm), np.array(fine.faces), target_count=MOST_FACES
    )
    coarse = Surface(vertices, faces)
    change = _capped_volume_mm3(coarse) / _capped_volume_mm3(fine) - 1
    return coarse, (f"{len(fine.faces)} triangles reduced to {len(faces)} (volume {change:+.2%}).",)


def _capped_volume_mm3(surface: Surface) -> float:
    """Return the volume of a surface with its open loops capped, in mm3."""
    vertices, faces = triangles.cap(surface.vertices_mm, surface.faces, surface.boundary_loops)
    return triangles.volume(vertices[faces])
