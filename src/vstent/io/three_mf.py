"""Write a surface in mm as a 3MF file for printers and CAD: XML in a zip file (3MF Core Specification 1.3)."""

from pathlib import Path
from typing import Final
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import numpy as np

from vstent.geometry.surface import Surface
from vstent.io.files import atomic
from vstent.kernels.digits import text_rows

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
    vertices = text_rows(['<vertex x="', '" y="', '" z="', '"/>'], micros, DECIMALS)
    triangles = text_rows(['<triangle v1="', '" v2="', '" v3="', '"/>'], surface.faces, 0)
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
