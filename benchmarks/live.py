"""Measure the live flow: start, answer to a move, and its difference from the default grid, by vessel and device.

Usage: python benchmarks/live.py [--vessel NAME ...] [--device NAME ...] [--outlets WORD] [--longest SECONDS]
                                 [--reference [--grid MM]]

Every device begins with a new live flow; its first number is the first whose band the page shows. Without
`--reference` only the preview is run. With it every flow is also computed on the default grid (minutes each). The last
line gives the largest difference, which `vstent.app.live.ERROR_POINTS` states on the page.

`--switch` measures instead what a user of the page waits for, in a process as the page starts it: the time from the
switch to the first number with a band, with nothing prepared, with the flow without a device prepared, and with that
flow stored in the case folder; and how long the preparation takes and how large the stored flow is.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, sleep

from grades import SPACINGS_MM, anatomy_of

import vstent
from vstent.app.live import ERROR_POINTS, SHOWN_POINTS, BareFlowStore, LiveFlowProcess
from vstent.devices.stent import Landing, Stent
from vstent.flow.indices import indices
from vstent.flow.lattice.live import LiveFlow
from vstent.flow.media import media
from vstent.flow.problem import flow_case
from vstent.flow.settings import FlowSettings, Numerics
from vstent.flow.simulation import simulate_case
from vstent.geometry.vessel import Anatomy

DEVICES = ("silk", "enterprise", "pipeline")
MOVE_MM = 2.0
SLICE_S = 0.15
ASKED_S = 0.22
"""Time between two requests of the page, in s."""
LONGEST_S = 40.0
INFLOW = "neck_inflow_mL_s"
Course = list[tuple[float, float, float]]
"""Seconds, change of the neck inflow in percent, and its uncertainty in points."""


def course(live: LiveFlow, longest_s: float = LONGEST_S) -> Course:
    """Return the course of the change until both flows have settled."""
    began, found = perf_counter(), []
    while perf_counter() - began < longest_s:
        live.advance(SLICE_S)
        found.append((perf_counter() - began, *live.change(INFLOW)))
        if live.read().is_settled and live.bare.is_settled and len(found) > 12:
            break
    return found


def within(found: Course, points: float) -> float:
    """Return the time from which the values stay within so many points of the last one."""
    end = found[-1][1]
    late = [k for k, (_, value, _) in enumerate(found) if abs(value - end) > points]
    return found[late[-1] + 1][0] if late else found[0][0]


def known(found: Course, points: float) -> tuple[float, float]:
    """Return the time from which a number with at most this uncertainty is shown, and the number."""
    return next(((time, value) for time, value, error in found if error < points), (float("nan"), float("nan")))


def outside(found: Course, true: float) -> float:
    """Return the share of numbers with a band that lie further from the true change than their band."""
    shown = [abs(value - true) > error + ERROR_POINTS for _, value, error in found if error < SHOWN_POINTS]
    return sum(shown) / max(len(shown), 1)


def moved(anatomy: Anatomy, stent: Stent) -> Stent:
    """Return the device moved towards the inlet."""
    middle_mm = 0.5 * (stent.proximal_abscissa_mm + stent.distal_abscissa_mm) - MOVE_MM
    return vstent.deploy(stent.design, anatomy, size=stent.size, landing=Landing(middle_mm)).stent


def full(anatomy: Anatomy, stents: dict[str, Stent], settings: FlowSettings) -> dict[str, float]:
    """Return the change of the neck inflow in a full computation in percent, by device."""
    case = flow_case(anatomy, (), settings)
    bare = simulate_case(case)
    before = indices(bare, case.sac, case.ostium)["neck_inflow_mL_s"]
    found = {}
    for name, stent in stents.items():
        one = flow_case(anatomy, (stent,), settings)
        now = indices(simulate_case(one, start=bare), one.sac, one.ostium)["neck_inflow_mL_s"]
        found[name] = 100 * (now / before - 1)
    return found


def numbers(preview: LiveFlowProcess) -> dict:
    """Return the numbers that the page shows."""
    raw = preview.message()
    return json.loads(raw[4 : 4 + int.from_bytes(raw[:4], "little")])


def switched(preview: LiveFlowProcess, stent: Stent) -> tuple[float, float, float]:
    """Return the seconds from the switch to the first number with a band, the number, and its band in points."""
    preview.place((stent,))
    began = perf_counter()
    while perf_counter() - began < LONGEST_S:
        told = numbers(preview)
        if not told["is_stale"] and INFLOW in told["error_points"]:
            return perf_counter() - began, told["reductions"][INFLOW], told["error_points"][INFLOW]
        sleep(ASKED_S)
    return float("nan"), float("nan"), float("nan")


def prepared(preview: LiveFlowProcess) -> float:
    """Return the seconds until nothing is left to prepare."""
    began = perf_counter()
    while preview.is_preparing:
        sleep(0.05)
    return perf_counter() - began


def from_switch(name: str, devices: list[str]) -> None:
    """Print the times from the switch for every device."""
    anatomy, settings = anatomy_of(name), FlowSettings()
    for device in devices:
        stent = vstent.deploy(vstent.find_design(device), anatomy).stent
        found, ready_s = [], []
        with TemporaryDirectory() as folder:
            store = BareFlowStore.of(Path(folder), name, settings)
            for is_prepared in (False, True, True):
                preview = LiveFlowProcess(anatomy, settings, store if is_prepared else None)
                ready_s.append(prepared(preview) if is_prepared else 0.0)
                found.append(switched(preview, stent))
                preview.stop()
            megabytes = sum(path.stat().st_size for path in Path(folder).iterdir()) / 1e6
        times = [f"{seconds:.1f} | {value:.0f} ± {band:.0f} %" for seconds, value, band in found]
        print(
            f"| {name} | {device} | {times[0]} | {ready_s[1]:.0f} | {times[1]} | {ready_s[2]:.1f} | {times[2]} "
            f"| {megabytes:.0f} |",
            flush=True,
        )


def main() -> None:
    """Run the benchmark and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vessel", nargs="*", default=["demo", "aneurisk_C0038.vtp"], choices=list(SPACINGS_MM))
    parser.add_argument("--device", nargs="*", default=list(DEVICES))
    parser.add_argument("--reference", action="store_true")
    parser.add_argument("--outlets", default="zero_pressure", help="boundary condition at the outlets")
    parser.add_argument("--grid", type=float, help="grid spacing of the full computation, mm")
    parser.add_argument("--longest", type=float, default=LONGEST_S, help="seconds that a flow is followed at most")
    parser.add_argument("--switch", action="store_true", help="measure the time from the switch of the page")
    given = parser.parse_args()
    if given.switch:
        print(
            "| vessel | device | nothing prepared, s | number | preparing, s | prepared, s | number | loading, s "
            "| stored, s | number | stored flow, MB |\n" + 11 * "|---" + "|"
        )
        for name in given.vessel:
            from_switch(name, given.device)
        return
    print(
        "| vessel | spacing, mm | cells | lattice, s | device | screen, s | exchange, s | first number, s "
        "| first number | +- 10, s | +- 5, s | end | default grid | outside their band "
        "| after a move: within 3 points, s | within 1 point, s |\n" + 16 * "|---" + "|"
    )
    apart = []
    settings = FlowSettings(outlets=given.outlets)
    finer = replace(settings, numerics=Numerics(cell_size_mm=given.grid))
    for name in given.vessel:
        anatomy = anatomy_of(name)
        stents = {one: vstent.deploy(vstent.find_design(one), anatomy).stent for one in given.device}
        reference = full(anatomy, stents, finer) if given.reference else {}
        for device, stent in stents.items():
            began = perf_counter()
            live = LiveFlow(flow_case(anatomy, (), settings))
            times = [perf_counter()]
            made = media(stent, live.case.blood)
            times.append(perf_counter())
            live.place(made)
            times.append(perf_counter())
            found = [(times[2] - began + seconds, *rest) for seconds, *rest in course(live, given.longest)]
            live.place(media(moved(anatomy, stent), live.case.blood))
            after = course(live, given.longest)
            end, first = found[-1][1], known(found, SHOWN_POINTS)
            whole = f"{reference[device]:.0f} %" if reference else ""
            apart += [abs(end - reference[device])] if reference else []
            print(
                f"| {name} | {live.cell_size_mm:.3f} | {len(live.state.domain.cells)} | {times[0] - began:.1f} "
                f"| {device} | {times[1] - times[0]:.2f} | {times[2] - times[1]:.3f} | {first[0]:.1f} "
                f"| {first[1]:.0f} % | {known(found, 10)[0]:.1f} | {known(found, 5)[0]:.1f} | {end:.0f} % | {whole} "
                f"| {outside(found, end):.0%} | {within(after, 3):.1f} | {within(after, 1):.1f} |",
                flush=True,
            )
    if apart:
        print(f"\nLargest difference from the default grid: {max(apart):.0f} points")


if __name__ == "__main__":
    main()
