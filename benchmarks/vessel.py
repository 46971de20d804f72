"""Print how exact and how fast the vessel is: segmentation, centerlines, parent artery.

Run from the repository: ``python benchmarks/vessel.py``. The real cases are left out where they are not at hand.
``python benchmarks/vessel.py aneurisk FOLDER`` finds the sac and the neck of every patient of a folder with
``published.csv``, ``CASE.vtp`` and ``CASE_neck.vtp``, and compares them with the published ones.
"""

import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from vstent import phantoms
from vstent.anatomy.morphology import morphology
from vstent.anatomy.repair import repair
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.segment import segment
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Vessel
from vstent.io.surfaces import read_surface
from vstent.phantoms import Scanner

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "helpers"))
from published_necks import Compared, compared, patients
from sac_truth import GLUED, anatomy_of, beside_the_fork_without_sac, moved_mm, relative_errors, scanned_anatomy_of
from vessel_truth import NAMES, PHANTOMS, halved, large_scan, reference_errors, trace_errors, traced, wall_errors

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
EDGE_MM = 0.6
"""Edges of the coarsest mesh of the table of centerlines; it is halved twice."""
VOXELS_MM = (0.15, 0.25, 0.4)
NECKS = ("neck_plane_area_mm2", "neck_surface_area_mm2", "neck_area_mm2")
"""Cut by a plane, closed by the artery's wall, and the neck's curve projected (docs/concepts/parent_artery.rst)."""
SIZES = {20_000: 0.325, 80_000: 0.163, 320_000: 0.0814}
"""Triangles of the demo's artery, and the edge that makes about so many."""


def centerlines() -> None:
    print("| phantom | edge, mm | triangles | centerline mean, um | max, um | radius mean, um | order of the radius |")
    print("|---|---|---|---|---|---|---|")
    for name, phantom in zip(NAMES, PHANTOMS, strict=True):
        surface, before = phantoms.phantom_surface(phantom, edge_mm=EDGE_MM), None
        for edge_mm in (EDGE_MM, EDGE_MM / 2, EDGE_MM / 4):
            e = trace_errors(phantom, traced(phantom, surface))
            order = "" if before is None else f"{np.log2(before.radius_mm / e.radius_mm):.2f}"
            print(
                f"| {name} | {edge_mm} | {len(surface.faces)} "
                f"| {1000 * e.mean_mm:.2f} | {1000 * e.max_mm:.2f} | {1000 * e.radius_mm:.3f} | {order} |"
            )
            surface, before = halved(phantom, surface), e


def walls() -> None:
    print("\n| phantom | voxel, mm | blur, voxels | noise | diameter bias, voxels | 95 % of the wall, voxels |")
    print("|---|---|---|---|---|---|")
    for name, phantom in zip(NAMES, PHANTOMS, strict=True):
        for voxel_mm in VOXELS_MM:
            for blur, noise in ((0.5, 0.03), (1.0, 0.08)):
                e = wall_errors(phantom, Scanner(voxel_mm, blur * voxel_mm, noise))
                print(f"| {name} | {voxel_mm} | {blur} | {noise} | {e.diameter_bias:+.3f} | {e.p95:.2f} |")


def references() -> None:
    print("\n| case | outlets | VMTK lines reached | distance mean, mm | 95 % | max | radius mean, mm |")
    print("|---|---|---|---|---|---|---|")
    for case in ("aneurisk_C0038", "aneurisk_beta"):
        e = reference_errors(DATA, case)
        print(
            f"| {case} | {e.n_outlets} | {e.n_reached} of {e.n_reference} "
            f"| {e.mean_mm:.3f} | {e.p95_mm:.3f} | {e.max_mm:.3f} | {e.radius_mm:.3f} |"
        )


def restored() -> None:
    """The fork beside the one without its sac, healthy arteries beside themselves, C0038 beside AneuriskWeb."""
    print(
        "\n| fork with a sac beside the one without | artery radius mean | wall 95 %, mm | max, mm |\n|---|---|---|---|"
    )
    for side in (-1.0, 1.0):
        _, _, radius, wall_mm = beside_the_fork_without_sac(DATA, side)
        print(
            f"| into {'+' if side > 0 else '-'}x | {np.abs(radius).mean():.1%} | {np.quantile(wall_mm, 0.95):.3f} "
            f"| {wall_mm.max():.3f} |"
        )
    print("\n| healthy artery | sacs | own wall moved at most, mm |\n|---|---|---|")
    for name in ("aneurisk_C0015_no_sac.vtp", "healthy_siphon.vtk"):
        anatomy = restore(trace(Vessel(repair(read_surface(DATA / name)[0])[0])))
        print(f"| {name} | {len(anatomy.aneurysms)} | {moved_mm(anatomy):.3f} |")
    found = morphology(restore(trim(trace(Vessel(read_surface(DATA / "aneurisk_C0038.vtp")[0])))))
    print("\n| aneurisk_C0038 | AneuriskWeb | found |\n|---|---|---|")
    for key, theirs in (("sac_plane_volume_mm3", 344.4), ("sac_volume_mm3", 344.4), *((k, 38.5) for k in NECKS)):
        print(f"| {key} | {theirs} | {found[key]:.1f} ({found[key] / theirs - 1:+.0%}) |")


def sacs() -> None:
    """Neck area and sac volume against the truth, artery radius and wall under the neck: exact walls, then scans."""
    print("\n| artery with a sac | voxel, mm | neck area | sac volume | artery radius mean | wall 95 %, mm | max, mm |")
    print("|---|---|---|---|---|---|---|")
    for name, make in GLUED.items():
        phantom = make()
        for voxel_mm in (0.0, *VOXELS_MM):
            anatomy = scanned_anatomy_of(phantom, voxel_mm) if voxel_mm else anatomy_of(phantom)
            radius, wall_mm = relative_errors(anatomy, phantom)
            wall = f"{np.abs(radius).mean():.1%} | {np.quantile(wall_mm, 0.95):.3f} | {wall_mm.max():.3f}"
            (sac,) = anatomy.aneurysms
            neck, volume = sac.neck.area_mm2 / phantom.neck_area_mm2, sac.sac.volume_mm3 / phantom.sac_volume_mm3
            print(f"| {name} | {voxel_mm or 'exact wall'} | {neck - 1:+.1%} | {volume - 1:+.1%} | {wall} |")


def seconds(work: Callable[[], Any]) -> tuple[np.ndarray, Any]:
    """Shortest of three wall times and of three CPU times, after one run that is not counted, and the last result."""
    result, best = work(), np.full(2, np.inf)
    for _ in range(3):
        began, cpu = time.perf_counter(), time.process_time()
        result = work()
        best = np.minimum(best, [time.perf_counter() - began, time.process_time() - cpu])
    return best, result


def speed() -> None:
    """Wall seconds, CPU seconds in brackets; the last column is the power of the triangles that the time grows with."""
    print("\n| triangles | repair, s (CPU) | trace | trim | restore | surface to anatomy | grows as triangles to the |")
    print("|---|---|---|---|---|---|---|")
    before = None
    for edge_mm in SIZES.values():
        surface = phantoms.phantom_surface(phantoms.demo_phantom(), edge_mm=edge_mm)
        times, n = np.array(_stages(surface)), len(surface.faces)
        total = times.sum(axis=0)
        growth = "" if before is None else f"{np.log(total[1] / before[1]) / np.log(n / before[0]):.2f}"
        print(f"| {n} | {' | '.join(f'{wall:.2f} ({cpu:.2f})' for wall, cpu in [*times, total])} | {growth} |")
        before = n, total[1]
    image = large_scan()
    (wall, cpu), vessel = seconds(lambda: segment(image))
    size = " x ".join(map(str, image.voxels.shape))
    print(f"\nimage of {size} voxels to a wall of {len(vessel.lumen.faces)} triangles: {wall:.2f} s ({cpu:.2f})")


def _stages(surface: Surface) -> list[np.ndarray]:
    """Seconds of every stage, each on a surface of which nothing has been computed yet."""

    def fresh(vessel: Vessel) -> Vessel:
        return Vessel(Surface(vessel.lumen.vertices_mm, vessel.lumen.faces), vessel.openings, vessel.centerlines)

    repair_s, (lumen, _) = seconds(lambda: repair(Surface(surface.vertices_mm, surface.faces)))
    trace_s, vessel = seconds(lambda: trace(fresh(Vessel(lumen))))
    trim_s, trimmed = seconds(lambda: trim(vessel))
    restore_s, _ = seconds(lambda: restore(trimmed))
    return [repair_s, trace_s, trim_s, restore_s]


N_PROCESSES = 2
"""Processes in which patients are compared."""
SMALL_MM3, SMALL_OFF_MM3 = 15.0, 3.0
"""The volume of a sac smaller than the first may be off by the second."""


def aneurisk(folder: Path) -> None:
    """Sac and neck of every patient of a folder, found without any help, against the published ones."""
    with ProcessPoolExecutor(N_PROCESSES) as pool:
        rows = list(pool.map(compared, patients(folder)))
    print(
        "\n| patient | | volume, as closed | volume, plane | neck, plane | neck curve, projected | neck surface "
        "| angle, degrees | curve's | middle, neck diameters | curve's | overlap, as closed | plane | own measuring "
        "| CPU, s |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|"
    )
    for row in rows:
        values = [*row.volumes, *row.areas, *np.degrees(row.angle_rad), *row.away, *row.overlap]
        digits = [2] * 5 + [0] * 2 + [2] * 4
        cells = " | ".join(f"{value:.{n}f}" for value, n in zip(values, digits, strict=True))
        own = row.measured_mm3 / row.published[0]
        print(f"| {row.case} | {row.kind} | {row.said or cells} | {own:.3f} | {row.seconds:.1f} |")
    for kind, name in (("LAT", "sidewall"), ("TER", "at forks")):
        some = [row for row in rows if row.kind == kind and not row.said]
        if some:
            _distribution(f"{name} ({len(some)} of {sum(row.kind == kind for row in rows)})", some)
    _goals(rows)


def _distribution(title: str, rows: list[Compared]) -> None:
    """Print the 10 % quantile, the median, the 90 % quantile, bias and spread of every ratio."""
    print(f"\n| {title} | 10 % | median | 90 % | bias | spread (standard deviation) |\n|---|---|---|---|---|---|")
    for name, values in {
        "sac volume, as closed / published": [row.volumes[0] for row in rows],
        "sac volume, by plane / published": [row.volumes[1] for row in rows],
        "neck by plane / published": [row.areas[0] for row in rows],
        "neck curve, projected / published": [row.areas[1] for row in rows],
        "neck surface / published": [row.areas[2] for row in rows],
        "angle of the plane, degrees": np.degrees([row.angle_rad[0] for row in rows]),
        "angle of the neck curve, degrees": np.degrees([row.angle_rad[1] for row in rows]),
        "distance of the middles, plane, neck diameters": [row.away[0] for row in rows],
        "distance of the middles, neck curve, neck diameters": [row.away[1] for row in rows],
        "overlap of the sacs, as closed": [row.overlap[0] for row in rows],
        "overlap of the sacs, by plane": [row.overlap[1] for row in rows],
    }.items():
        low, median, high = np.quantile(values, [0.1, 0.5, 0.9])
        bias = np.mean(values) - (1.0 if "/" in name or "overlap" in name else 0.0)
        print(f"| {name} | {low:.2f} | {median:.2f} | {high:.2f} | {bias:+.2f} | {np.std(values):.2f} |")


def _goals(rows: list[Compared]) -> None:
    """Print how many patients are within each tolerance."""
    found = [row for row in rows if not row.said]
    off = np.array([abs(row.volumes[1] - 1) for row in found])
    small = np.array([row.published[0] < SMALL_MM3 for row in found])
    small &= off * [row.published[0] for row in found] < SMALL_OFF_MM3
    angle = np.degrees([row.angle_rad[0] for row in found])
    print(f"\n| of {len(rows)} patients | |\n|---|---|")
    for name, value in {
        "a sac": len(found),
        "overlap (intersection over union) at least 0.7": sum(row.overlap[0] >= 0.7 for row in found),
        "middle of the neck within half the published diameter": sum(max(row.away) < 0.5 for row in found),
        "volume by plane within 10 % (small sacs: 3 mm3)": ((off < 0.1) | small).sum(),
        "volume by plane within 20 % (small sacs: 3 mm3)": ((off < 0.2) | small).sum(),
        "neck by plane within 20 %": sum(abs(row.areas[0] - 1) < 0.2 for row in found),
        "angle below 30 degrees": (angle < 30).sum(),
        "median angle, degrees": f"{np.median(angle):.0f}",
        "own measuring within 5 %": sum(abs(row.measured_mm3 / row.published[0] - 1) < 0.05 for row in rows),
    }.items():
        print(f"| {name} | {value} |")


if __name__ == "__main__":
    if sys.argv[1:2] == ["aneurisk"]:
        aneurisk(Path(sys.argv[2]))
        sys.exit()
    parts = sys.argv[1:] or ["centerlines", "walls", "sacs", "restored", "references", "speed"]
    for part in parts:
        if part not in ("restored", "references") or DATA.is_dir():
            globals()[part]()
