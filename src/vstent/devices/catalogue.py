"""The device catalogue: devices of vstent, of plug-ins, and those added by the user."""

import difflib
import os
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

from vstent import plugins
from vstent.devices.design import Design, Size, called
from vstent.errors import DeviceError


@cache
def catalogue() -> dict[str, Design]:
    """Read all devices for arteries: those of the catalogue, of plug-ins and those added by the user.

    Returns
    -------
    dict
        Designs by their key. The result is cached.

    Raises
    ------
    DeviceError
        A catalogue breaks its schema or repeats a device of another catalogue.
    PluginError
        A plug-in cannot be loaded.
    """
    from vstent.devices.schema import parse  # so that pydantic is loaded only with the catalogue

    designs: dict[str, Design] = {}
    for text, source in _entries():
        added = parse(text, source)
        _check_new(added, designs, source)
        designs |= added
    return designs


def _entries() -> Iterator[tuple[str, str]]:
    """Yield the text of every catalogue of devices for arteries, and where it is from."""
    yield _own("catalogue"), "The catalogue"
    for name, entry in plugins.plugins("vstent.devices").items():
        yield plugins.load("vstent.devices", name, built_in="vstent")(), f"The plug-in {name} ({entry.value})"
    for path in sorted(user_folder().glob("*.toml")):
        yield _text(path), str(path)


def _own(name: str) -> str:
    """Return the text of a list of devices of vstent."""
    from importlib.resources import files

    return files("vstent.devices").joinpath(f"{name}.toml").read_text(encoding="utf-8")


def entry_of(name: str) -> str:
    """Return the entry of a device, as its catalogue has it: TOML, every number with its source and range."""
    import tomlkit

    key = find_design(name).key
    for text in (*(text for text, _ in _entries()), _own("baskets"), _own("coils")):
        for device in tomlkit.parse(text)["device"]:
            if device["key"] == key:
                return tomlkit.dumps({"device": [device]})
    raise AssertionError(key)


@cache
def baskets() -> dict[str, Design]:
    """Read the baskets and the coils for sacs, by their key."""
    from vstent.devices.schema import parse

    return parse(_own("baskets"), "The list of baskets") | parse(_own("coils"), "The list of coils")


def user_folder() -> Path:
    """Return the folder of the user's device files: ``vstent/devices`` in ``$XDG_CONFIG_HOME`` or ``~/.config``."""
    home = os.environ.get("XDG_CONFIG_HOME") or os.environ.get("APPDATA") or "~/.config"
    return Path(home).expanduser() / "vstent" / "devices"


def add_devices(path: Path) -> dict[str, Design]:
    """Check a device file and copy it to the user's folder, so that its devices join the catalogue.

    A file of the same name that is already there is replaced. The added designs are returned by their key.
    A DeviceError is raised where it is not readable text, breaks the schema or repeats a device of the catalogue.
    """
    from vstent.devices.schema import parse

    text = _text(path)
    added, kept = parse(text, str(path)), user_folder() / f"{path.stem}.toml"
    others = parse(_text(kept), str(kept)) if kept.exists() else {}
    known = catalogue() | baskets()
    _check_new(added, {key: design for key, design in known.items() if key not in others}, path)
    kept.parent.mkdir(parents=True, exist_ok=True)
    partial = kept.with_suffix(".partial")
    partial.write_text(text, encoding="utf-8")
    partial.replace(kept)
    catalogue.cache_clear()
    return added


def _text(path: Path) -> str:
    """Return the text of a device file."""
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise DeviceError(f"{path} does not exist: check the path.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise DeviceError(f"{path} cannot be read as text. Give a TOML file of devices, or remove it.") from error


def _check_new(added: Mapping[str, Design], known: Mapping[str, Design], source: object) -> None:
    """Raise a DeviceError if a device of `added` has a key or name that is already used."""
    twice = sorted(set(called(added.values())) & set(called(known.values())))
    if twice:
        raise DeviceError(
            f"{source} names a device that the catalogue already has, {twice[0]}. Give it another key and name."
        )


def find_design(name: str) -> Design:
    """Find a device by its key or name, in upper or lower case.

    Parameters
    ----------
    name : str
        Key or name.

    Returns
    -------
    Design
        The device.

    Raises
    ------
    DeviceError
        There is no such device. The message lists all devices and suggests the most similar name.
    """
    designs = catalogue() | baskets()
    by_name = {word: design for design in designs.values() for word in called([design])}
    wanted = name.strip().casefold()
    if wanted in by_name:
        return by_name[wanted]
    near = difflib.get_close_matches(wanted, by_name, n=1)
    hint = f" Did you mean {by_name[near[0]].key}?" if near else ""
    raise DeviceError(f"There is no device called {name!r}.{hint} Choose one of: {', '.join(sorted(designs))}.")


def find_sizes(design: Design, *, diameter_mm: float | None = None, length_mm: float | None = None) -> tuple[Size, ...]:
    """Find all sizes of a device with a label diameter and length, by increasing diameter, then length.

    None matches any. A DeviceError, raised where the device is not made in this size, lists what is available.
    """
    fits = [
        size for size in design.sizes if diameter_mm in (None, size.diameter_mm) and length_mm in (None, size.length_mm)
    ]
    if fits:
        return tuple(sorted(fits, key=lambda size: (size.diameter_mm, size.length_mm)))
    asked = " x ".join(f"{value:g} mm" for value in (diameter_mm, length_mm) if value is not None)
    same = [size for size in design.sizes if size.diameter_mm == diameter_mm]
    values = {size.length_mm for size in same} or {size.diameter_mm for size in design.sizes}
    offered = ", ".join(f"{value:g}" for value in sorted(values))
    what = f"in {diameter_mm:g} mm its lengths are" if same else "its diameters are"
    raise DeviceError(f"{design.name} is not made in {asked}: {what} {offered} mm. Choose one of them.")


def find_size(design: Design, *, diameter_mm: float | None = None, length_mm: float | None = None) -> Size:
    """Return the first of `find_sizes`, that is the smallest diameter with its shortest length.

    Parameters
    ----------
    design : Design
        The device.
    diameter_mm : float, optional
        Label diameter, in mm; None matches any.
    length_mm : float, optional
        Label length, in mm; None matches any.

    Returns
    -------
    Size
        The size.

    Raises
    ------
    DeviceError
        The device is not made in this size.
    """
    return find_sizes(design, diameter_mm=diameter_mm, length_mm=length_mm)[0]
