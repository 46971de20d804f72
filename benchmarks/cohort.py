"""Print what a cohort of phantoms costs: varied arteries, sacs and bends, two devices each, without flow.

Run from the repository: ``python benchmarks/cohort.py [CASES] [JOBS]`` (20 and 2; ``200 2`` is the full one). The
phantoms and the cohort's table are kept in ``cohort-of-phantoms`` in the temporary folder: run again, it does what is
missing. Where Dask is installed the cohort is then done a second time by a local cluster, of whose workers one is
killed midway, and the two tables are compared.
"""

import importlib.util
import os
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.random import Generator

from vstent import phantoms
from vstent.cli import main
from vstent.cohort.batch import COST, Row, collect, left_to_do, run_cohort
from vstent.cohort.cases import Case, find_cases
from vstent.io.writers import write_stl
from vstent.phantoms import Phantom
from vstent.study.workers import DaskCluster

SEED = 7
EDGE_MM = 0.3
DEVICES = ("silk", "enterprise")


def artery(random: Generator) -> Phantom:
    """A siphon, an arc or a tapered tube, 3 to 4.6 mm wide."""
    radius_mm = random.uniform(1.5, 2.3)
    end_mm = radius_mm * random.uniform(0.85, 1.0)
    kind = random.integers(3)
    if kind == 0:
        return phantoms.siphon(inlet_radius_mm=min(radius_mm, 2.1), outlet_radius_mm=min(end_mm, 2.0))
    if kind == 1:
        bend_mm = random.uniform(8.0, 16.0)
        return phantoms.torus_arc(bend_radius_mm=bend_mm, angle_rad=min(38.0 / bend_mm, 3.6), radius_mm=radius_mm)
    return phantoms.tube(length_mm=40.0, radius_mm=radius_mm, end_radius_mm=end_mm)


def case(number: int) -> Phantom:
    """One case: an artery, a sac on it, now and then a side branch."""
    random = np.random.default_rng((SEED, number))
    parent = artery(random)
    middle_mm = parent.parent.length_mm * random.uniform(0.42, 0.58)
    if random.random() < 0.3:
        side = middle_mm + random.choice([-9.0, 9.0])
        parent = phantoms.with_branch(parent, abscissa_mm=side, direction=random.normal(size=3), radius_mm=0.6)
    width_mm = random.uniform(3.5, 9.0)
    neck_mm = min(random.uniform(0.5, 0.8) * width_mm, 6.0)
    return phantoms.with_sac(
        parent, abscissa_mm=middle_mm, width_mm=width_mm, neck_mm=neck_mm, elongation=random.uniform(0.8, 1.5)
    )


def cohort(count: int, jobs: int) -> None:
    folder = Path(tempfile.gettempdir()) / "cohort-of-phantoms"
    for number in range(count):
        path = folder / f"scans-{count}" / f"{number:03}.stl"
        if not path.exists():
            write_stl(path, phantoms.phantom_surface(case(number), edge_mm=EDGE_MM))
    out, began = folder / f"out-{count}", time.perf_counter()
    devices = [word for device in DEVICES for word in ("--device", device)]
    words = [str(folder / f"scans-{count}"), "--out", str(out), "--no-flow", "--units", "mm", "--jobs", str(jobs)]
    main(["batch", *words, *devices])
    given = {"device": DEVICES, "no-flow": True, "units": "mm"}
    cases = find_cases(folder / f"scans-{count}", given)
    rows = collect(cases, out)
    print("| cases | by | rows done | rows failed | wall, s | CPU s a case | most | memory, MB |")
    print("|---|---|---|---|---|---|---|---|")
    tell(f"{jobs} processes", rows, time.perf_counter() - began)
    if importlib.util.find_spec("distributed"):
        began, other = time.perf_counter(), by_dask(cases, folder / f"out-{count}-dask", jobs)
        tell(f"Dask, {jobs} workers, one killed", other, time.perf_counter() - began)
        print("The two tables are", "the same." if bare(other) == bare(rows) else "NOT the same.")
    for row in rows:
        if row["outcome"] != "done":
            print(f"{row['case']} {row['treatment']} {row['outcome']} {row['stage']}: {row['sentence']}")


def tell(by: str, rows: Sequence[Row], wall_s: float) -> None:
    done = sum(row["outcome"] == "done" for row in rows)
    cpu_s = [row["case_cpu_s"] for row in rows[:: len(DEVICES)]]
    peak = max(row["peak_memory_MB"] for row in rows)
    figures = f"{done} | {len(rows) - done} | {wall_s:.0f} | {np.mean(cpu_s):.1f} | {max(cpu_s):.1f} | {peak:.0f}"
    print(f"| {len(rows) // len(DEVICES)} | {by} | {figures} |", flush=True)


def by_dask(cases: Sequence[Case], out: Path, jobs: int) -> list[Row]:
    """Let a local cluster do the cohort, and kill the worker that has begun first when half of it is done."""
    from distributed import LocalCluster

    tasks = left_to_do(cases, out)
    with LocalCluster(n_workers=jobs, threads_per_worker=1, dashboard_address=None) as cluster:

        def told(done: int, total: int, _name: str, _rows: Sequence[Row]) -> None:
            if done == total // 2:
                os.kill(cluster.workers[0].pid, signal.SIGKILL)

        run_cohort(tasks, out, DaskCluster(cluster.scheduler_address), told)
    return collect(cases, out)


def bare(rows: Sequence[Row]) -> list[Row]:
    return [{key: value for key, value in row.items() if key not in COST} for row in rows]


if __name__ == "__main__":
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
    numbers = [int(word) for word in sys.argv[1:]]
    cohort(*(numbers + [20, 2][len(numbers) :]))
