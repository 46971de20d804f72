"""Print how exactly and how fast segmentation and repair work.

Usage: python benchmarks/segment.py [SCAN.raw.gz NI,NJ,NK MM]
"""

import sys
import time
from pathlib import Path

import numpy as np

from vstent.anatomy.repair import repair
from vstent.anatomy.segment import segment
from vstent.geometry.image import Image
from vstent.geometry.surface import Surface
from vstent.io.images import read_image
from vstent.phantoms import Phantom, Scanner, phantom_surface, scan, siphon, torus_arc, tube


def seconds(function, *arguments: object) -> tuple[float, object]:  # noqa: ANN001
    function(*arguments)
    began = time.perf_counter()
    result = function(*arguments)
    return time.perf_counter() - began, result


def errors(phantom: Phantom, scanner: Scanner) -> tuple[float, float]:
    """Bias of the diameter and 95th percentile of the wall's distance, in voxels."""
    surface = segment(scan(phantom, np.random.default_rng(1), scanner=scanner)).lumen
    off_mm = phantom.implicit_mm(surface.vertices_mm)[0]
    weight = np.bincount(surface.faces.ravel(), np.repeat(surface.areas_mm2, 3), minlength=len(off_mm))
    return 2 * np.average(off_mm, weights=weight) / scanner.voxel_mm, np.percentile(
        np.abs(off_mm), 95
    ) / scanner.voxel_mm


def accuracy() -> None:
    print("| phantom | diameter mm | voxel mm | blur voxels | noise | diameter bias, voxels | 95 % of wall, voxels |")
    print("|---|---|---|---|---|---|---|")
    phantoms = (tube(length_mm=12.0), torus_arc(angle_rad=1.5), siphon(), tube(length_mm=12.0, radius_mm=1.0))
    for phantom in phantoms:
        for voxel_mm in (0.15, 0.25, 0.4):
            for blur, noise in ((0.5, 0.03), (1.0, 0.08)):
                bias, spread = errors(phantom, Scanner(voxel_mm, blur * voxel_mm, noise))
                width = 2 * phantom.parent.inscribed_radius_mm[0]
                print(f"| {phantom.name} | {width:.1f} | {voxel_mm} | {blur} | {noise} | {bias:+.3f} | {spread:.2f} |")


def broken(surface: Surface) -> Surface:
    """Unweld, turn a fifth of the faces, and give a twentieth twice."""
    rng = np.random.default_rng(0)
    faces = np.concatenate([surface.faces, surface.faces[::20]])
    faces = np.where(rng.random((len(faces), 1)) < 0.2, faces[:, ::-1], faces)
    return Surface(surface.vertices_mm[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3))


def speed(image: Image) -> None:
    print("\n| what | size | seconds |\n|---|---|---|")
    took, vessel = seconds(segment, image)
    print(
        f"| segment | {' x '.join(map(str, image.voxels.shape))} -> {len(vessel.lumen.faces)} triangles | {took:.2f} |"
    )
    for edge_mm in (0.3, 0.15, 0.075):
        surface = phantom_surface(siphon(), edge_mm=edge_mm)
        print(f"| repair, sound | {len(surface.faces)} triangles | {seconds(repair, surface)[0]:.2f} |")
        print(f"| repair, broken | {len(surface.faces)} triangles | {seconds(repair, broken(surface))[0]:.2f} |")


if __name__ == "__main__":
    accuracy()
    if len(sys.argv) > 1:
        shape = [int(n) for n in sys.argv[2].split(",")]
        speed(read_image(Path(sys.argv[1]), shape=shape, spacing_mm=[float(sys.argv[3])]))
    else:
        speed(scan(siphon(), np.random.default_rng(0), scanner=Scanner(0.2, 0.15)))
