"""Print how long it takes to rank every size of three devices in a real artery (C0038; without it, the demo's).

Run from the repository: ``python benchmarks/rank.py [JOBS]`` (2).
"""

import sys
import time
from pathlib import Path

from vstent import phantoms
from vstent.anatomy.repair import repair
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.devices.catalogue import find_design
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.io.surfaces import read_surface
from vstent.plan.rank import rank

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "aneurisk_C0038.vtp"
DEVICES = ("silk", "pipeline", "enterprise")


def anatomy() -> Anatomy:
    """Restore the artery."""
    surface = read_surface(DATA)[0] if DATA.exists() else phantoms.phantom_surface(phantoms.demo_phantom())
    return restore(trim(trace(Vessel(repair(surface)[0]))))


def ranked(jobs: int) -> None:
    artery, designs = anatomy(), [find_design(name) for name in DEVICES]
    began = time.perf_counter()
    ranking = rank(artery, designs, jobs=jobs)
    seconds = time.perf_counter() - began
    print("| case | sizes | suitable | jobs | wall, s |")
    print("|---|---|---|---|---|")
    name = "C0038" if DATA.exists() else "demo"
    print(f"| {name} | {len(ranking.candidates)} | {len(ranking.suitable)} | {jobs} | {seconds:.1f} |")
    for number, candidate in enumerate(ranking.candidates[:10], start=1):
        print(f"{number:2} {candidate.label:26} {candidate.score:.2f} {candidate.reason}")


if __name__ == "__main__":
    ranked(int(sys.argv[1]) if len(sys.argv) > 1 else 2)
