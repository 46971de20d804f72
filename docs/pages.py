"""Generate pages of the reference: devices, options, metrics, errors, and recorded measurements."""

import argparse
import contextlib
import io
import os
import re
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

GENERATED = Path(__file__).parent / "generated"


def setup(app: Any) -> dict[str, bool]:
    """Make the pages before Sphinx looks for them."""
    app.connect("config-inited", lambda *_: write())
    return {"parallel_read_safe": True}


def write() -> None:
    """Write all pages."""
    GENERATED.mkdir(exist_ok=True)
    pages = {"devices": devices(), "faults": faults(), "options": options(), "metrics": metrics()}
    for name, text in (pages | {kind: recorded(kind) for kind in ("validation", "performance")}).items():
        (GENERATED / f"{name}.inc").write_text(text, encoding="utf-8")


def recorded(kind: str) -> str:
    """Return the sections that `tools/record.py` has kept of this kind."""
    sections = sorted((GENERATED.parent / "recorded" / kind).glob("*.rst"))
    return "\n\n".join(section.read_text(encoding="utf-8") for section in sections)


def table(titles: list[str], rows: list[list[str]], widths: str = "auto") -> str:
    """Return a list-table."""
    lines = [".. list-table::", "   :header-rows: 1", f"   :widths: {widths}", ""]
    for row in [titles, *rows]:
        lines += [f"   {'*' if k == 0 else ' '} - {cell}" for k, cell in enumerate(row)]
    return "\n".join([*lines, "", ""])


def devices() -> str:
    """Return one section a device: drawing, every number with its source and confidence; and a count of these."""
    from vstent.devices.catalogue import baskets, catalogue
    from vstent.devices.design import Basket, Braid, Coil

    designs = catalogue() | baskets()
    sure = Counter(fact.confidence for design in designs.values() for fact in design.facts)
    total = sum(sure.values())
    text = [f"The catalogue has {len(designs)} devices and {total} sourced entries: "]
    text.append(", ".join(f"{n} {kind}" for kind, n in sorted(sure.items())) + ".\n\n")
    for design in designs.values():
        text.append(f"{design.name}\n{'-' * len(design.name)}\n\n")
        kind = design.kind.replace("_", "-")
        match design:
            case Coil():
                wires = f"wire of {design.stock_wire_um:g} um wound to {design.wound_diameter_um:g} um"
            case Braid():
                wires = " and ".join(f"{count} wires of {diameter:g} um" for count, diameter in design.wires)
                wires += f", {design.angle_rad:.3f} rad to the axis"
            case _:
                wires = f"{design.n_columns} struts round, {design.strut_width_um:g} um wide"
                wires += f", {design.angle_rad:.3f} rad to the axis"
        text.append(f"``{design.key}``, {design.maker}: {kind}, {wires}; ")
        text.append(f"{len(design.sizes)} sizes, {_range(design.sizes)}.{_structure(design)}\n\n")
        if not isinstance(design, Basket | Coil):
            text.append(_drawing(design))
        rows = [[f"``{fact.name}``", fact.confidence, _escaped(fact.source)] for fact in design.facts]
        text.append(table(["number", "confidence", "source"], rows, "20 15 65"))
        rows = [
            [f"``{one.name}``", f"{one.value:g}", f"{one.low:g} to {one.high:g}", one.confidence, _escaped(one.reason)]
            for one in design.ranges
        ]
        text.append(table(["number", "value", "range", "confidence", "reason for the range"], rows, "20 10 15 10 45"))
    return "".join(text)


def _drawing(design: Any) -> str:
    """Draw a device and return the figure."""
    size = _middle_size(design)
    draw_device(design, size, GENERATED / f"device_{design.key}.png")
    return (
        f".. figure:: ../generated/device_{design.key}.png\n   :width: 100%\n\n"
        f"   {design.name} {size.label}, outside an artery and in an artery of {_artery_mm(design, size):.2f} mm. "
        "Both drawings have one scale; wires and struts have their own width.\n\n"
    )


def _structure(design: Any) -> str:
    """Return a sentence on what a device has beside a plain mesh or closed cells, or an empty string."""
    from vstent.devices.design import Braid

    parts = []
    if isinstance(design, Braid):
        for strands in design.strands:
            what = "outer layer" if strands.place == "outside" else "strands beside its wires"
            beyond = f", {strands.beyond_mm:g} mm longer at each end" if strands.beyond_mm else ""
            parts.append(f"{what} of {strands.count} wires of {strands.diameter_um:g} um{beyond}")
        parts += ["wires that turn back at both ends"] if design.has_closed_ends else []
    elif design.joined_crowns:
        parts.append(f"open cells, {design.joined_fraction:.0%} of the crowns joined")
    parts += ["flared ends"] if any(size.free_profile_mm for size in design.sizes) else []
    return f" Structure: {'; '.join(parts)}." if parts else ""


def _middle_size(design: Any) -> Any:
    """Return a size in the middle of a device's diameters, about 20 mm long."""
    diameters = sorted({size.diameter_mm for size in design.sizes})
    middle = diameters[len(diameters) // 2]
    return min((one for one in design.sizes if one.diameter_mm == middle), key=lambda one: abs(one.length_mm - 20))


def _artery_mm(design: Any, size: Any) -> float:
    """Return the diameter of the artery in which a device is drawn: 15 % below its label, in mm."""
    return 0.85 * size.diameter_mm + 2e-3 * design.wall_offset_um


def draw_device(design: Any, size: Any, path: Path) -> None:
    """Draw a device at its free diameter and in an artery, from the wires that `sketch` lays in a straight tube."""
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure
    from tubes import line, tube

    from vstent.deployment.sketch import measured_wall, sketch
    from vstent.devices.stent import Landing

    wide = 1.4 * max([size.free_diameter_mm, *(diameter for _, diameter in size.free_profile_mm)])
    figure = Figure(figsize=(9, 2.6))
    axes = figure.subplots(2, 1, sharex=True, sharey=True)
    for axis, diameter_mm in zip(axes, (wide, _artery_mm(design, size)), strict=True):
        stent = sketch(measured_wall(design, size, tube(line(100), 0.5 * diameter_mm)), Landing(50.0)).stent
        here = stent.piece_starts
        ends = np.stack([stent.wire_points_mm[here], stent.wire_points_mm[here + 1]], axis=1)
        width = stent.wire_diameter_um[stent.point_wires[here]] * 1e-3 * 72 * 9 * 0.95 / 50  # mm to points
        is_front = ends[:, 0, 1] < 0
        for side, color in ((~is_front, "#c3ccd4"), (is_front, "#22384d")):
            axis.add_collection(
                LineCollection(ends[side][:, :, [2, 0]] - [50, 0], linewidths=width[side], colors=color)
            )
        axis.set(xlim=(-25, 25), ylim=(-0.55 * wide / 1.4, 0.55 * wide / 1.4), aspect="equal")
        axis.set_axis_off()
    figure.tight_layout(pad=0.1)
    figure.savefig(path, dpi=110)


def options() -> str:
    """Return one section a command with its help, as the program prints it."""
    from vstent.cli import _parser

    text = []
    for name, command in _commands(_parser(), ""):
        text.append(f"vstent {name}\n{'-' * (7 + len(name))}\n\n.. code-block:: text\n\n")
        text += [f"   {line}".rstrip() + "\n" for line in command.format_help().splitlines()]
        text.append("\n")
    return "".join(text)


def _commands(parser: Any, before: str) -> Iterator[tuple[str, Any]]:
    """Yield every command below a parser with its name, commands of commands included."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, command in action.choices.items():
                yield f"{before}{name}", command
                yield from _commands(command, f"{before}{name} ")


def metrics() -> str:
    """Return a table of every metric: key, name, definition, source."""
    from vstent.reporting.definitions import DEFINITIONS

    rows = [
        [f"``{key}``", _escaped(one.name), _escaped(one.meaning), _escaped(one.source) or "definition"]
        for key, one in DEFINITIONS.items()
    ]
    return table(["key", "name", "definition", "source"], rows, "28 17 38 17")


def _range(sizes: Any) -> str:
    diameters = [size.diameter_mm for size in sizes]
    lengths = [size.length_mm for size in sizes]
    return f"{min(diameters):g} to {max(diameters):g} mm wide, {min(lengths):g} to {max(lengths):g} mm long"


def faults() -> str:
    """Play every fault that is quick and say what came of it; of the others, what the tests want."""
    from faults import FAULTS, play

    text = [f"{len(FAULTS)} faults, played when this page was built.\n\n"]
    for group in dict.fromkeys(fault.group for fault in FAULTS):
        title = group[0].upper() + group[1:]
        text.append(f"{title}\n{'-' * len(title)}\n\n")
        rows = []
        for fault in (fault for fault in FAULTS if fault.group == group):
            if fault.is_heavy:
                rows.append([fault.name, str(fault.code), f"(played by ``make validation``) ... {fault.said}"])
                continue
            with tempfile.TemporaryDirectory(prefix="fault-") as folder, _without(folder):
                outcome = play(fault, Path(folder))
                sentence = outcome.sentence.replace(os.path.realpath(folder), "").replace(folder, "")
            if outcome.code != fault.code:
                raise RuntimeError(f"{fault.name} ended with {outcome.code}: {outcome.told}")
            rows.append(
                [_escaped(fault.name), str(outcome.code), _escaped(_answer(outcome.code, sentence, fault.said))]
            )
        text.append(table(["fault", "exit code", "answer"], rows, "30 10 60"))
    return "".join(text)


@contextlib.contextmanager
def _without(folder: str) -> Any:
    """Keep the user's own devices out, and what a command prints."""
    before = os.environ.get("XDG_CONFIG_HOME")
    os.environ["XDG_CONFIG_HOME"] = folder
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            yield
    finally:
        os.environ.pop("XDG_CONFIG_HOME")
        if before is not None:
            os.environ["XDG_CONFIG_HOME"] = before


def _answer(code: int, sentence: str, said: str) -> str:
    if code == 0:
        notes = re.split(r"(?<=\.)\s+", " ".join(sentence.split()))
        return "Done. " + " ".join(note for note in notes if said and said in note)
    return sentence.removeprefix("vstent: ").partition(": error: ")[2] or sentence.removeprefix("vstent: ")


def _escaped(text: str) -> str:
    return re.sub(r"([\\*`|_])", r"\\\1", text)
