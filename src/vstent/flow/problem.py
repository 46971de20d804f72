"""From an anatomy with its deployed implants, or a bare vessel, to a `FlowCase`."""

from collections.abc import Sequence

from vstent.deployment.struts import over_restored
from vstent.devices.stent import Stent
from vstent.flow.case import FlowCase, Sheet, Target
from vstent.flow.ends import ends_of
from vstent.flow.media import media
from vstent.flow.ostium import ostium
from vstent.flow.settings import FlowSettings
from vstent.geometry.vessel import Anatomy, Vessel


def flow_case(anatomy: Anatomy, implants: Sequence[Stent] = (), settings: FlowSettings | None = None) -> FlowCase:
    """Build the flow problem of a patient's lumen and largest sac, with implants as media and as wires over ostia."""
    settings = settings or FlowSettings()
    largest = anatomy.aneurysms[0] if anatomy.aneurysms else None
    return vessel_case(
        anatomy.vessel,
        settings,
        target=None if largest is None else Target(largest.sac, ostium(largest, anatomy.vessel.lumen)),
        media=tuple(medium for one in implants for medium in media(one, settings.blood)),
        solids=tuple(over_restored(one, anatomy) for one in implants),
    )


def vessel_case(
    vessel: Vessel,
    settings: FlowSettings | None = None,
    *,
    target: Target | None = None,
    media: tuple[Sheet, ...] = (),
    solids: tuple[Stent, ...] = (),
) -> FlowCase:
    """Build the flow problem of a vessel; `target`, `media` and `solids` are those of a `FlowCase`."""
    settings = settings or FlowSettings()
    return FlowCase(
        vessel=vessel,
        ends=ends_of(vessel, settings),
        target=target,
        media=media,
        solids=solids,
        blood=settings.blood,
        waveform=settings.waveform,
        numerics=settings.numerics,
    )
