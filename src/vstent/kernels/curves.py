"""Polylines: arc length, frames, curvature, interpolation, projection and smoothing."""

from typing import Any

import numpy as np
from numba import njit
from scipy.ndimage import percentile_filter
from scipy.sparse import csc_matrix, diags, eye
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from vstent.kernels.arrays import Floats


def lengths(vectors: Floats) -> Floats:
    """Return the lengths (...) of vectors (..., d); several times as fast as numpy's norm where d is small."""
    return np.asarray(np.sqrt(np.einsum("...k,...k->...", vectors, vectors)))


def closed_lengths(rows: Floats) -> Floats:
    """Return the lengths (n,) of smooth closed curves through rows of points (n, m, d).

    Each arc is its chord plus 8/3 of the squared height above it, divided by the chord. The height follows from four
    consecutive points: their bending perpendicular to the chord, at any spacing.
    """
    # A writable copy, because numba compiles separate code for read-only arrays.
    return np.asarray(_closed_lengths(np.array(rows, dtype=np.float64, order="C")))


@njit(cache=True, nogil=True)
def _closed_lengths(rows: Any) -> Any:
    """Return the lengths (n,) of closed rows."""
    n, m, d = rows.shape
    length = np.zeros(n)
    for i in range(n):
        before, here, ahead = m - 1, 0, 1 % m
        for j in range(m):
            beyond = (j + 2) % m
            chord2, bend2, slid = 1e-300, 0.0, 0.0
            for k in range(d):
                way = rows[i, ahead, k] - rows[i, here, k]
                bend = rows[i, here, k] + rows[i, ahead, k] - rows[i, before, k] - rows[i, beyond, k]
                chord2 += way * way
                bend2 += bend * bend
                slid += way * bend
            chord = np.sqrt(chord2)
            length[i] += chord + max(bend2 - slid * slid / chord2, 0.0) / (96 * chord)
            before, here, ahead = here, ahead, beyond
    return length


def arc_length(points: Floats) -> Floats:
    """Return the cumulative length (n,) of a polyline (n, 3), starting at 0."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def interpolate(abscissa: Floats, values: Floats, wanted: Floats) -> Floats:
    """Return values (k, d) at arc lengths `wanted` (k,), linear between samples at `abscissa` (n,), (n, d)."""
    return np.stack([np.interp(wanted, abscissa, column) for column in values.T], axis=-1)


def resample(points: Floats, step: float) -> Floats:
    """Return points (k, 3) at equal arc lengths of about `step` along a polyline (n, 3); the ends are kept."""
    return resample_evenly(points, max(2, round(arc_length(points)[-1] / step) + 1))


def resample_evenly(points: Floats, n: int) -> Floats:
    """Return `n` points (n, 3) at equal arc lengths along a polyline (k, 3); the ends are kept."""
    abscissa = arc_length(points)
    return interpolate(abscissa, points, np.linspace(0.0, abscissa[-1], n))


def tangents(points: Floats) -> Floats:
    """Return the unit tangents (n, 3) of a polyline, from central differences over arc length."""
    derivative = np.gradient(points, arc_length(points), axis=0)
    return derivative / np.linalg.norm(derivative, axis=1, keepdims=True)


def parallel_frames(points: Floats) -> Floats:
    """Return rotation-minimising frames (n, 3, 3) of a polyline: rows tangent, normal, binormal (right-handed).

    They are found by double reflection (Wang, Juettler, Zheng and Liu 2008, ACM Trans. Graph. 27(1):2, table I).
    """
    tangent = tangents(points)
    points = np.array(points, dtype=np.float64)  # a writable copy: numba compiles separate code for read-only arrays
    return np.asarray(_transported(points, tangent, any_perpendicular(tangent[0])))


@njit(cache=True)
def _transported(points: Any, tangent: Any, first: Any) -> Any:
    """Return the frames (n, 3, 3) that transport the normal `first` along the curve."""
    n = len(points)
    frames = np.zeros((n, 3, 3))
    normal, step, turn = first.copy(), np.zeros(3), np.zeros(3)
    for i in range(n):
        if i > 0:
            length2, shift, ahead = 0.0, 0.0, 0.0
            for k in range(3):
                step[k] = points[i, k] - points[i - 1, k]
                length2 += step[k] * step[k]
                shift += step[k] * normal[k]
                ahead += step[k] * tangent[i - 1, k]
            turn2, slip = 0.0, 0.0
            for k in range(3):
                normal[k] -= 2.0 / length2 * shift * step[k]
                turn[k] = tangent[i, k] - (tangent[i - 1, k] - 2.0 / length2 * ahead * step[k])
                turn2 += turn[k] * turn[k]
                slip += turn[k] * normal[k]
            along, size2 = 0.0, 0.0
            for k in range(3):
                normal[k] -= 2.0 / turn2 * slip * turn[k] if turn2 >= 1e-30 else 0.0
                along += normal[k] * tangent[i, k]
            for k in range(3):
                normal[k] -= along * tangent[i, k]
                size2 += normal[k] * normal[k]
            for k in range(3):
                normal[k] /= np.sqrt(size2)
        for k in range(3):
            frames[i, 0, k], frames[i, 1, k] = tangent[i, k], normal[k]
            frames[i, 2, k] = (
                tangent[i, (k + 1) % 3] * normal[(k + 2) % 3] - tangent[i, (k + 2) % 3] * normal[(k + 1) % 3]
            )
    return frames


def curvature_and_torsion(points: Floats, reach: float) -> tuple[Floats, Floats]:
    """Return curvature |a x b| / |a|^3 and torsion (a x b) . c / |a x b|^2, both (n,), of evenly spaced points (n, 3).

    a, b and c are the first three derivatives of a quartic least-squares fit through the points within `reach` along
    the curve (Savitzky and Golay 1964, Anal. Chem. 36:1627). The torsion of a straight piece, where it is undefined, is
    set to 0.
    """
    step = float(arc_length(points)[-1]) / (len(points) - 1)
    window = min(2 * max(3, round(reach / step)) + 1, len(points) - 1 + len(points) % 2)
    # scipy.signal, which has the same filter, is not used because its import takes a second. The first and the last fit
    # also apply to the points between them and the ends.
    half, order = window // 2, 4
    fit = np.linalg.pinv(np.vander(np.arange(-half, half + 1.0) / half, order + 1, increasing=True))
    start = np.clip(np.arange(len(points)) - half, 0, len(points) - window)
    at = (np.arange(len(points)) - start - half)[:, None] / half
    power = (np.lib.stride_tricks.sliding_window_view(points, window, axis=0) @ fit.T)[start]
    derivatives = []
    for k in (1, 2, 3):
        power = power[..., 1:] * np.arange(1.0, order + 2 - k)
        value = np.polynomial.polynomial.polyval(at, np.moveaxis(power, -1, 0), tensor=False)
        derivatives.append(value / (half * step) ** k)
    a, b, c = derivatives
    cross = np.cross(a, b)
    size = np.linalg.norm(cross, axis=1)
    is_bent = size > 1e-6
    torsion = np.einsum("ij,ij->i", cross, c) / np.where(is_bent, size, 1.0) ** 2
    return size / np.linalg.norm(a, axis=1) ** 3, np.where(is_bent, torsion, 0.0)


def directions(n: int) -> Floats:
    """Return `n` unit vectors (n, 3), evenly spread over all directions."""
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    z = np.linspace(-1, 1, n)
    return np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=1)


def any_perpendicular(direction: Floats) -> Floats:
    """Return a unit vector (3,) perpendicular to a unit vector (3,)."""
    helper = np.eye(3)[np.argmin(np.abs(direction))]
    normal = np.cross(direction, helper)
    return normal / np.linalg.norm(normal)


def running_percentile(values: Floats, percentile: float, size: int) -> Floats:
    """Return the percentile (n,) of values (n,) in a window of `size` samples, at least three, around each."""
    return np.asarray(percentile_filter(values, percentile, size=max(3, size), mode="nearest"))


def project(polyline: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Return arc length (k,) and distance (k,) of the foot of points (k, 3) on a polyline (n, 3).

    Only the two segments next to the nearest vertex are tried, so that the polyline must be finer than its distance
    from the points.
    """
    abscissa = arc_length(polyline)
    nearest = cKDTree(polyline).query(points)[1]
    best_s, best_d = np.zeros(len(points)), np.full(len(points), np.inf)
    for shift in (-1, 0):
        i = np.clip(nearest + shift, 0, len(polyline) - 2)
        edge = polyline[i + 1] - polyline[i]
        length2 = np.maximum(np.einsum("ij,ij->i", edge, edge), 1e-300)
        t = np.clip(np.einsum("ij,ij->i", points - polyline[i], edge) / length2, 0.0, 1.0)
        distance = np.linalg.norm(points - (polyline[i] + t[:, None] * edge), axis=1)
        better = distance < best_d
        best_d = np.where(better, distance, best_d)
        best_s = np.where(better, abscissa[i] + t * np.sqrt(length2), best_s)
    return best_s, best_d


def lowpass(values: Floats, n_waves: float) -> Floats:
    """Return values (n, ...) around a ring without waves of which more than `n_waves` fit into it."""
    wave = np.arange(len(values) // 2 + 1)
    gain = 1.0 / (1.0 + (wave / n_waves) ** 4)
    return np.fft.irfft(np.fft.rfft(values, axis=0) * gain.reshape(-1, *[1] * (values.ndim - 1)), n=len(values), axis=0)


def roughness(n: int, order: int, strength: Floats | float = 1.0) -> csc_matrix:
    """Return the matrix (n, n) of the sum of squared differences along n samples, weighted with `strength`."""
    difference = csc_matrix(eye(n))
    for k in range(order):
        difference = csc_matrix(diags([-1.0, 1.0], [0, 1], shape=(n - k - 1, n - k)) @ difference)
    middle = np.broadcast_to(strength, n)[order // 2 : order // 2 + n - order]
    return csc_matrix(difference.T @ diags(middle) @ difference)


def smooth(values: Floats, weight: Floats, strength: Floats | float, order: int = 2) -> Floats:
    """Smooth samples v (n, ...): minimise sum w |x - v|^2 + strength |difference of `order` of x|^2.

    Weights w are (n,), and the strength may differ between samples (Whittaker; Eilers 2003, Anal. Chem. 75:3631).
    """
    if len(values) <= order:
        return values
    matrix = diags(weight) + roughness(len(values), order, strength)
    right = values * (weight if values.ndim == 1 else weight[:, None])
    return np.asarray(spsolve(csc_matrix(matrix), right)).reshape(values.shape)
