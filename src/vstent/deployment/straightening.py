"""What a device straightens: the artery's axis as a beam in a soft bed, and the whole vessel that follows it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.optimize import brentq

from vstent.anatomy.restore.paths import on_path
from vstent.deployment.beam import Beam
from vstent.deployment.deploy import deploy
from vstent.deployment.measure import branches
from vstent.deployment.motion import Motion, Skin, moved
from vstent.devices.stent import Coils, Deployment, Landing, Stent
from vstent.devices.stiffness import bending_stiffness_N_mm2
from vstent.devices.treatment import read_straightening
from vstent.errors import InputError, LandingError
from vstent.geometry.vessel import Anatomy
from vstent.kernels import curves
from vstent.kernels.arrays import Floats, freeze

WALL_N_MM2: Final = 1.0
"""Young's modulus of the wall, in N/mm2: 0.5 to 2 (estimate; arteries stiffen with pressure)."""
OUTER_RADII: Final = 1.25
"""Outer over inner radius of the artery, 5 over 4 mm: 1.15 to 1.3 (estimate)."""
BED_N_MM2: Final = 0.004
"""Force per length and displacement of the bed, in N/mm2: 0.001 to 0.006, for a beam embedded in tissue 1.4 times the
modulus of brain, 3 kPa (1 to 4; Budday et al. 2017, Acta Biomater. 48:319)."""
SETTINGS: Final[dict[str, tuple[float, float, float]]] = {
    "immediate": (0.180, 0.031, 0.383),
    "six_months": (0.218, 0.0, 0.570),
}
"""Factor on the stiffness of the device over that of wall and bed, of every named setting: as likely, lowest, highest.

It is fitted to what laser-cut stents straightened, with an Enterprise over the neck in seven carotid siphons
(``benchmarks/straightening.py fit``). At implantation the mean radius of the bend along the stent increased from
7.1 by 3.6 +- 2.7 mm, by half (24 patients, stents 25.4 mm long; King et al. 2012, AJNR 33:1657). After six months
the angle had increased by 12.9 +- 13.1 degrees (16 patients; Kono et al. 2014, PLoS ONE 9:e108033; 14 mm long is
assumed)."""
OVER_MM: Final = 4.0
"""Length over which directions, and on both sides of a point curvatures are measured, in mm: the width of an artery."""
STRAIGHT_PER_MM: Final = 1e-4
"""Curvature of an artery that is straight, in 1/mm: no radius is larger than 10 m."""
STEP_MM: Final = 0.5
"""Length of a piece of the beam, in mm."""
AGREED_MM: Final = 0.05
"""Largest difference, in mm, between the displacements of two rounds at which device and artery agree."""
ROUNDS: Final = 5
"""Largest number of rounds."""
TRIED: Final = np.geomspace(1e-2, 1e3, 18)
"""Factors between which that of a measured angle or radius is sought."""


@dataclass(frozen=True, eq=False)
class Straightening:
    """An artery that has yielded to its devices, and they in it."""

    anatomy: Anatomy
    """The artery after it has yielded."""
    deployed: tuple[Deployment, ...]
    """The devices in it."""
    angle_rad: Floats
    """(4,) angle between the arms of the artery beside the device, pi where it is straight: before, after, and
    the lowest and the highest after."""
    radius_mm: Floats
    """(2,) radius of the sharpest bend along the device, before and after."""
    displacement_mm: float
    """Largest displacement of the axis."""
    axis_length_change_fraction: float
    """Relative change of the length of the axis."""

    def __post_init__(self) -> None:
        freeze(self, "angle_rad", np.float64, (4,))
        freeze(self, "radius_mm", np.float64, (2,))

    def metrics(self) -> dict[str, float]:
        """Return the numbers by name; the end of each name is its unit."""
        before_rad, after_rad, low_rad, high_rad = self.angle_rad.tolist()
        return {
            "arms_angle_before_rad": before_rad,
            "arms_angle_after_rad": after_rad,
            "straightened_rad": after_rad - before_rad,
            "straightened_low_rad": low_rad - before_rad,
            "straightened_high_rad": high_rad - before_rad,
            "bend_radius_before_mm": float(self.radius_mm[0]),
            "bend_radius_after_mm": float(self.radius_mm[1]),
            "axis_displacement_mm": self.displacement_mm,
            "axis_length_change_fraction": self.axis_length_change_fraction,
        }


class Bend(NamedTuple):
    """The axis of an artery with devices in it."""

    rest: Beam
    """The artery without devices."""
    stiffness_N_mm2: Floats
    """(3, n) stiffness of the devices relative to that of wall and bed: as likely, lowest and highest."""
    ends_mm: tuple[float, float]
    """Where the devices begin and end on the axis."""
    moved_mm: Floats
    """(n, 3) nodes in equilibrium."""

    @classmethod
    def of(
        cls, rest: Beam, stents: Sequence[Stent], setting: str, place: float = 0.0, start_mm: Floats | None = None
    ) -> "Bend":
        """Return the axis with devices in it, from nodes (n, 3); setting and place are those of `straighten`."""
        ends_mm = min(one.proximal_abscissa_mm for one in stents), max(one.distal_abscissa_mm for one in stents)
        likely, low, high = stiffness = _relative(rest, _device(rest, stents), ends_mm, read_straightening(setting))
        at = likely + abs(place) * ((high if place > 0 else low) - likely)
        return cls(rest, stiffness, ends_mm, settled(rest, at, rest.rest_mm if start_mm is None else start_mm))

    def numbers(self) -> dict[str, Any]:
        """Return the numbers of `Straightening` by the name of their field."""
        rest, (likely, *others), moved_mm = self.rest, self.stiffness_N_mm2, self.moved_mm
        shapes = [rest.rest_mm, moved_mm]
        shapes += [moved_mm if (one == likely).all() else settled(rest, one, moved_mm) for one in others]
        angle_rad, radius_mm = np.array([measured(one, self.ends_mm) for one in shapes]).T
        return {
            "angle_rad": angle_rad,
            "radius_mm": radius_mm[:2],
            "displacement_mm": float(curves.lengths(moved_mm - rest.rest_mm).max()),
            "axis_length_change_fraction": float(
                curves.arc_length(moved_mm)[-1] / curves.arc_length(rest.rest_mm)[-1] - 1
            ),
        }


def described(measures: Mapping[str, Any], intervals: Mapping[str, Mapping[str, float]] = MappingProxyType({})) -> str:
    """Return the metrics of a straightening as sentences; a band that is wider than the effect comes first.

    The bands are the intervals of an uncertainty study, where it has them.
    """
    varied = intervals.get("straightened_rad", {end: measures[f"straightened_{end}_rad"] for end in ("low", "high")})
    found_rad = measures["straightened_rad"], varied["low"], varied["high"]
    value, low, high = (round(float(np.degrees(one)), 1) + 0.0 for one in found_rad)
    first = "The band is wider than the effect. " if high - low > abs(value) else ""
    band = f" ({low:.0f} to {high:.0f})" if high > low else ""
    before_mm, after_mm = measures["bend_radius_before_mm"], measures["bend_radius_after_mm"]
    radius = intervals.get("bend_radius_after_mm")
    to_mm = f" ({radius['low']:.1f} to {radius['high']:.1f})" if radius else ""
    return (
        f"{first}The artery opens by {value:.1f} degrees{band}, the radius of its sharpest bend changes from "
        f"{before_mm:.1f} to {after_mm:.1f}{to_mm} mm, and its axis moves by up to "
        f"{measures['axis_displacement_mm']:.1f} mm."
    )


def straighten(
    anatomy: Anatomy, deployed: Sequence[Deployment], setting: str = "immediate", place: float = 0.0
) -> Straightening:
    """Let an artery yield to the devices in it, and deploy these again in the artery that has yielded until both agree.

    Parameters
    ----------
    anatomy : Anatomy
        The restored artery as scanned.
    deployed : sequence of Deployment
        Devices on one path, in the order of their deployment; each opens inside those before it. Coils follow the sac.
    setting : str, optional
        ``immediate`` or ``six_months`` after treatment; or what was measured: the angle by which the artery opens, such
        as ``12deg``, or the radius of its sharpest bend afterwards, such as ``10.7mm``.
    place : float, optional
        Where the stiffness of the device relative to wall and bed lies in its range: -1 is the lowest, 1 the highest.

    Returns
    -------
    Straightening
        The artery and the devices after it has yielded, with the numbers before and after.

    Raises
    ------
    InputError
        The setting is not known, or no stiffness gives the measured angle or radius.
    LandingError
        The devices lie on several paths, or no longer fit.

    Notes
    -----
    The axis of the artery is a beam that is at rest as scanned, in an elastic bed, held by springs at its ends and
    branches. A device is a beam that is at rest when straight. Every section of the vessel moves with the axis as a
    rigid body, and so does every sac and branch with its neck.
    """
    stents = stiff([one.stent for one in deployed])
    first = anatomy.parent.name
    anatomy = on_path(anatomy, stents[0].path)
    rest, yielded, again = artery_beam(anatomy), anatomy, tuple(deployed)
    moved_mm, skin = rest.rest_mm, Skin(anatomy, rest.rest_mm)
    for done in range(ROUNDS):
        bend = Bend.of(rest, stents, setting, place, moved_mm)
        if np.abs(bend.moved_mm - moved_mm).max() < (AGREED_MM if done else np.nextafter(0.0, 1.0)):
            bend = bend._replace(moved_mm=moved_mm)
            break
        moved_mm, motion = bend.moved_mm, Motion.of(skin, bend.moved_mm)
        yielded = moved(motion)
        again = _deployed_again(deployed, anatomy, yielded, motion)
        stents = [_on(one.stent, anatomy, yielded) for one in again if not isinstance(one.stent, Coils)]
    return Straightening(on_path(yielded, first), again, **bend.numbers())


def stiff(stents: Sequence[Stent]) -> list[Stent]:
    """Return the devices that straighten an artery; LandingError is raised for none, and for several paths."""
    found = [one for one in stents if one.design.kind in ("braid", "laser_cut")]
    if len({stent.path for stent in found}) > 1:
        raise LandingError(
            "Straightening is computed for devices on one path: at a fork each device pulls the artery towards its own "
            "branch, and the balance of both is not modelled."
        )
    if not found:
        raise LandingError("Nothing straightens the artery: coils and devices in sacs have no stiffness along it.")
    return found


def artery_beam(anatomy: Anatomy) -> Beam:
    """Return the beam of the first path without a device, held at its ends and branches."""
    path = anatomy.parent
    nodes_mm = curves.resample(path.axis.points_mm, STEP_MM)
    where_mm = curves.arc_length(nodes_mm)
    held: list[tuple[float, float | None]] = [(0.0, None), (where_mm[-1], None)]
    diameters_mm = {one.role: one.diameter_mm for one in anatomy.vessel.openings}
    held += [(at_mm, 0.5 * max(diameters_mm[role] for role in roles)) for at_mm, roles in branches(anatomy)]
    return beam_of(nodes_mm, np.interp(where_mm, path.axis.abscissa_mm, path.section_radius_mm), held)


def beam_of(nodes_mm: Floats, radius_mm: Floats, held: Sequence[tuple[float, float | None]]) -> Beam:
    """Return the beam of an artery with inner radii (n,), held by arteries at arc lengths with these radii, in mm.

    An artery that goes on resists as a half-infinite beam in the bed; None is the radius of the artery itself there.
    """
    where_mm = curves.arc_length(nodes_mm)
    hold = BED_N_MM2 * np.gradient(where_mm)
    hold[[0, -1]] *= 0.5
    for at_mm, beside_mm in held:
        node = int(np.abs(where_mm - at_mm).argmin())
        bending = _bending_N_mm2(radius_mm[node] if beside_mm is None else beside_mm)
        hold[node] += 0.5 * BED_N_MM2 * (4 * bending / BED_N_MM2) ** 0.25
    stretch_N = WALL_N_MM2 * np.pi * (OUTER_RADII**2 - 1) * (0.5 * (radius_mm[1:] + radius_mm[:-1])) ** 2
    return Beam(nodes_mm, _bending_N_mm2(radius_mm), np.zeros(len(nodes_mm)), stretch_N, hold)


def settled(rest: Beam, device_N_mm2: Floats, start_mm: Floats) -> Floats:
    """Return the nodes (n, 3) of an artery with a device in it, in mm, from those of `start_mm`."""
    return rest._replace(device_N_mm2=device_N_mm2).settled_mm(start_mm)


def measured(nodes_mm: Floats, ends_mm: tuple[float, float]) -> tuple[float, float]:
    """Return the angle between the arms beside a device, in rad, and the radius of its sharpest bend, in mm."""
    where_mm = curves.arc_length(nodes_mm)
    first_mm, last_mm = max(ends_mm[0], OVER_MM), min(ends_mm[1], where_mm[-1] - OVER_MM)
    over_mm = np.array([first_mm - OVER_MM, first_mm, last_mm, last_mm + OVER_MM])
    first, last = np.diff(curves.interpolate(where_mm, nodes_mm, over_mm).reshape(2, 2, 3), axis=1)[:, 0]
    turn_rad = np.arctan2(np.linalg.norm(np.cross(first, last)), first @ last)
    curvature = curves.curvature_and_torsion(nodes_mm, OVER_MM)[0]
    is_along = (where_mm >= ends_mm[0]) & (where_mm <= ends_mm[1])
    return float(np.pi - turn_rad), float(1 / max(curvature[is_along].max(), STRAIGHT_PER_MM))


def _bending_N_mm2(radius_mm: Floats | float) -> Floats:
    """Return the bending stiffness of arteries with inner radii, in N mm2."""
    return WALL_N_MM2 * np.pi / 4 * (OUTER_RADII**4 - 1) * np.asarray(radius_mm) ** 4


def _device(rest: Beam, stents: Sequence[Stent]) -> Floats:
    """Return the likely, lowest and highest bending stiffness (3, n) of the devices at the nodes of a beam."""
    where_mm, found = curves.arc_length(rest.rest_mm), np.zeros((3, len(rest.rest_mm)))
    for stent in stents:
        is_in = (where_mm >= stent.proximal_abscissa_mm) & (where_mm <= stent.distal_abscissa_mm)
        diameter_mm = np.interp(where_mm[is_in], stent.row_abscissa_mm, stent.row_diameter_mm)
        stiffness_N_mm2 = bending_stiffness_N_mm2(stent.design, stent.size, diameter_mm)
        # The factor is fitted on laser-cut stents, so its range contains that of their stiffness.
        found[:, is_in] += stiffness_N_mm2 if stent.design.kind == "braid" else stiffness_N_mm2[0]
    return found


def _relative(rest: Beam, device: Floats, ends_mm: tuple[float, float], setting: str) -> Floats:
    """Return the likely, lowest and highest stiffness (3, n) of a device relative to that of wall and bed."""
    if setting in ("off", *SETTINGS):
        return np.array(SETTINGS.get(setting, (0.0, 0.0, 0.0)))[:, None] * device
    unit = setting.lstrip("0123456789.")
    which, value = ("deg", "mm").index(unit), float(setting.removesuffix(unit))
    before = measured(rest.rest_mm, ends_mm)[which]
    wanted = before + np.radians(value) if unit == "deg" else value

    def excess(share: float) -> float:
        return measured(settled(rest, share * device[0], rest.rest_mm), ends_mm)[which] - wanted

    reached, last = before, 0.0
    for share in TRIED:
        if (now := excess(share)) >= 0 >= before - wanted:
            share = float(brentq(excess, last, share, xtol=1e-3 * share)) if before < wanted else 0.0
            return np.tile(share * device[0], (3, 1))
        reached, last = max(reached, now + wanted), share
    if unit == "deg":
        raise InputError(f"The device opens this artery by at most {np.degrees(reached - before):.1f} degrees.")
    raise InputError(
        f"The sharpest bend has a radius of {before:.1f} mm, and of at most {reached:.1f} mm with the device."
    )


def _deployed_again(
    deployed: Sequence[Deployment], anatomy: Anatomy, yielded: Anatomy, motion: Motion
) -> tuple[Deployment, ...]:
    """Return devices deployed in an artery that has yielded, their middles where they were on the wall."""
    again: list[Deployment] = []
    for one in deployed:
        stent = one.stent
        if isinstance(stent, Coils):
            sac = replace(stent.sac, vertices_mm=motion.of_points(stent.sac.vertices_mm))
            stent = replace(stent, wire_points_mm=motion.of_points(stent.wire_points_mm), sac=sac)
            again.append(replace(one, stent=stent))
            continue
        before_mm, after_mm = anatomy.parent.axis.abscissa_mm, yielded.parent.axis.abscissa_mm
        place = Landing(float(np.interp(stent.middle_abscissa_mm, before_mm, after_mm)))
        inside = [other.stent for other in again]
        again.append(deploy(stent.design, yielded, size=stent.size, landing=place, inside=inside))
    return tuple(again)


def _on(stent: Stent, anatomy: Anatomy, yielded: Anatomy) -> Stent:
    """Return a stent in an artery that has yielded, with its arc lengths on the axis before."""
    after_mm, before_mm = yielded.parent.axis.abscissa_mm, anatomy.parent.axis.abscissa_mm
    return replace(stent, row_abscissa_mm=np.interp(stent.row_abscissa_mm, after_mm, before_mm))
