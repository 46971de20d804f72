"""Order of cells and faces for the march: step lengths in levels, groups of neighbours, and connections."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from vstent.angiography.kernels import advection
from vstent.angiography.network import Network
from vstent.kernels.arrays import Floats, Ints

LEVELS: Final = 7
"""Number of step lengths, each twice the one before."""
GROUP: Final = 64
"""Largest number of cells of a group; larger ones are skipped less often, smaller ones cost more to look through."""


@dataclass(frozen=True, eq=False)
class Layout:
    """A network in the order of its groups, ready for the kernels."""

    network: Network
    """Cells and flow rates in that order."""
    order: Ints
    """(n,) number of each cell in the network as given."""
    faces: Ints
    """(f,) number of each face in the network as given."""
    level: Ints
    """(n,) level of each cell: the power of two by which its step exceeds the base step."""
    outflow_per_s: Floats
    """(n,) outflow of each cell over its volume."""
    total_per_s: Floats
    """(n,) outflow and diffusive exchange of each cell over its volume."""
    mesh: advection.Mesh
    """Connections."""
    groups: advection.Groups
    """Groups."""

    @property
    def top(self) -> int:
        """Level of the slowest cells."""
        return len(self.groups.end) - 1

    def allowance(self, base_s: float) -> Floats:
        """Return the largest ratio (n,) of a face value to a cell value that leaves the bounds intact in a step."""
        step_s = base_s * 2.0**self.level
        kept = 1 - (self.total_per_s - self.outflow_per_s) * step_s
        return np.asarray(kept / np.maximum(self.outflow_per_s * step_s, 1e-12))


def layout(network: Network, diffusivity_mm2_s: float) -> Layout:
    """Return a network in the order in which it is marched."""
    n = len(network.cells)
    width = np.r_[network.width, np.zeros(network.openings)]
    apart_mm = 0.5 * (width[network.left] + width[network.right]) * network.spacing_mm
    is_inner = (network.left < n) & (network.right < n)
    # Diffusive exchange per concentration difference: the area of a face over the distance of its cells.
    exchange_mm3_s = diffusivity_mm2_s * np.where(is_inner, network.area_mm2 / apart_mm, 0.0)
    exchanged_mm3_s = np.bincount(network.left, exchange_mm3_s, n + network.openings)
    exchanged_mm3_s += np.bincount(network.right, exchange_mm3_s, n + network.openings)
    outflow_per_s = network.outflow_per_s
    total_per_s = outflow_per_s + np.asarray(exchanged_mm3_s[:n] / network.volume_mm3)
    slowness = total_per_s.max() / np.maximum(total_per_s, 1e-12)
    level = np.minimum(np.floor(np.log2(slowness)), LEVELS - 1).astype(np.int64)
    left, right = network.left[is_inner], network.right[is_inner]
    for _ in range(LEVELS):  # neighbours differ by one level at most
        np.minimum.at(level, left, level[right] + 1)
        np.minimum.at(level, right, level[left] + 1)
    order = np.lexsort((_morton(network.cells // network.width.min()), level))
    number = np.r_[np.zeros(n, dtype=np.int64), n + np.arange(network.openings)]
    number[order] = np.arange(n)
    faces = np.argsort(np.minimum(number[network.left], number[network.right]), kind="stable")
    network = network.taken(order, faces, number)
    level = level[order]
    connections = _mesh(network, exchange_mm3_s[faces]), _groups(network, level)
    return Layout(network, order, faces, level, outflow_per_s[order], total_per_s[order], *connections)


def _morton(cells: Ints) -> Ints:
    """Return the place (n,) of cells along a curve that keeps neighbours together (Morton's)."""
    place = np.zeros(len(cells), dtype=np.int64)
    for bit in range(int(cells.max(initial=1)).bit_length()):
        for axis in range(3):
            place |= (cells[:, axis].astype(np.int64) >> bit & 1) << (3 * bit + axis)
    return place


def _groups(network: Network, level: Ints) -> advection.Groups:
    """Return groups of consecutive cells of one level, and those that each touches through its faces."""
    n = len(level)
    starts = np.flatnonzero(np.r_[True, np.diff(level) > 0])
    sizes = np.diff(np.r_[starts, n])
    cells = np.concatenate([np.arange(start, start + size, GROUP) for start, size in zip(starts, sizes, strict=True)])
    count = len(cells)
    cell_group = np.r_[np.repeat(np.arange(count), np.diff(np.r_[cells, n])), np.full(network.openings, count)]
    group = cell_group[np.minimum(network.left, network.right)]
    touched = np.r_[cell_group[network.left], cell_group[network.right]]
    pairs = np.unique(np.r_[group, group].astype(np.int64) * (count + 1) + touched)
    by, of = pairs // (count + 1), pairs % (count + 1)
    back = np.argsort(of, kind="stable")
    edges = np.arange(count + 1)
    return advection.Groups(
        level=level[cells].astype(np.int8),
        end=np.bincount(level[cells]).cumsum(),
        cells=np.r_[cells, n].astype(np.int32),
        faces=np.searchsorted(group, edges).astype(np.int32),
        touched_first=np.searchsorted(by, edges).astype(np.int32),
        touched=of.astype(np.int32),
        beside_first=np.searchsorted(of[back], edges).astype(np.int32),
        beside=by[back].astype(np.int32),
    )


def _mesh(network: Network, exchange_mm3_s: Floats) -> advection.Mesh:
    """Return the connections of the cells, for the kernels."""
    n, f = len(network.cells), np.arange(len(network.left))
    cell, other = np.r_[network.left, network.right], np.r_[network.right, network.left]
    side = 2 * network.axis[np.r_[f, f]].astype(np.int64) + np.repeat([1, 0], len(f))
    order = np.lexsort((side, cell))
    order = order[cell[order] < n]
    cell, other, side, face = cell[order], other[order], side[order], np.r_[f, f][order]
    width = np.r_[network.width, np.zeros(network.openings)]
    count = np.bincount(6 * cell + side, minlength=6 * n)
    share = 2 * width[cell] / (width[cell] + width[other]) / count[6 * cell + side]
    weight = np.where(other < n, share, 0.0)
    near = np.repeat(np.arange(n, dtype=np.int32)[:, None], 6, axis=1)
    is_inner = weight > 0
    near[cell[is_inner], side[is_inner]] = other[is_inner]
    near[cell[is_inner & (weight != 1)], 0] = -1
    entry = np.zeros(2 * len(f), dtype=np.uint32)
    entry[order] = np.arange(len(order))
    return advection.Mesh(
        left=network.left.astype(np.uint32),
        right=network.right.astype(np.uint32),
        axis=network.axis.astype(np.uint8),
        near=near,
        first=np.searchsorted(cell, np.arange(n + 1)).astype(np.int32),
        face=face.astype(np.int32),
        other=other.astype(np.int32),
        side=side.astype(np.int8),
        weight=weight.astype(np.float32),
        lower_entry=entry[: len(f)],
        upper_entry=entry[len(f) :],
        per_volume=(1 / network.volume_mm3).astype(np.float32),
        conductance=exchange_mm3_s.astype(np.float32),
    )
