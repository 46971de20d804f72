"""Keys of the results of a study: each states what a result is computed from, code included.

A key contains the keys of the results that are used, the settings of the stage, and the code of the stage's function
(`vstent.study.code`). A changed line therefore changes the keys of its own stage and of all that follow from it.
"""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from vstent.devices.catalogue import find_design
from vstent.devices.design import Basket, Coil
from vstent.devices.treatment import BARE, Implant, Treatment
from vstent.flow.settings import LATTICE
from vstent.io.files import existing
from vstent.io.images import files_of
from vstent.study.code import code_of
from vstent.study.store import Key, digest

if TYPE_CHECKING:
    from vstent.angiography.angiogram import AngiogramSettings
    from vstent.study.settings import Settings

ANATOMY: Final = "anatomy"
"""Name of the anatomy in the store."""
VESSEL: Final = "vessel"
"""Name of the vessel before it is trimmed in the store."""


STRAIGHTENED: Final = "/straightened"
"""End of the name of the flow with a treatment in the artery that has yielded to it."""
ALONE: Final = "/straightened/bare"
"""End of the name of the flow in the artery that has yielded, without its devices."""


def key_of(entry: str, *parts: Any, without: tuple[str, ...] = ()) -> Key:
    """Return the key of a result of a module or function (``module:function``) without modules that it does not use.

    The parts are all that it depends on: keys of other results, settings and other plain values.
    """
    return Key(digest(parts), digest([code_of(entry, without), *(key.code for key in _keys_in(parts))]))


def _keys_in(parts: Any) -> Iterator[Key]:
    """Yield the keys among values."""
    if isinstance(parts, Key):
        yield parts
    elif isinstance(parts, (tuple, list)):
        for part in parts:
            yield from _keys_in(part)


def anatomy_keys(source: str, settings: "Settings") -> dict[str, Key]:
    """Return the keys of the vessel and the anatomy of an input, with its SHA-256 `source`, by name."""
    given = settings.anatomy
    vessel = key_of("vstent.study.stages:find_vessel", source, settings.input, given.at_mm, given.inlet_mm)
    return {VESSEL: vessel, ANATOMY: key_of("vstent.study.stages:find_anatomy", vessel, given)}


def stage_name(treatment: Treatment, implant: Implant) -> str:
    """Return the name of an implant in names of stages: that of its treatment, and its own beside others."""
    return treatment.name if len(treatment.implants) == 1 else f"{treatment.name} {implant.id}"


def flow_stage(name: str) -> str:
    """Return the name of the stage of a flow."""
    return f"flow {name}".replace("/", " ")


def yields(treatment: Treatment, settings: "Settings") -> bool:
    """Return whether an artery yields to a treatment: where it has a device that is not in a sac."""
    designs = [find_design(device) for device in treatment.devices]
    return settings.straightening != "off" and not all(isinstance(one, Basket | Coil) for one in designs)


def implant_keys(anatomy: Key, treatment: Treatment) -> dict[str, Key]:
    """Return the keys of the deployments of a treatment by the implants' ids.

    Ranges and sources of the numbers of a device do not change them.
    """
    keys: dict[str, Key] = {}
    for implant in treatment.implants:
        design = replace(find_design(implant.device), facts=(), ranges=())
        given: tuple[Any, ...] = design, implant.diameter_mm, implant.length_mm, implant.placing
        given += (implant.density_fraction, implant.coils, implant.seed) if isinstance(design, Coil) else ()
        inside = [keys[name] for name in implant.inside]
        keys[implant.id] = key_of("vstent.study.stages:deploy_implant", anatomy, *given, inside)
    return keys


def is_varied(treatment: Treatment) -> bool:
    """Return whether an uncertainty study varies a treatment: one device, or coils kept in a sac by one stent."""
    *others, last = treatment.implants or (None,)
    return last is not None and (
        not others or (len(others) == len(last.inside) == 1 and isinstance(find_design(last.device), Coil))
    )


def study_keys(source: str, settings: "Settings") -> dict[str, Key]:
    """Return the keys of all stages of a study of an input, with its SHA-256 `source`, by their name in the store.

    They are in the order in which they are computed. DeviceError is raised where a device does not exist.
    """
    keys = anatomy_keys(source, settings)
    anatomy = keys[ANATOMY]
    deployed = {treatment.name: implant_keys(anatomy, treatment) for treatment in settings.treatments}
    for treatment in settings.treatments:
        for implant in treatment.implants:
            keys[f"deploy {stage_name(treatment, implant)}"] = deployed[treatment.name][implant.id]
    if settings.flow is not None:
        flown = [treatment.name for treatment in settings.treatments if treatment.has_flow]
        of_engine = ("vstent.flow.openfoam",) if settings.flow.numerics.engine == LATTICE else ()
        for name in (BARE, *flown):
            implants = [*deployed[name].values()] if name != BARE else []
            unused = (*(() if implants else ("vstent.deployment",)), *of_engine)
            used = anatomy, implants, settings.flow
            keys[f"flow {name}"] = key_of("vstent.study.stages:compute_flow", *used, without=unused)
    keys |= _straightened_keys(anatomy, deployed, settings)
    if settings.uncertainty is not None:
        flow, unused = (settings.flow, ()) if settings.uncertainty.flow_samples else (None, ("vstent.flow",))
        for treatment in settings.treatments:
            if is_varied(treatment):
                numbers = settings.uncertainty.numbers_of(find_design(treatment.devices[0]))
                placed = [*deployed[treatment.name].values()]
                varied = placed, settings.uncertainty, numbers, flow, settings.straightening
                keys[f"vary {treatment.name}"] = key_of("vstent.plan.uncertainty", *varied, without=unused)
    return keys


def _straightened_keys(anatomy: Key, deployed: Mapping[str, Mapping[str, Key]], settings: "Settings") -> dict[str, Key]:
    """Return the keys of the arteries that yield to treatments, and of the flows in them."""
    keys: dict[str, Key] = {}
    for one in settings.treatments:
        if not yields(one, settings):
            continue
        artery = key_of(
            "vstent.deployment.straightening", anatomy, [*deployed[one.name].values()], settings.straightening
        )
        keys[f"straighten {one.name}"] = artery
        for end in (ALONE, STRAIGHTENED) if settings.flow is not None and one.has_flow else ():
            flow = key_of("vstent.study.stages:compute_flow", artery, end, settings.flow)
            keys[flow_stage(f"{one.name}{end}")] = flow
    return keys


def measures_key(settings: "Settings", keys: Mapping[str, Key], failures: Mapping[str, str]) -> Key:
    """Return the key of all metrics of a study, from the keys of its stages and the reasons of what failed, by name."""
    designs = [find_design(name) for name in settings.devices]
    used = list(keys.values()), designs, settings.treatments, dict(failures)
    return key_of("vstent.study.stages:measure_study", *used)


def angiogram_key(flow: Key, settings: "AngiogramSettings") -> Key:
    """Return the key of the angiogram of a flow, and of the contrast that it carries."""
    return key_of("vstent.angiography.angiogram", flow, settings)


def hash_of(path: Path) -> str:
    """Return the SHA-256 of all files of an input; of a folder these are the DICOM files in order, with their names."""
    existing(path)
    digest = hashlib.sha256()
    for file in files_of(path):
        digest.update(file.name.encode() + b"\0" if path.is_dir() else b"")
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()
