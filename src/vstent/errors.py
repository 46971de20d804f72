"""Everything that vstent raises.

The tree::

    VstentError
    ├── InputError              what was given cannot be used (exit code 2 at the command line)
    │   ├── ReadError           a file is missing, damaged, or not what its name says
    │   ├── UnitError           a size that no intracranial vessel has, or a spacing that is not known
    │   ├── VesselError         a surface without a lumen to work in: no openings, no volume, no path
    │   ├── DeviceError         a device, size or wire that does not exist
    │   ├── LandingError        a landing zone that does not fit the artery
    │   └── PluginError         a plug-in that does not exist or cannot be loaded
    ├── FlowError               a flow computation that cannot start or has diverged
    └── FolderError             a case folder that another process works in, or that cannot be written to

Each message says what, where (mm), why, and one thing to do.
"""


class VstentError(Exception):
    """Base of every error that vstent raises on purpose."""


class InputError(VstentError):
    """What was given cannot be used."""


class ReadError(InputError):
    """A file is missing, damaged, or not what its name says."""


class UnitError(InputError):
    """A size that no intracranial vessel has, or a spacing that is not known."""


class VesselError(InputError):
    """A surface without a lumen to work in."""


class DeviceError(InputError):
    """A device, size or wire that does not exist."""


class LandingError(InputError):
    """A landing zone that does not fit the artery."""

    def __init__(self, sentence: str, move_mm: float = 0.0) -> None:
        super().__init__(sentence)
        self.move_mm = move_mm
        """How far along the artery (above zero: distally) to move the device; 0 where that is no help."""


class PluginError(InputError):
    """A plug-in that does not exist or cannot be loaded."""


class FlowError(VstentError):
    """A flow computation that cannot start or has diverged."""


class FolderError(VstentError):
    """A case folder that another process works in, or that cannot be written to."""
