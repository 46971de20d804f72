"""Nobody but an own page with the token is let in, and nothing that comes in gets further than it may."""

import io
import zipfile

import app_case
import httpx
import numpy as np
import pydicom
import pytest

from vstent.app import intake, security
from vstent.geometry.image import Image
from vstent.io.dicom_writer import write_dicom
from vstent.io.images import read_image


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    return tmp_path_factory.mktemp("cases")


@pytest.fixture(scope="module")
def client(workspace):
    with app_case.served(workspace) as client:
        yield client


@pytest.fixture
def case(client):
    return client.post("/api/cases", json={"name": "case"}).json()["id"]


@pytest.fixture
def folder(case, workspace):
    """Where what comes in is kept."""
    return workspace / case / "input"


def unknown(client, path, **headers):
    """What somebody without the token is told."""
    return httpx.get(client.base_url.join(path), headers=headers)


def own(client):
    """The server's own name, with its port."""
    return client.base_url.netloc.decode()


def test_without_the_token_nothing_is_told(client):
    paths = ["/", "/api/cases", "/api/catalogue", "/api/openapi.json", "/assets/app.js", "/api/docs"]
    for path in paths:
        assert unknown(client, path).status_code == 401
        assert unknown(client, path, authorization="Bearer wrong").status_code == 401
        assert client.get(path).status_code == 200
    assert unknown(client, "/?token=wrong").status_code == 401


def test_the_printed_address_lets_the_browser_in_and_hides_the_token(client):
    with httpx.Client(base_url=client.base_url) as browser:
        welcome = browser.get(f"/?token={app_case.TOKEN}")
        assert browser.get("/api/cases").status_code == 200
    assert (welcome.status_code, welcome.headers["location"]) == (303, "/")
    cookie = welcome.headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1:1", "127.0.0.1"])
def test_foreign_names_of_this_machine_are_refused(client, host):
    assert client.get("/api/cases", headers={"host": host}).status_code == 403


@pytest.mark.parametrize(
    "headers", [{"origin": "http://evil.example"}, {"origin": "null"}, {"sec-fetch-site": "cross-site"}]
)
def test_foreign_pages_are_refused_even_with_the_token(client, headers):
    assert client.post("/api/cases", json={"name": "x"}, headers=headers).status_code == 403
    assert client.get("/api/cases", headers={"origin": f"http://{own(client)}"}).status_code == 200


def test_every_answer_forbids_what_the_page_does_not_need(client):
    for path in ("/", "/api/cases", "/assets/app.js", "/api/docs", "/nowhere"):
        headers = client.get(path).headers
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe-inline" not in policy
        assert "unsafe-eval" not in policy
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"
    page = client.get("/").text
    assert "<script>" not in page
    assert "style=" not in page
    assert "//" not in page.replace("<!doctype", "")


@pytest.mark.parametrize(
    "name",
    ["../evil.stl", "..\\evil.stl", "/etc/passwd", ".hidden.stl", "a\0b.stl", "x" * 200 + ".stl", "virus.exe", ""],
)
def test_names_that_are_paths_hidden_or_of_another_kind_are_refused(client, case, workspace, name):
    before = sorted(workspace.parent.rglob("*.stl"))
    answer = client.put(f"/api/cases/{case}/input", params={"name": name}, content=b"solid")
    assert answer.status_code == 422
    assert sorted(workspace.parent.rglob("*.stl")) == before


@pytest.mark.parametrize("case_id", ["..", "%2e%2e", "..%2f..%2fetc", "a/../../b", "no-such-case"])
def test_cases_are_no_paths(client, case_id):
    assert client.get(f"/api/cases/{case_id}").status_code in (404, 422)
    assert client.get(f"/api/cases/{case_id}/files/metrics.json").status_code in (404, 422)


@pytest.mark.parametrize("name", ["app.json", "../app.json", "%2e%2e/app.json", "input"])
def test_only_the_three_files_are_handed_out(client, case, name):
    assert client.get(f"/api/cases/{case}/files/{name}").status_code in (404, 422)


def test_bodies_have_limits(client, case, monkeypatch):
    assert client.put(f"/api/cases/{case}/choices", content=b" " * (security.BODY_LIMIT + 1)).status_code == 413
    monkeypatch.setattr(security, "BODY_LIMIT", 1000)
    endless = (b" " * 100 for _ in range(20))  # sent without a length
    assert client.put(f"/api/cases/{case}/choices", content=endless).status_code == 413
    monkeypatch.setattr(security, "UPLOAD_LIMIT", 1000)
    endless = (b"solid " * 50 for _ in range(10))
    assert client.put(f"/api/cases/{case}/input", params={"name": "a.stl"}, content=endless).status_code == 413
    assert client.post(f"/api/cases/{case}/input/done").status_code == 422


def packed(entries):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries:
            archive.writestr(name, content)
    return stream.getvalue()


def test_archives_cannot_write_beside_their_folder(client, case, folder, workspace):
    evil = packed(
        [("../../escaped.stl", b"solid a"), ("/tmp/vstent-absolute.stl", b"solid b"), ("x/.hid.stl", b"solid")]
    )
    answer = client.put(f"/api/cases/{case}/input", params={"name": "scan.zip"}, content=evil)
    assert answer.status_code == 422  # the hidden one is refused; the others lie where they should
    assert sorted(path.name for path in folder.iterdir()) == ["escaped.stl", "vstent-absolute.stl"]
    assert not list(workspace.parent.glob("*.stl"))


def test_archives_that_unpack_to_too_much_are_refused(client, case, folder, monkeypatch):
    monkeypatch.setattr(intake, "UNPACKED_LIMIT", 100_000)
    bomb = packed([("a.stl", bytes(60_000)), ("b.stl", bytes(60_000))])
    assert len(bomb) < 1000
    answer = client.put(f"/api/cases/{case}/input", params={"name": "bomb.zip"}, content=bomb)
    assert answer.status_code == 422
    assert "too much" in answer.json()["detail"]
    assert not list(folder.iterdir())


def test_sizes_in_an_archive_are_not_believed(client, case, monkeypatch):
    monkeypatch.setattr(intake, "UNPACKED_LIMIT", 100_000)
    honest = packed([("a.stl", bytes(300_000))])
    lying = honest.replace((300_000).to_bytes(4, "little"), (1000).to_bytes(4, "little"))
    assert lying != honest
    answer = client.put(f"/api/cases/{case}/input", params={"name": "bomb.zip"}, content=lying)
    assert answer.status_code == 422


def test_compressed_volumes_that_unpack_to_too_much_are_refused(client, case, monkeypatch):
    import gzip

    monkeypatch.setattr(intake, "UNPACKED_LIMIT", 100_000)
    answer = client.put(f"/api/cases/{case}/input", params={"name": "a.nii.gz"}, content=gzip.compress(bytes(200_000)))
    assert answer.status_code == 422
    assert "too much" in answer.json()["detail"]


def test_the_patient_is_dropped_at_the_door_and_the_voxels_are_not(client, case, folder, tmp_path):
    rng = np.random.default_rng(1)
    given = tmp_path / "given"
    write_dicom(Image(rng.integers(0, 2000, (20, 24, 6), dtype=np.int16), np.diag([0.4, 0.4, 0.5, 1.0]), "XA"), given)
    secret = "MUSTERMANN^ERIKA"
    for path in given.iterdir():
        dataset = pydicom.dcmread(path)
        dataset.PatientName, dataset.PatientID, dataset.PatientBirthDate = secret, "4711-SECRET", "19640812"
        dataset.InstitutionName = "SECRET HOSPITAL"
        block = dataset.private_block(0x0011, "SECRET MAKER", create=True)
        block.add_new(0x01, "LO", "SECRET NOTE")
        dataset.save_as(path)
        renamed = f"MUSTERMANN-{path.name}"
        answer = client.put(f"/api/cases/{case}/input", params={"name": renamed}, content=path.read_bytes())
        assert answer.status_code == 200
    for path in folder.parent.rglob("*"):
        assert "MUSTERMANN" not in path.name
        if path.is_file():
            content = path.read_bytes()
            assert not [word for word in (b"MUSTERMANN", b"SECRET", b"19640812") if word in content]
    before, after = read_image(given), read_image(folder / "series")
    np.testing.assert_array_equal(after.voxels, before.voxels)
    np.testing.assert_allclose(after.affine_mm, before.affine_mm, atol=1e-9)
