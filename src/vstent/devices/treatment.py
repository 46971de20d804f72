"""Data classes of what is planned for a patient: `Placing`, `Implant` and `Treatment`."""

import re
from dataclasses import MISSING, dataclass
from typing import Final, Literal, get_args

from vstent.errors import InputError
from vstent.fields import LENGTH, POSITION, setting

Anchor = Literal["center", "distal", "proximal"]
"""Point of a device that is placed at the landing position."""
ANCHORS: Final[tuple[str, ...]] = get_args(Anchor)
"""All values of `Anchor`."""
BARE: Final = "bare"
"""Name of the treatment without an implant."""
NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,59}")
"""Form of the names of treatments and implants, which name folders."""

_NUMBER: Final = r"\d+(?:\.\d*)?"
"""Form of a number without a sign."""
IMPLANT: Final = re.compile(rf"([\w-]+)(?:\s+({_NUMBER})\s*x\s*({_NUMBER}))?(?:\s*@\s*([+-]?{_NUMBER}))?")
"""Form of an implant in the text of a treatment: device, label diameter x length in mm, @ shift in mm."""


@dataclass(frozen=True)
class Placing:
    """Where an implant is placed; missing values are proposed."""

    path: str = "parent"
    """Name of the path in `Anatomy.paths`."""
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
        usual="silk and enterprise",
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

    def __post_init__(self) -> None:
        _check_name("implant", self.id)

    @property
    def is_proposed(self) -> bool:
        """Whether size and place are left to vstent."""
        return self.diameter_mm is None and self.length_mm is None and self.placing == Placing(self.placing.path)


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
    def is_proposed(self) -> bool:
        """Whether sizes and places of all implants are left to vstent."""
        return all(implant.is_proposed for implant in self.implants)


def with_device(
    device: str, *, diameter_mm: float | None = None, length_mm: float | None = None, center_mm: float | None = None
) -> Treatment:
    """Return the treatment with one device in the parent artery; missing values are proposed.

    The treatment and its implant have the name of the device; `center_mm` is the position of its middle.
    """
    return Treatment(device, (Implant(device, device, diameter_mm, length_mm, Placing(position_mm=center_mm)),))


def read_treatment(text: str) -> Treatment:
    """Return a treatment read from text; every implant opens inside those before it.

    Parameters
    ----------
    text : devices in the order of their deployment, joined by ``+``, such as ``silk 4x20 + silk@-4``. After a device
        may stand its label diameter and length in mm, and after ``@`` a shift of the proposed place in mm, positive
        distally. ``NAME=`` before them names the treatment; otherwise its name is made of its devices.

    Raises
    ------
    InputError
        The text has another form.
    """
    given, equals, devices = text.rpartition("=")
    implants: list[Implant] = []
    for part in devices.split("+"):
        found = IMPLANT.fullmatch(part.strip())
        if not found:
            raise InputError(
                f"{part.strip()!r} is not an implant: write a device, its size and its shift such as 'silk 4x20 @-4'"
            )
        device, diameter, length, shift = found.groups()
        device = device.lower()
        ids = (device, *(f"{device}_{number}" for number in range(2, len(implants) + 2)))
        implants.append(
            Implant(
                next(name for name in ids if name not in {one.id for one in implants}),
                device,
                float(diameter) if diameter else None,
                float(length) if length else None,
                Placing(shift_mm=float(shift or 0.0)),
                tuple(one.id for one in implants),
            )
        )
    name = given.strip() if equals else "+".join(one.id for one in implants)
    return Treatment(name, tuple(implants))


def _check_name(what: str, name: str) -> None:
    """Raise InputError where a name cannot be that of a folder."""
    if not NAME.fullmatch(name):
        raise InputError(f"{name!r} is not a name of {what}s: use up to 60 letters, digits, and . _ + -")
