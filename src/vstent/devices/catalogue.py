"""The catalogue of devices: vstent's own, those of plug-ins, and those that the user has added."""

import difflib
import os
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path

from vstent import plugins
from vstent.devices.design import Design, Size, called
from vstent.errors import DeviceError


@cache
def catalogue() -> dict[str, Design]:
    """Return every device by its key: those of the catalogue, of plug-ins, then those that the user has added.

    Raises
    ------
    DeviceError
        When a catalogue breaks its schema or names a device that another one names.
    PluginError
        When a plug-in cannot be loaded.
    """
    from importlib.resources import files

    from vstent.devices.schema import parse  # pydantic is loaded only when the catalogue is

    designs = parse(files("vstent.devices").joinpath("catalogue.toml").read_text(encoding="utf-8"))
    for name, entry in plugins.plugins("vstent.devices").items():
        text = plugins.load("vstent.devices", name, built_in="vstent")()
        added = parse(text, f"The plug-in {name} ({entry.value})")
        _check_new(added, designs, f"The plug-in {name}")
        designs |= added
    for path in sorted(user_folder().glob("*.toml")):
        added = parse(_text(path), str(path))
        _check_new(added, designs, path)
        designs |= added
    return designs


def user_folder() -> Path:
    """Return where the user's own device files are kept: ``$XDG_CONFIG_HOME/vstent/devices``, or in ``~/.config``."""
    home = os.environ.get("XDG_CONFIG_HOME") or os.environ.get("APPDATA") or "~/.config"
    return Path(home).expanduser() / "vstent" / "devices"


def add_devices(path: Path) -> dict[str, Design]:
    """Check a device file (TOML, as ``catalogue.toml``) and keep a copy of it: its devices join the catalogue.

    A file of the same name that was added before is replaced.

    Raises
    ------
    DeviceError
        When it is no readable text, breaks the schema or names a device that the catalogue has already.
    """
    from vstent.devices.schema import parse

    text = _text(path)
    added, kept = parse(text, str(path)), user_folder() / f"{path.stem}.toml"
    others = parse(_text(kept), str(kept)) if kept.exists() else {}
    _check_new(added, {key: design for key, design in catalogue().items() if key not in others}, path)
    kept.parent.mkdir(parents=True, exist_ok=True)
    partial = kept.with_suffix(".partial")
    partial.write_text(text, encoding="utf-8")
    partial.replace(kept)
    catalogue.cache_clear()
    return added


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise DeviceError(f"{path} does not exist: check the path.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise DeviceError(f"{path} cannot be read as text. Give a TOML file of devices, or remove it.") from error


def _check_new(added: Mapping[str, Design], known: Mapping[str, Design], source: object) -> None:
    twice = sorted(set(called(added.values())) & set(called(known.values())))
    if twice:
        raise DeviceError(
            f"{source} names a device that the catalogue already has, {twice[0]}. Give it another key and name."
        )


def find_design(name: str) -> Design:
    """Return the device called `name` (its key or its name, any case).

    Raises
    ------
    DeviceError
        When there is none; the sentence says which there are and the nearest.
    """
    designs = catalogue()
    by_name = {word: design for design in designs.values() for word in called([design])}
    wanted = name.strip().casefold()
    if wanted in by_name:
        return by_name[wanted]
    near = difflib.get_close_matches(wanted, by_name, n=1)
    hint = f" Did you mean {by_name[near[0]].key}?" if near else ""
    raise DeviceError(f"There is no device called {name!r}.{hint} Choose one of: {', '.join(sorted(designs))}.")


def find_sizes(design: Design, *, diameter_mm: float | None = None, length_mm: float | None = None) -> tuple[Size, ...]:
    """Return all sizes with this label diameter and length, the smallest and shortest first; None matches any.

    Raises
    ------
    DeviceError
        When the device is not made in that size; the sentence says what there is.
    """
    fits = [
        size for size in design.sizes if diameter_mm in (None, size.diameter_mm) and length_mm in (None, size.length_mm)
    ]
    if fits:
        return tuple(sorted(fits, key=lambda size: (size.diameter_mm, size.length_mm)))
    asked = " x ".join(f"{value:g} mm" for value in (diameter_mm, length_mm) if value is not None)
    same = [size for size in design.sizes if size.diameter_mm == diameter_mm]
    offered = _listed(size.length_mm for size in same) if same else _listed(size.diameter_mm for size in design.sizes)
    what = f"in {diameter_mm:g} mm its lengths are" if same else "its diameters are"
    raise DeviceError(f"{design.name} is not made in {asked}: {what} {offered} mm. Choose one of them.")


def find_size(design: Design, *, diameter_mm: float | None = None, length_mm: float | None = None) -> Size:
    """Return the smallest and shortest size of `find_sizes`, and raise what that raises."""
    return find_sizes(design, diameter_mm=diameter_mm, length_mm=length_mm)[0]


def _listed(values: Iterable[float]) -> str:
    return ", ".join(f"{value:g}" for value in sorted(set(values)))
