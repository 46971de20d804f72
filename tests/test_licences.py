"""The list of licences: SPDX expressions are understood, what is needed is found, what is not allowed is refused."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))
from licences import is_allowed, main, needed


@pytest.mark.parametrize(
    ("expression", "allowed"),
    [
        ("MIT", True),
        ("BSD-3-Clause AND Zlib", True),
        ("GPL-3.0-only", False),
        ("MIT AND GPL-3.0-only", False),
        ("GPL-3.0-only OR MIT", True),
        ("MIT AND (GPL-2.0-only OR ISC)", True),
        ("(MIT AND GPL-2.0-only) OR LGPL-3.0-only", False),
        ("Apache-2.0 WITH LLVM-exception", True),
        ("Apache-2.0 WITH Classpath-exception-2.0", False),
        ("MIT MIT", False),
        ("", False),
    ],
)
def test_expressions_are_understood(expression: str, allowed: bool) -> None:
    assert is_allowed(expression) is allowed


def put(folder: Path, name: str, *lines: str) -> None:
    """Install a distribution of nothing but its metadata."""
    info = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    info.mkdir()
    text = "\n".join(["Metadata-Version: 2.4", f"Name: {name}", "Version: 1.0", *lines])
    (info / "METADATA").write_text(text + "\n")


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A root that needs one package, which needs another; an extra; and what is not for this machine."""
    put(
        tmp_path,
        "fake-root",
        "Provides-Extra: more",
        "Requires-Dist: Fake.One>=1",
        'Requires-Dist: fake-extra; extra == "more"',
        'Requires-Dist: fake-elsewhere; sys_platform == "nowhere"',
    )
    put(tmp_path, "fake-one", "License: BSD 3-Clause License", "Requires-Dist: fake-deep")
    put(tmp_path, "fake-deep", "Classifier: License :: OSI Approved :: MIT License", "Requires-Dist: fake-one")
    put(tmp_path, "fake-extra", "License-Expression: Apache-2.0")
    put(tmp_path, "fake-elsewhere", "License-Expression: GPL-3.0-only")
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


@pytest.mark.usefixtures("site")
def test_all_that_is_needed_is_found_once_and_allowed() -> None:
    found = {package.name: package.licence for package in needed("fake-root")}
    assert found == {"fake-deep": "MIT", "fake-extra": "Apache-2.0", "fake-one": "BSD-3-Clause"}
    assert main("fake-root") == 0


def test_a_licence_that_is_not_on_the_list_is_refused_wherever_it_hides(
    site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    deep = site / "fake_deep-1.0.dist-info" / "METADATA"
    deep.write_text(deep.read_text().replace("MIT License", "GNU General Public License v3 (GPLv3)"))
    assert main("fake-root") == 1
    assert "1 not on the list: fake-deep" in capsys.readouterr().out
    deep.write_text("Metadata-Version: 2.1\nName: fake-deep\nVersion: 1.0\n")
    assert main("fake-root") == 1


def test_what_vstent_needs_is_allowed() -> None:
    assert main() == 0
    assert {"numpy", "numba", "vtk"} <= {package.name for package in needed("vstent")}
