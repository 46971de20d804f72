"""Keys of the results of a study: each states what a result is computed from, code included.

A key contains the keys of the results that are used, the settings of the stage, and the code of the stage's function
(`vstent.study.code`). A changed line therefore changes the keys of its own stage and of all that follow from it.
"""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from vstent.devices.catalogue import find_design
from vstent.devices.design import BARE
from vstent.errors import ReadError
from vstent.io.images import files_of
from vstent.study.code import code_of
from vstent.study.store import Key, digest

if TYPE_CHECKING:
    from vstent.angiography.angiogram import AngiogramSettings
    from vstent.devices.design import Design
    from vstent.study.types import Settings

ANATOMY: Final = "anatomy"
"""Name of the anatomy in the store."""
VESSEL: Final = "vessel"
"""Name of the vessel before it is trimmed in the store."""
OF_VESSEL: Final = ("units", "frame", "acquisition", "spacing_mm", "shape", "crop_mm", "threshold", "at_mm", "inlet_mm")
"""Settings that change the vessel."""
OF_DEVICES: Final = (
    *("devices", "diameter_mm", "length_mm", "center_mm", "placings"),
    *("flow", "without_flow", "uncertainty"),
)
"""Settings that do not change the anatomy."""


def key_of(entry: str, *parts: Any, without: tuple[str, ...] = ()) -> Key:
    """Return the key of a result.

    Parameters
    ----------
    entry : module or function (``module:function``) that computes it.
    parts : all that it depends on: keys of other results, settings and other plain values.
    without : prefixes of modules that it does not use.
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
    """Return the keys of the vessel and the anatomy of an input, by name.

    Parameters
    ----------
    source : SHA-256 of the input.
    settings : settings of the study.
    """
    given = {one.name: getattr(settings, one.name) for one in fields(settings) if one.name not in OF_DEVICES}
    vessel = key_of("vstent.study.stages:find_vessel", source, {name: given[name] for name in OF_VESSEL})
    return {VESSEL: vessel, ANATOMY: key_of("vstent.study.stages:find_anatomy", vessel, given)}


def deployment_key(anatomy: Key, settings: "Settings", name: str, design: "Design") -> Key:
    """Return the key of one deployment; ranges and sources of the numbers of a device do not change it."""
    return key_of(
        "vstent.study.stages:deploy_one", anatomy, replace(design, facts=(), ranges=()), settings.placing(name)
    )


def flow_key(device: Key, settings: "Settings", name: str) -> Key:
    """Return the key of one flow.

    Parameters
    ----------
    device : key of the deployment, or of the anatomy for the flow without a device.
    settings : settings of the study.
    name : ``bare``, or the name of the device.
    """
    unused = ("vstent.deployment",) if name == BARE else ()
    if settings.flow is not None and settings.flow.engine == "lattice":
        unused = (*unused, "vstent.flow.openfoam")
    return key_of("vstent.study.stages:compute_flow", device, settings.flow, without=unused)


def uncertainty_key(deployment: Key, settings: "Settings", design: "Design") -> Key:
    """Return the key of the uncertainty study of one deployment."""
    assert settings.uncertainty is not None
    numbers = settings.uncertainty.numbers_of(design)
    flow, unused = (settings.flow, ()) if settings.uncertainty.flow_samples else (None, ("vstent.flow",))
    return key_of("vstent.plan.uncertainty", deployment, settings.uncertainty, numbers, flow, without=unused)


def study_keys(source: str, settings: "Settings") -> dict[str, Key]:
    """Return the keys of all stages of a study by their name in the store, in the order in which they are computed.

    Parameters
    ----------
    source : SHA-256 of the input.
    settings : settings of the study.
    """
    designs = {name: find_design(name) for name in settings.devices}
    keys = anatomy_keys(source, settings)
    anatomy = keys[ANATOMY]
    keys |= {f"deploy {name}": deployment_key(anatomy, settings, name, design) for name, design in designs.items()}
    if settings.flow is not None:
        flown = {BARE: anatomy} | {
            name: keys[f"deploy {name}"] for name in designs if name not in settings.without_flow
        }
        keys |= {f"flow {name}": flow_key(key, settings, name) for name, key in flown.items()}
    if settings.uncertainty is not None:
        deployed = {name: keys[f"deploy {name}"] for name in designs}
        keys |= {f"vary {name}": uncertainty_key(key, settings, designs[name]) for name, key in deployed.items()}
    return keys


def measures_key(settings: "Settings", keys: Mapping[str, Key], failures: Mapping[str, str]) -> Key:
    """Return the key of all metrics of a study.

    Parameters
    ----------
    settings : settings of the study.
    keys : keys of its stages, of `study_keys`.
    failures : reasons why a device was not deployed or its flow not computed, by name.
    """
    designs = [find_design(name) for name in settings.devices]
    placings = [settings.placing(name) for name in settings.devices]
    return key_of("vstent.study.stages:measure_study", list(keys.values()), designs, placings, dict(failures))


def angiogram_key(flow: Key, settings: "AngiogramSettings") -> Key:
    """Return the key of the angiogram of a flow, and of the contrast that it carries."""
    return key_of("vstent.angiography.angiogram", flow, settings)


def refuse_missing(path: Path) -> None:
    """Raise ReadError where an input does not exist."""
    if not path.exists():
        raise ReadError(f"{path} does not exist: give a scan (DICOM folder, NIfTI, NRRD, MHA, raw) or a surface")


def hash_of(path: Path) -> str:
    """Return the SHA-256 of an input.

    For a folder it covers the names and contents of all files, in the order of their paths. For one file of a scan that
    has several, it covers the contents of all of them.

    Raises
    ------
    ReadError
        The input does not exist.
    """
    refuse_missing(path)
    digest = hashlib.sha256()
    for file in sorted(path.rglob("*")) if path.is_dir() else files_of(path):
        if file.is_file():
            digest.update(file.name.encode() + b"\0" if path.is_dir() else b"")
            with file.open("rb") as stream:
                while block := stream.read(1 << 20):
                    digest.update(block)
    return digest.hexdigest()
