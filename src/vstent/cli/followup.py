"""`vstent compare-followup`: the artery after a treatment beside what was planned."""

import argparse
import json
from pathlib import Path

from vstent.cli import options


def add(commands: options.Commands) -> None:
    """Add the command."""
    text = (
        "Compare a case with a scan or surface after the treatment: straightening and, where metal is seen, the device."
    )
    parser = options.add_command(commands, "compare-followup", text, "compare-followup case after/ --metal 2500")
    parser.add_argument("case", type=Path, help="case folder of `vstent run`")
    parser.add_argument("followup", type=Path, help="scan or surface of the artery after the treatment")
    parser.add_argument("--treatment", metavar="NAME", help="treatment that was carried out (default: the first)")
    text = "intensity from which voxels of the scan are metal (default: the device is not measured)"
    parser.add_argument("--metal", type=float, metavar="T", help=text)
    parser.set_defaults(command=_compare)


def _compare(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from vstent.cli.console import Console, followup_table
    from vstent.errors import InputError
    from vstent.io import writers
    from vstent.reporting.followup import draw_followup
    from vstent.study.contrast import stents_of
    from vstent.study.folder import METRICS
    from vstent.study.followup import compare_followup
    from vstent.study.repeat import finished_run

    out, console = arguments.case, Console()
    names = [one.name for one in finished_run(out)[1].treatments]
    name = arguments.treatment or names[0]
    if name not in names:
        raise InputError(f"{out} has no treatment {name!r}: choose one of {', '.join(names)}.")
    anatomy, stents = stents_of(out, [name])
    devices = [one for one in stents[name] if one.design.kind in ("braid", "laser_cut")]
    if not devices:
        raise InputError(f"{name} has no device in the artery: only these are compared.")
    predicted = json.loads((out / METRICS).read_text(encoding="utf-8"))["treatments"][name].get("straightening", {})
    found = compare_followup(anatomy, devices[0], arguments.followup, arguments.metal, predicted)
    writers.write_json(out / "followup.json", found.metrics())
    draw_followup(out / "followup.png", anatomy, found)
    console.print(followup_table(found))
    console.print(
        f"Registered beside the device with a residual of {found.pose.residual_mm:.2f} mm. See {out / 'followup.png'}."
    )
    return 0
