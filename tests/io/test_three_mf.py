"""3MF files, read back as a printer's software would."""

import xml.etree.ElementTree as ET
from zipfile import ZipFile

import numpy as np
import pytest
from tubes import line, tube

from vstent.deployment.deploy import deploy
from vstent.deployment.struts import struts
from vstent.devices import catalogue
from vstent.devices.stent import Landing
from vstent.geometry.surface import Surface
from vstent.io.three_mf import NAMESPACE, write_3mf


def read_3mf(path):
    with ZipFile(path) as archive:
        assert archive.testzip() is None
        target = ET.fromstring(archive.read("_rels/.rels"))[0].get("Target")
        model = ET.fromstring(archive.read(target.lstrip("/")))
    tag = {"m": NAMESPACE}
    (mesh,) = model.findall("m:resources/m:object/m:mesh", tag)
    vertices = [[float(v.get(k)) for k in "xyz"] for v in mesh.find("m:vertices", tag)]
    faces = [[int(t.get(k)) for k in ("v1", "v2", "v3")] for t in mesh.find("m:triangles", tag)]
    wanted = {item.get("objectid") for item in model.findall("m:build/m:item", tag)}
    assert wanted == {thing.get("id") for thing in model.findall("m:resources/m:object", tag)}
    return model.get("unit"), Surface(vertices, faces)


@pytest.mark.parametrize("key", ["lvis", "enterprise"])
def test_struts_come_back_in_millimetres_closed_and_with_their_volume(tmp_path, key):
    design = catalogue.find_design(key)
    solid = struts(deploy(design, tube(line(40), 1.9, around=60), size=design.sizes[0], landing=Landing(20.0)).stent)
    write_3mf(tmp_path / "struts.3mf", solid)
    unit, read = read_3mf(tmp_path / "struts.3mf")
    assert unit == "millimeter"
    assert read.volume_mm3 == pytest.approx(solid.volume_mm3, rel=1e-4)
    assert np.abs(read.vertices_mm - solid.vertices_mm).max() <= 0.5000001e-6
    assert np.array_equal(read.faces, solid.faces)
    edges = np.concatenate([read.faces[:, [0, 1]], read.faces[:, [1, 2]], read.faces[:, [2, 0]]])
    there, back = ({tuple(edge) for edge in way.tolist()} for way in (edges, edges[:, ::-1]))
    assert len(there) == len(edges)  # every edge once each way: closed, and all triangles turn the same way
    assert there == back


def test_the_same_surface_gives_the_same_file(tmp_path):
    corner = Surface([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    for name in "ab":
        write_3mf(tmp_path / name, corner)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_every_number_is_written_as_python_writes_it(tmp_path):
    rng = np.random.default_rng(5)
    vertices = np.concatenate([rng.uniform(-2, 2, (200, 3)) * 10.0 ** rng.integers(-7, 4, (200, 3)), np.zeros((1, 3))])
    solid = Surface(vertices, rng.integers(0, 201, (300, 3)))
    write_3mf(tmp_path / "solid.3mf", solid)
    model = ZipFile(tmp_path / "solid.3mf").read("3D/3dmodel.model").decode()
    rows = [" ".join(f'{k}="{v:.6f}"' for k, v in zip("xyz", p, strict=True)) for p in vertices.tolist()]
    wanted = "\n".join(f"<vertex {row}/>".replace('"-0.000000"', '"0.000000"') for row in rows)
    assert model.split("<vertices>\n")[1].split("\n</vertices>")[0] == wanted
    wanted = "\n".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in solid.faces.tolist())
    assert model.split("<triangles>\n")[1].split("\n</triangles>")[0] == wanted
