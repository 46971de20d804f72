"""Exceptions of vstent.

Class hierarchy::

    VstentError
    ├── InputError              an input or option cannot be used (exit code 2 at the command line)
    │   ├── ReadError           a file is missing, damaged, or not what its name says
    │   ├── UnitError           a size of no intracranial vessel, or an unknown spacing
    │   ├── VesselError         a surface without a usable lumen: no openings, no volume, no path
    │   ├── DeviceError         a device, size or wire that does not exist
    │   ├── LandingError        a landing zone that does not fit the artery
    │   └── PluginError         a plug-in that does not exist or cannot be loaded
    ├── FlowError               a flow computation that cannot start or that diverged
    └── FolderError             a case folder that another process uses, or that cannot be written

Each message says what is wrong, where (mm), and what to do.
"""


class VstentError(Exception):
    """Base class of all errors that vstent raises."""


class InputError(VstentError):
    """An input or option cannot be used."""


class ReadError(InputError):
    """A file is missing, damaged, or not what its name says."""


class UnitError(InputError):
    """A size of no intracranial vessel, or an unknown spacing."""


class VesselError(InputError):
    """A surface without a usable lumen."""


class DeviceError(InputError):
    """A device, size or wire that does not exist."""


class LandingError(InputError):
    """A landing zone that does not fit the artery."""

    def __init__(self, sentence: str, move_mm: float = 0.0) -> None:
        super().__init__(sentence)
        self.move_mm = move_mm
        """Distance in mm along the artery (positive: distal) to move the device by; 0 where that does not help."""


class PluginError(InputError):
    """A plug-in that does not exist or cannot be loaded."""


class FlowError(VstentError):
    """A flow computation that cannot start or that diverged."""


class FolderError(VstentError):
    """A case folder that another process uses, or that cannot be written."""
