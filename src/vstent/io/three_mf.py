"""Write a surface in mm as a 3MF file for printers and CAD: XML in a zip file (3MF Core Specification 1.3)."""

from pathlib import Path
from typing import Final
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import numpy as np
from numpy.typing import NDArray

from vstent.geometry.surface import Surface
from vstent.io.files import atomic
from vstent.kernels.arrays import Bools, Ints

NAMESPACE: Final = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
"""XML namespace of the 3MF core specification."""
_TYPES: Final = """<?xml version="1.0" encoding="UTF-8"?>
<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">
<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>
<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/>
</Types>
"""
_RELATIONS: Final = """<?xml version="1.0" encoding="UTF-8"?>
<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">
<Relationship Target="/3D/3dmodel.model" Id="rel0" Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/>
</Relationships>
"""
_MODEL: Final = """<?xml version="1.0" encoding="UTF-8"?>
<model unit="millimeter" xml:lang="en-US" xmlns="{namespace}">
<resources><object id="1" type="model"><mesh>
<vertices>
{vertices}
</vertices>
<triangles>
{triangles}
</triangles>
</mesh></object></resources>
<build><item objectid="1"/></build>
</model>
"""
_LONG_AGO: Final = (1980, 1, 1, 0, 0, 0)
"""Date of every file in the archive, so that equal surfaces give equal files."""


DECIMALS: Final = 6
"""Number of decimals of a coordinate in mm."""


def write_3mf(path: Path, surface: Surface) -> None:
    """Write a closed surface in mm as 3MF; neighboring triangles share vertices."""
    micros = np.rint(surface.vertices_mm * 10**DECIMALS).astype(np.int64)
    vertices = _rows(['<vertex x="', '" y="', '" z="', '"/>'], micros, DECIMALS)
    triangles = _rows(['<triangle v1="', '" v2="', '" v3="', '"/>'], surface.faces, 0)
    head, middle, tail = _MODEL.format(namespace=NAMESPACE, vertices="\0", triangles="\0").encode().split(b"\0")
    model = b"".join((head, vertices, middle, triangles, tail))
    parts: dict[str, str | bytes] = {
        "[Content_Types].xml": _TYPES,
        "_rels/.rels": _RELATIONS,
        "3D/3dmodel.model": model,
    }
    with atomic(path) as partial, ZipFile(partial, "w", ZIP_DEFLATED, compresslevel=1) as archive:
        for name, content in parts.items():
            part = ZipInfo(name, _LONG_AGO)
            part.compress_type = ZIP_DEFLATED
            archive.writestr(part, content)


def _rows(words: list[str], numbers: Ints, decimals: int) -> bytes:
    """Return one line per row of whole numbers (n, k), written with a decimal point, between k + 1 words.

    All lines are built at once, as characters (n, width) of which only some are kept: formatting them one by one takes
    several times as long.
    """
    characters, kept = [], []
    for k in range(numbers.shape[1]):
        word = np.frombuffer(words[k].encode(), np.uint8)
        digits, is_kept = _digits(numbers[:, k], decimals)
        characters += [np.broadcast_to(word, (len(numbers), len(word))), digits]
        kept += [np.ones((len(numbers), len(word)), bool), is_kept]
    last = np.frombuffer((words[-1] + "\n").encode(), np.uint8)
    characters.append(np.broadcast_to(last, (len(numbers), len(last))))
    kept.append(np.ones((len(numbers), len(last)), bool))
    return np.concatenate(characters, axis=1)[np.concatenate(kept, axis=1)].tobytes().removesuffix(b"\n")


def _digits(numbers: Ints, decimals: int) -> tuple[NDArray[np.uint8], Bools]:
    """Return whole numbers (n,) divided by 10^decimals as characters (n, width), and which of these to keep."""
    size = np.abs(numbers)
    width = max(decimals + 1, len(str(int(size.max(initial=0)))))
    digits = np.zeros((len(size), width), np.uint8)
    left = size.copy()
    for column in range(width - 1, -1, -1):
        left, digits[:, column] = left // 10, left % 10
    is_kept = np.maximum.accumulate(digits > 0, axis=1)
    is_kept[:, width - decimals - 1 :] = True
    sign, point = (
        np.full((len(size), 1), ord("-"), np.uint8),
        np.full((len(size), min(decimals, 1)), ord("."), np.uint8),
    )
    ahead, behind = np.split(digits + np.uint8(ord("0")), [width - decimals], axis=1)
    keep_ahead, keep_behind = np.split(is_kept, [width - decimals], axis=1)
    keep = np.concatenate([(numbers < 0)[:, None], keep_ahead, np.ones_like(point, bool), keep_behind], axis=1)
    return np.concatenate([sign, ahead, point, behind], axis=1), keep
