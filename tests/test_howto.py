"""The commands of every how-to page run in their order on the demo, as somebody does who follows the page."""

import re
import shlex
import shutil
from pathlib import Path
from textwrap import dedent

import nibabel
import numpy as np
import pytest
from forks import PHANTOM

from vstent import cli, phantoms
from vstent.devices.catalogue import catalogue, entry_of
from vstent.io.images import read_image
from vstent.io.writers import write_stl
from vstent.study import demo

PAGES = sorted((Path(__file__).parents[1] / "docs" / "howto").glob("*.rst"))
LITERAL = re.compile(r"(?:::|code-block:: (?:sh|text))\n\n((?:(?: +.*)?\n)+)")
APART = {"--slurm", "--gpu", "app"}
"""What needs a cluster, a GPU or a browser."""
LEFT_OUT = {"--engine", "openfoam", "--metal", "2500"}
"""Words that are left out: OpenFOAM may not be there, and the scan of the demo shows no metal."""
BY_FLOW = {"choose_outlets", "measured_inflow", "see_an_angiogram", "compare_treatments", "use_openfoam"}
"""Pages whose commands make no sense without a flow; those of the others leave it out here."""
FORK = {"stents_at_a_fork", "compare_treatments"}
"""Pages whose artery ends in a fork."""
FRAME = re.compile(r"[\s│┃]+")
"""Spaces, line ends and the frames of tables."""
ACROSS_MM = np.linspace(-1.9, 1.9, 9)


def of_patients(folder: Path) -> None:
    """Write the tables that a user measures or writes, as the pages show them."""
    wide = "R_p (mmHg s/mL), C (mL/mmHg), R_d\n7.1, 0.0265, 19.1\n117, 0.0016, 313\n"
    (folder / "outlets.csv").write_text(wide, encoding="utf-8")
    (folder / "flow.csv").write_text("time_s,flow_mL_s\n0,3\n0.1,4\n0.2,5\n0.5,3.5\n0.9,3\n", encoding="utf-8")
    speeds = [(x, y, 0.5 * (1 - (x**2 + y**2) / 4)) for x in ACROSS_MM for y in ACROSS_MM if x**2 + y**2 < 4]
    rows = "".join(f"{x:.3f},{y:.3f},{speed:.4f}\n" for x, y, speed in speeds)
    (folder / "pcmri.csv").write_text(f"x,y,speed\n{rows}", encoding="utf-8")
    listed = "case,input,device,no-flow\nfirst,cohort/first.stl,silk,yes\n"
    (folder / "cases.csv").write_text(listed, encoding="utf-8")


def commands(page: Path) -> list[list[str]]:
    """The words of every command of vstent in the literal blocks of a page."""
    text = "".join(dedent(block) for block in LITERAL.findall(page.read_text(encoding="utf-8")))
    lines = text.replace("\\\n", " ").splitlines()
    return [shlex.split(line, comments=True)[1:] for line in lines if line.lstrip().startswith("vstent ")]


def promised(page: Path) -> list[str]:
    """What the last paragraph of a page quotes, where it is a number: its commands print or write that."""
    return re.findall(r"``([^`]*\d[^`]*)``", page.read_text(encoding="utf-8").rstrip().rsplit("\n\n", 1)[-1])


@pytest.fixture(scope="session")
def of_demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the inputs that the pages name, all made from the demo."""
    folder = tmp_path_factory.mktemp("inputs")
    demo.write_scan(folder / "demo" / "scan")
    surface = phantoms.phantom_surface(phantoms.demo_phantom(), edge_mm=0.3)
    (folder / "cohort").mkdir()
    for name in ("artery.stl", "cohort/first.stl", "cohort/second.stl"):
        write_stl(folder / name, surface)
    image = read_image(folder / "demo" / "scan")
    ras = np.diag([-1.0, -1.0, 1.0, 1.0]) @ image.affine_mm
    for name, voxels in (("scan.nii.gz", image.voxels), ("mask.nii.gz", (image.voxels > 1000).astype(np.uint8))):
        nibabel.save(nibabel.Nifti1Image(np.asarray(voxels), ras), folder / name)
    for name in ("dicom", "after"):
        shutil.copytree(folder / "demo" / "scan", folder / name)
    (folder / "examination").mkdir()
    shutil.copy(min((folder / "dicom").iterdir()), folder / "examination" / "IM0001.dcm")
    write_stl(folder / "fork.stl", phantoms.phantom_surface(PHANTOM, edge_mm=0.3))
    (folder / "mine.toml").write_text(
        entry_of("silk").replace('"silk"', '"mine"').replace('"Silk"', '"Mine"'), encoding="utf-8"
    )
    of_patients(folder)
    return folder


@pytest.mark.system
@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=lambda page: page.stem)
def test_every_command_of_a_page_runs(page, of_demo, tmp_path, monkeypatch, capsys):
    for entry in of_demo.iterdir():
        (tmp_path / entry.name).symlink_to(entry)
    if page.stem in FORK:
        (tmp_path / "artery.stl").unlink()
        (tmp_path / "artery.stl").symlink_to(of_demo / "fork.stl")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("COLUMNS", "200")
    seen: list[str] = []
    catalogue.cache_clear()
    for words in commands(page):
        if APART & set(words):
            continue
        target = words.index(">") if ">" in words else None
        given = [word for word in words[:target] if word not in LEFT_OUT or words[0] == "export"]
        if given[0] in ("run", "rank", "batch") and "--no-flow" not in given:
            given += ["--grid-spacing", "0.5"] if page.stem in BY_FLOW or given[0] == "rank" else ["--no-flow"]
        code, (out, err) = cli.main(given), capsys.readouterr()
        assert code == 0, err
        seen += [out, err]
        if target is not None:
            Path(words[target + 1]).write_text(out, encoding="utf-8")
    seen += [path.read_text(encoding="utf-8").replace('"', "") for path in tmp_path.glob("*/metrics.json")]
    plain = FRAME.sub(" ", " ".join(seen))
    assert bool(promised(page)) == bool(seen)
    assert [one for one in promised(page) if FRAME.sub(" ", one) not in plain] == []
