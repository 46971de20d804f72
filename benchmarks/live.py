"""Measure the live flow: start, answer to a move, and its difference from the default grid, by vessel and device.

Usage: python benchmarks/live.py [--vessel NAME ...] [--device NAME ...] [--reference]

Without `--reference` only the preview is run. With it every flow is also computed on the default grid (minutes each).
The last line gives the largest difference, which `vstent.app.preview.ERROR_POINTS` states on the page.
"""

import argparse
from time import perf_counter

from grades import SPACINGS_MM, anatomy_of

import vstent
from vstent.devices.stent import Landing, Stent
from vstent.flow.case import FlowSettings
from vstent.flow.indices import indices
from vstent.flow.lattice.live import LiveFlow, Reading
from vstent.flow.screen import screen
from vstent.flow.simulation import flow_case, simulate_case
from vstent.geometry.vessel import Anatomy

DEVICES = ("silk", "enterprise", "pipeline")
MOVE_MM = 2.0
SLICE_S = 0.25
LONGEST_S = 40.0


def reduction(now: Reading, bare: Reading) -> float:
    """Return the change of the neck inflow in percent."""
    return 100 * (now.neck_inflow_mL_s / bare.neck_inflow_mL_s - 1)


def course(live: LiveFlow) -> list[tuple[float, float]]:
    """Return (seconds, change of the neck inflow in percent) until the flow has settled."""
    began, found = perf_counter(), []
    while perf_counter() - began < LONGEST_S:
        live.advance(SLICE_S)
        now = live.read()
        found.append((perf_counter() - began, reduction(now, live.bare)))
        if now.is_settled and len(found) > 12:
            break
    return found


def within(found: list[tuple[float, float]], points: float) -> float:
    """Return the time from which the values stay within so many points of the last one."""
    end = found[-1][1]
    late = [k for k, (_, value) in enumerate(found) if abs(value - end) > points]
    return found[late[-1] + 1][0] if late else found[0][0]


def moved(anatomy: Anatomy, stent: Stent) -> Stent:
    """Return the device moved towards the inlet."""
    middle_mm = 0.5 * (stent.proximal_abscissa_mm + stent.distal_abscissa_mm) - MOVE_MM
    return vstent.deploy(stent.design, anatomy, size=stent.size, landing=Landing(middle_mm)).stent


def full(anatomy: Anatomy, stents: dict[str, Stent]) -> dict[str, float]:
    """Return the change of the neck inflow on the default grid in percent, by device."""
    case = flow_case(anatomy, None, FlowSettings())
    bare = simulate_case(case)
    before = indices(bare, case.sac, case.ostium)["neck_inflow_mL_s"]
    found = {}
    for name, stent in stents.items():
        one = flow_case(anatomy, stent, FlowSettings())
        now = indices(simulate_case(one, start=bare), one.sac, one.ostium)["neck_inflow_mL_s"]
        found[name] = 100 * (now / before - 1)
    return found


def main() -> None:
    """Run the benchmark and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vessel", nargs="*", default=["demo", "aneurisk_C0038.vtp"], choices=list(SPACINGS_MM))
    parser.add_argument("--device", nargs="*", default=list(DEVICES))
    parser.add_argument("--reference", action="store_true")
    given = parser.parse_args()
    print(
        "| vessel | spacing, mm | cells | start, s | device | screen, s | exchange, s | preview | default grid "
        "| after a move: within 3 points, s | within 1 point, s |\n" + 11 * "|---" + "|"
    )
    apart = []
    for name in given.vessel:
        anatomy = anatomy_of(name)
        stents = {one: vstent.deploy(vstent.find_design(one), anatomy).stent for one in given.device}
        reference = full(anatomy, stents) if given.reference else {}
        began = perf_counter()
        live = LiveFlow(flow_case(anatomy, None, FlowSettings()))
        start_s = perf_counter() - began
        for device, stent in stents.items():
            times = [perf_counter()]
            made = screen(stent, live.case.blood)
            times.append(perf_counter())
            live.place(made)
            times.append(perf_counter())
            end = course(live)[-1][1]
            live.place(screen(moved(anatomy, stent), live.case.blood))
            after = course(live)
            whole = f"{reference[device]:.0f} %" if reference else ""
            apart += [abs(end - reference[device])] if reference else []
            print(
                f"| {name} | {live.cell_size_mm:.3f} | {len(live.state.domain.cells)} | {start_s:.1f} | {device} "
                f"| {times[1] - times[0]:.2f} | {times[2] - times[1]:.3f} | {end:.0f} % | {whole} "
                f"| {within(after, 3):.1f} | {within(after, 1):.1f} |",
                flush=True,
            )
    if apart:
        print(f"\nLargest difference from the default grid: {max(apart):.0f} points")


if __name__ == "__main__":
    main()
