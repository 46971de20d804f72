"""Plug-ins: what other distributions add to vstent by entry points, in three groups.

``vstent.devices``: a function that returns a catalogue, TOML text in which every number has its source.

``vstent.engines``: a class of `vstent.flow.engines.AbstractEngine`, made with the cell size in mm and a folder of its
own, in which it may write.

``vstent.walls``: a class of `vstent.deployment.wall.AbstractWall`, made with the surface.
"""

from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal

from vstent.errors import PluginError

Group = Literal["vstent.devices", "vstent.engines", "vstent.walls"]


def plugins(group: Group) -> dict[str, EntryPoint]:
    """Return what is installed for a group, by name.

    Raises
    ------
    PluginError
        When two distributions use one name.
    """
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
    """Return what a plug-in leads to; `built_in` names what there is without any, for the sentence.

    Raises
    ------
    PluginError
        When there is none of that name, or it cannot be loaded.
    """
    found = plugins(group)
    if name not in found:
        raise PluginError(f"There is no {name!r} in {group}: choose one of {', '.join([built_in, *found])}.")
    try:
        return found[name].load()
    except Exception as error:  # another's code may raise anything
        raise PluginError(f"The plug-in {name} of {group} cannot be loaded ({error}): reinstall it.") from error
