"""What the README says is run: its Python as it stands, its commands through the parser."""

import re
import shlex
from functools import partial
from pathlib import Path

import pytest

import vstent
from vstent import cli
from vstent.flow import simulation
from vstent.flow.indices import indices
from vstent.flow.ostium import ostium
from vstent.flow.settings import FlowSettings, Numerics
from vstent.study import demo

README = (Path(__file__).parents[1] / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_the_python_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    demo.write_scan(tmp_path / "3dra")
    coarse = FlowSettings(numerics=Numerics(cell_size_mm=0.4, max_steps=1200))
    monkeypatch.setattr(simulation, "simulate", partial(simulation.simulate, settings=coarse))
    monkeypatch.chdir(tmp_path)
    (example,) = blocks("python")
    names = {}
    exec(compile(example, "README.md", "exec"), names)
    anatomy = names["anatomy"]
    largest = anatomy.aneurysms[0]
    shapes = largest.sac, ostium(largest, anatomy.vessel.lumen)
    before, after = (indices(names[k], *shapes) for k in ("before", "after"))
    assert before["neck_outflow_mL_s"] == pytest.approx(before["neck_inflow_mL_s"], rel=0.1)
    assert after["mean_sac_velocity_m_s"] < before["mean_sac_velocity_m_s"]


def test_a_public_function_stays_one_when_its_module_is_loaded() -> None:
    for name in vstent.__all__:
        verb = getattr(vstent, name)
        assert callable(verb)
        assert getattr(vstent, name) is verb


def test_every_command_parses() -> None:
    commands = [line for block in blocks("sh") for line in block.splitlines() if line.startswith("vstent ")]
    assert commands
    for command in commands:
        words = shlex.split(command.split("#")[0])[1:]
        assert cli._parser().parse_args(words).command
