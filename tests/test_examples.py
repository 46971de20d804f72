"""What README and docs show is run: every block of Python in order, every command through the parser."""

import ast
import re
import shlex
from functools import partial
from pathlib import Path
from textwrap import dedent
from typing import Any

import pytest

import vstent
from vstent import cli, phantoms
from vstent.flow import simulation
from vstent.io.writers import write_stl
from vstent.study import demo
from vstent.study.stages import measure_study

HERE = Path(__file__).parents[1]
TEXTS = [HERE / "README.md", HERE / "CONTRIBUTING.md"]
PAGES = [page for page in sorted((HERE / "docs").rglob("*.rst")) if not {"_build", "examples"} & set(page.parts)]
FENCED = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
LITERAL = re.compile(r"(?:::|^ *\.\. (?:code-block|doctest):: ?(\w*))\n\n((?:(?: +.*)?\n)+)", re.MULTILINE)
COARSE = vstent.FlowSettings(numerics=vstent.Numerics(cell_size_mm=0.5))


def blocks(path: Path, language: str) -> list[str]:
    """The blocks of a language in a file; a literal block of a page that names none counts as each."""
    found = (FENCED if path.suffix == ".md" else LITERAL).findall(path.read_text())
    return [dedent(text) for named, text in found if named in ("", language)]


def python_of(path: Path) -> list[str]:
    return [block for block in blocks(path, "python") if _is_python(block)]


def _is_python(block: str) -> bool:
    """Whether a block is Python and does something: it imports, assigns or calls."""
    try:
        body = ast.parse(block).body
    except SyntaxError:
        return False
    doings = [getattr(statement, "value", statement) for statement in body]
    return any(isinstance(doing, (ast.Import, ast.ImportFrom, ast.Call)) for doing in doings)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the inputs that the examples name: a scan and the wall of its artery."""
    folder = tmp_path_factory.mktemp("examples")
    demo.write_scan(folder / "3dra")
    write_stl(folder / "artery.stl", phantoms.phantom_surface(phantoms.demo_phantom(), edge_mm=0.3))
    return folder


def play(path: Path, capsys: pytest.CaptureFixture[str]) -> tuple[dict[str, Any], list[str]]:
    """Run the blocks of a file in order, as in a notebook; return the names and the last line that each prints."""
    names: dict[str, Any] = {}
    lines = []
    for block in python_of(path):
        exec(compile(block, path.name, "exec"), names)
        lines.append(capsys.readouterr().out.splitlines()[-1])
    return names, lines


def test_readme_says_the_number_of_a_run(
    inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(simulation, "simulate", partial(simulation.simulate, settings=COARSE))
    monkeypatch.chdir(inputs)
    names, (line,) = play(HERE / "README.md", capsys)
    settings = vstent.Settings(treatments=(vstent.read_treatment("silk"),), flow=None)
    studied = vstent.run("3dra", tmp_path, settings)
    anatomy, silk, change = (names[key] for key in ("anatomy", "silk", "change"))
    assert studied.metrics["vessel"] == vstent.morphology(anatomy)
    deployed = studied.metrics["treatments"]["silk"]["implants"]["silk"]
    assert deployed == {"bands": deployed["bands"]} | vstent.measure(anatomy, silk)
    flows = {"bare": names["before"], "silk": names["after"]}
    settings = vstent.Settings(treatments=(), flow=COARSE)
    measured = measure_study(studied.anatomy, studied.implants, flows, settings, {}, {})["treatments"]
    bare, stented = (measured[name] for name in flows)
    assert {key: one.before for key, one in change.items()}.items() <= bare["flow"].items()
    of_outlets = {f"outlet_{k}_{what}" for k in (1, 2) for what in ("share_fraction", "pressure_Pa")}
    assert bare["flow"].keys() - change.keys() == {"unsettled_fraction", *of_outlets}
    assert {key: one.after for key, one in change.items()}.items() <= stented["flow"].items()
    assert {f"{key}_ratio": one.ratio for key, one in change.items()} == stented["change"]
    assert line == f"neck inflow with Silk / without: {stented['change']['neck_inflow_mL_s_ratio']:.2f}"
    assert 0.5 < change["neck_inflow_mL_s"].ratio < 0.8


@pytest.mark.parametrize("page", [page for page in PAGES if python_of(page)], ids=lambda page: page.stem)
def test_every_block_of_a_page_prints_a_number(
    page: Path, inputs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(inputs)
    _, lines = play(page, capsys)
    assert all(re.search(r" \d+\.\d", line) for line in lines), lines


def test_the_blocks_are_found() -> None:
    n_blocks = {path.name: len(python_of(path)) for path in [*TEXTS, *PAGES] if python_of(path)}
    assert n_blocks == {"README.md": 1, "extending.rst": 1, "python_and_jupyter.rst": 3}


def test_every_command_parses() -> None:
    shells = [block for path in [*TEXTS, *PAGES] for block in blocks(path, "sh")]
    lines = [line.strip() for block in shells for line in block.replace("\\\n", " ").splitlines()]
    commands = [line for line in lines if line.startswith("vstent ")]
    assert len(commands) > 20
    for command in commands:
        words = shlex.split(command, comments=True)[1:]
        words = words[: words.index(">")] if ">" in words else words
        assert cli._parser().parse_args(words).command, command
