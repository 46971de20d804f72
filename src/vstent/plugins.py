"""Plug-ins: entry points of other packages, in two groups.

``vstent.devices``: a function that returns a device catalogue as TOML text in which every number has its source.

``vstent.engines``: a class derived from `vstent.flow.engines.AbstractEngine`, created with the grid spacing in mm and a
folder that it may write to.
"""

from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal

from vstent.errors import PluginError

Group = Literal["vstent.devices", "vstent.engines"]
"""Entry point groups."""


def plugins(group: Group) -> dict[str, EntryPoint]:
    """Return the installed entry points of a group by name; PluginError is raised where two packages use one name."""
    found: dict[str, EntryPoint] = {}
    for entry in entry_points(group=group):
        if entry.name in found and found[entry.name].value != entry.value:
            raise PluginError(
                f"Two plug-ins of {group} are called {entry.name}: {found[entry.name].value} and {entry.value}. "
                "Uninstall one of them."
            )
        found[entry.name] = entry
    return dict(sorted(found.items()))


def load(group: Group, name: str, *, built_in: str) -> Any:
    """Load a plug-in of a group by its name.

    PluginError is raised where none has that name, listing the built-in choice too, or where it cannot be loaded.
    """
    found = plugins(group)
    if name not in found:
        raise PluginError(f"There is no {name!r} in {group}: choose one of {', '.join([built_in, *found])}.")
    try:
        return found[name].load()
    except Exception as error:  # foreign code may raise anything
        raise PluginError(
            f"The plug-in {name} of {group} cannot be loaded ({error}). Reinstall its package."
        ) from error
