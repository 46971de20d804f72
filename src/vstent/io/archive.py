"""Save and load vstent's data classes, one compressed file each, so that a study can resume.

An archive is a NumPy .npz file. It holds the arrays and, in the entry ``noun``, a JSON text that describes their
structure. It contains no pickle: loading runs only the constructors of vstent's own data classes.
"""

import dataclasses
import importlib
import json
import zipfile
import zlib
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from vstent.errors import ReadError
from vstent.io.files import atomic, existing

Saved = TypeVar("Saved")

_ROOT: Final = "vstent."
"""Prefix of the modules whose data classes may be loaded."""
_KIND: Final = "is"
"""Key of the JSON text that states the kind of a value."""
DAMAGE: Final = (
    *(OSError, ValueError, KeyError, TypeError, AttributeError, ImportError, EOFError, NotImplementedError),
    *(RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error),
)
"""Exceptions that reading a damaged archive raises."""
MOST_BYTES: Final = 1 << 33
"""Largest unpacked size of an archive."""


def save_data(path: Path, value: Any) -> None:
    """Write a data class of vstent with everything it contains.

    Fields may be arrays, numbers, strings, booleans, None, tuples, lists, dictionaries with string keys, and data
    classes of vstent, nested to any depth. TypeError is raised for another type; nothing is written then.
    """
    arrays: dict[str, NDArray[Any]] = {}
    text = json.dumps(_packed(value, arrays))
    arrays["noun"] = np.frombuffer(text.encode(), dtype=np.uint8)
    with atomic(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def load_data(path: Path, kind: type[Saved]) -> Saved:
    """Read a data class of the type `kind`, written by `save_data`.

    ReadError is raised where the file is missing, damaged, of another version, or holds another type.
    """
    path = existing(path)
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            if sum(entry.file_size for entry in archive.zip.infolist()) > MOST_BYTES:
                raise ValueError("the archive unpacks to too many bytes")
            value = _unpacked(json.loads(archive["noun"].tobytes()), archive)
    except DAMAGE:
        raise ReadError(
            f"{path} is damaged or was written by another version. Delete it to compute it again."
        ) from None
    if not isinstance(value, kind):
        raise ReadError(
            f"{path} holds a {type(value).__name__} where a {kind.__name__} is needed. Delete it to compute it again."
        )
    return value


def _packed(value: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    """Return a value as JSON types; its arrays are added to `arrays`."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, np.ndarray) and value.dtype != object:
        name = f"a{len(arrays)}"
        arrays[name] = value
        return {_KIND: "array", "name": name}
    if isinstance(value, (tuple, list)):
        return {_KIND: type(value).__name__, "items": [_packed(item, arrays) for item in value]}
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {_KIND: "dict", "items": {key: _packed(item, arrays) for key, item in value.items()}}
    if dataclasses.is_dataclass(value) and type(value).__module__.startswith(_ROOT):
        fields = {f.name: _packed(getattr(value, f.name), arrays) for f in dataclasses.fields(value) if f.init}
        return {_KIND: "noun", "module": type(value).__module__, "class": type(value).__qualname__, "fields": fields}
    raise TypeError(f"a {type(value).__name__} cannot be archived")


def _unpacked(value: Any, archive: Any) -> Any:
    """Return the value that JSON types and arrays describe."""
    if not isinstance(value, dict):
        return value
    kind = value[_KIND]
    if kind == "array":
        return archive[value["name"]]
    if kind in ("tuple", "list"):
        items = [_unpacked(item, archive) for item in value["items"]]
        return tuple(items) if kind == "tuple" else items
    if kind == "dict":
        return {key: _unpacked(item, archive) for key, item in value["items"].items()}
    module, name = value["module"], value["class"]
    noun = getattr(importlib.import_module(module), name) if module.startswith(_ROOT) else None
    if not (isinstance(noun, type) and dataclasses.is_dataclass(noun) and noun.__module__ == module):
        raise ValueError(f"{module}.{name} is not a data class of vstent")
    return noun(**{name: _unpacked(item, archive) for name, item in value["fields"].items()})
