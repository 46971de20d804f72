"""Data classes of what is planned for a patient: `Placing`, `Implant` and `Treatment`."""

import re
from dataclasses import MISSING, dataclass, replace
from typing import Final, Literal, get_args

from vstent.errors import InputError
from vstent.fields import LENGTH, POSITION, setting
from vstent.units import MM_PER

Anchor = Literal["center", "distal", "proximal"]
"""Point of a device that is placed at the landing position."""
ANCHORS: Final[tuple[str, ...]] = get_args(Anchor)
"""All values of `Anchor`."""
BARE: Final = "bare"
"""Name of the treatment without an implant."""
NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,59}")
"""Form of the names of treatments and implants, which name folders."""

STRAIGHTENINGS: Final = ("immediate", "six_months")
"""Times after a treatment for which it is known how much devices straighten arteries."""

_NUMBER: Final = r"\d+(?:\.\d*)?"
"""Form of a number without a sign."""
ARM_TO_ARM: Final = ">"
"""Sign in the name of a path between its two ends, where it does not begin at the inlet."""
FORK: Final = "fork"
"""Shift of an implant that begins where its path has left the implants before it."""
NESTED: Final = "+"
"""Sign between implants of a treatment, each inside those before it."""
SIDE_BY_SIDE: Final = "|"
"""Sign between implants of a treatment that lie side by side."""
AS_IF_ALONE: Final = "&"
"""Sign between implants of a treatment that are deployed as if each were alone."""
_COIL: Final = rf"{_NUMBER}\s*(?:mm)?\s*x\s*{_NUMBER}\s*(?:cm|mm)"
"""Form of the size of one coil: loops in mm x length in cm or mm."""
_FILLING: Final = rf"\(\s*(?:({_NUMBER})\s*%|({_COIL}(?:\s*,\s*{_COIL})*))(?:\s*,\s*seed\s+(\d+))?\s*\)"
"""Form of the packing density of coils or of their sizes, with a seed."""
IMPLANT: Final = re.compile(
    rf"([\w-]+)(?:\s*{_FILLING})?(?:\s+({_NUMBER})\s*x\s*({_NUMBER}))?(?:\s*((?:(?<=\s)\w+\s*)?>\s*\w+))?"
    rf"(?:\s*@\s*([+-]?{_NUMBER}|{FORK}))?"
)
"""Form of an implant in the text of a treatment: device, coils, diameter x length, > path, @ shift or fork."""


def read_straightening(text: str) -> str:
    """Return how much an artery yields; InputError where it is neither named nor a measured angle or radius."""
    if text in ("off", *STRAIGHTENINGS) or re.fullmatch(rf"{_NUMBER}(?:deg|mm)", text):
        return text
    ways = ", ".join(("off", *STRAIGHTENINGS))
    raise InputError(f"{text!r} is not {ways}, an angle such as 12deg or a radius such as 10.7mm")


@dataclass(frozen=True)
class Placing:
    """Where an implant is placed; missing values are proposed."""

    path: str = "parent"
    """Name of the path; see `vstent.anatomy.restore.paths`."""
    position_mm: float | None = setting(
        None,
        "center",
        "position of the middle of every --device along the parent artery",
        limits=POSITION,
        usual="proposed",
    )
    """Position of the anchor along the path, in mm."""
    anchor: Anchor = "center"
    """Point of the implant that lies there."""
    shift_mm: float = 0.0
    """Distance from the proposed position, in mm, positive distally; 0 where a position is given."""
    at_fork: bool = False
    """Whether its proximal end lies where its path has left the implants that are there before."""
    beside: tuple[str, ...] = ()
    """Paths of implants side by side with it, by name; each has its share of the artery."""


@dataclass(frozen=True)
class Implant:
    """One device of a treatment, with its size and placing; missing values are proposed."""

    id: str
    """Name within the treatment."""
    device: str = setting(
        MISSING,
        "device",
        "device of the catalogue",
        str,
        usual="silk and enterprise; none for `vstent flow` and `vstent export`",
        metavar="NAME",
        separators=";, ",
    )
    """Key of the design in the catalogue."""
    diameter_mm: float | None = setting(
        None, "diameter", "label diameter of every --device", limits=LENGTH, usual="proposed"
    )
    """Label diameter in mm."""
    length_mm: float | None = setting(None, "length", "label length of every --device", limits=LENGTH, usual="proposed")
    """Label length in mm."""
    placing: Placing = Placing()
    """Where it is placed."""
    inside: tuple[str, ...] = ()
    """Implants that are there before it, by id, in the order of their deployment; it opens inside them."""
    density_fraction: float | None = None
    """Packing density of coils; None: as proposed, or that of the given coils."""
    coils: tuple[tuple[float, float], ...] = ()
    """Loops and length of every coil in mm, in their order; none: they are proposed."""
    seed: int = 0
    """Number from which the random choices of coils are drawn."""

    def __post_init__(self) -> None:
        _check_name("implant", self.id)

    @property
    def is_proposed(self) -> bool:
        """Whether size, place and packing density are left to vstent."""
        return self == self.unplaced

    @property
    def unplaced(self) -> "Implant":
        """The same implant, with size, place and packing density left to vstent."""
        placing = Placing(self.placing.path, beside=self.placing.beside)
        return Implant(self.id, self.device, placing=placing, inside=self.inside)


@dataclass(frozen=True)
class Treatment:
    """Implants in the order of their deployment."""

    name: str
    """Short name, unique among the treatments of a study."""
    implants: tuple[Implant, ...] = ()
    """The implants; none in the bare artery."""
    has_flow: bool = True
    """Whether its flow is computed where the study computes flows."""

    def __post_init__(self) -> None:
        _check_name("treatment", self.name)
        if self.name.casefold() == BARE and self.implants:
            raise InputError(f"The treatment {BARE!r} is the artery without an implant: choose another name.")
        known: list[str] = []
        for implant in self.implants:
            if implant.id in known:
                raise InputError(f"The treatment {self.name} has two implants called {implant.id}: rename one.")
            missing = [name for name in implant.inside if name not in known]
            if missing:
                raise InputError(
                    f"In the treatment {self.name}, {implant.id} is inside {missing[0]}, which is not deployed before "
                    "it: change the order."
                )
            known.append(implant.id)

    @property
    def devices(self) -> tuple[str, ...]:
        """Keys of the devices of the implants."""
        return tuple(implant.device for implant in self.implants)

    @property
    def plan(self) -> tuple[Implant, ...]:
        """Its implants with sizes, places and packing densities left to vstent."""
        return tuple(implant.unplaced for implant in self.implants)

    @property
    def is_proposed(self) -> bool:
        """Whether sizes, places and packing densities of all implants are left to vstent."""
        return self.implants == self.plan


def with_device(
    device: str, *, diameter_mm: float | None = None, length_mm: float | None = None, center_mm: float | None = None
) -> Treatment:
    """Return the treatment with one device in the parent artery; missing values are proposed.

    The treatment and its implant have the name of the device; `center_mm` is the position of its middle.
    """
    return Treatment(device, (Implant(device, device, diameter_mm, length_mm, Placing(position_mm=center_mm)),))


def read_treatment(text: str) -> Treatment:
    """Return a treatment read from text.

    Parameters
    ----------
    text : devices in the order of their deployment, joined by ``+``, such as ``silk 4x20 + silk@-4``: each opens inside
        those before it. After a device may stand its label diameter and length in mm, its path, such as
        ``> outlet_2`` from the inlet or ``outlet_1 > outlet_2`` from one arm of a fork to the other, and after ``@`` a
        shift of the proposed place in mm, positive distally, or ``fork``: it begins where its path has left the devices
        before it. Devices joined by ``|`` lie side by side; those joined by ``&`` are deployed as if each were alone.
        After coils may stand their packing density, or the loops and lengths of all of them, and a seed:
        ``coils(25%, seed 3)``, ``target(6 mm x 20 cm, 3 mm x 8 cm)``. ``NAME=`` before them names the
        treatment; otherwise its name is made of its devices and paths.

    Raises
    ------
    InputError
        The text has another form.
    """
    given, equals, devices = text.rpartition("=")
    signs = {sign for sign in (NESTED, SIDE_BY_SIDE, AS_IF_ALONE) if sign in devices}
    if len(signs) > 1:
        raise InputError(f"{text.strip()!r} joins devices in two ways: use only one of +, | and &")
    sign = signs.pop() if signs else NESTED
    implants: list[Implant] = []
    for part in devices.split(sign):
        found = IMPLANT.fullmatch(part.strip())
        if not part.strip():
            where = f"before or after {sign}" if sign in devices else "after ="
            raise InputError(f"{text.strip()!r} lacks a device {where}: name it, or leave out the sign")
        if not found:
            raise InputError(
                f"{part.strip()!r} is not an implant: write a device, its size, its path and its shift such as "
                "'silk 4x20 > outlet_2 @-4', or coils with their packing density or their sizes such as "
                "'coils(25%, seed 3)' and 'target(6 mm x 20 cm, 3 mm x 8 cm)'"
            )
        device, density, sizes, seed, diameter, length, path, shift = found.groups()
        device, path = device.lower(), re.sub(r"\s", "", path or "").removeprefix(ARM_TO_ARM)
        first = "_".join([device, *path.split(ARM_TO_ARM)]) if path else device
        ids = (first, *(f"{first}_{number}" for number in range(2, len(implants) + 2)))
        implants.append(
            Implant(
                next(name for name in ids if name not in {one.id for one in implants}),
                device,
                float(diameter) if diameter else None,
                float(length) if length else None,
                Placing(
                    path or Placing.path, shift_mm=0.0 if shift in (None, FORK) else float(shift), at_fork=shift == FORK
                ),
                tuple(one.id for one in implants) if sign == NESTED else (),
                float(density) / 100 if density else None,
                tuple(
                    (float(loops), float(length) * MM_PER[unit])
                    for loops, length, unit in re.findall(rf"({_NUMBER})[\sm]*x\s*({_NUMBER})\s*(\w+)", sizes or "")
                ),
                int(seed or 0),
            )
        )
    if sign == SIDE_BY_SIDE:
        paths = [one.placing.path for one in implants]
        if len(set(paths)) < len(paths):
            raise InputError(f"{text.strip()!r} places two devices of one path side by side: give each its path (>)")
        implants = [
            replace(one, placing=replace(one.placing, beside=tuple(path for path in paths if path != one.placing.path)))
            for one in implants
        ]
    joined = {NESTED: "+", SIDE_BY_SIDE: "_beside_", AS_IF_ALONE: "_over_"}[sign]
    name = given.strip() if equals else joined.join(one.id for one in implants)
    return Treatment(name, tuple(implants))


def _check_name(what: str, name: str) -> None:
    """Raise InputError where a name cannot be that of a folder."""
    if not NAME.fullmatch(name):
        raise InputError(f"{name!r} is not a name of {what}s: use up to 60 letters, digits, and . _ + -")
