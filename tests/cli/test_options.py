"""Options: every command's help has an example that parses, and every option is explained."""

import argparse
import re
import shlex
from pathlib import Path

import pytest

from vstent import cli


def parsers(parser: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    """Return a parser and those of all commands below it."""
    below = [one for a in parser._actions if isinstance(a, argparse._SubParsersAction) for one in a.choices.values()]
    return [parser, *(one for child in below for one in parsers(child))]


@pytest.mark.parametrize("command", parsers(cli._parser())[1:], ids=lambda one: one.prog)
def test_every_help_has_a_summary_and_an_example_that_parses(command: argparse.ArgumentParser) -> None:
    text = command.format_help()
    assert re.match(r"(?s)[A-Z].*\.$", command.description)
    assert max(map(len, command.description.splitlines())) <= 80
    example = re.search(r"Example:\n  vstent (.*)\n", text)
    assert example, text
    assert example[1].startswith(command.prog.removeprefix("vstent "))
    assert cli._parser().parse_args(shlex.split(example[1])).command
    assert "Research use only" in text


@pytest.mark.parametrize("command", ["run", "flow", "rank"])
@pytest.mark.parametrize("names", [("silk", "silk"), ("silk", "Silk")])
def test_a_device_that_is_given_twice_is_refused(
    command: str, names: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [word for name in names for word in ("--device", name)]
    assert cli.main([command, str(tmp_path / "none.stl"), "--out", str(tmp_path / "out"), *words]) == 2
    assert "treatments are called silk: give each a name of its own" in capsys.readouterr().err


@pytest.mark.parametrize("command", parsers(cli._parser())[1:], ids=lambda one: one.prog)
def test_every_option_is_explained(command: argparse.ArgumentParser) -> None:
    assert all(action.help for action in command._actions if not isinstance(action, argparse._SubParsersAction))
