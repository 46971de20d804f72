"""Options: old names are accepted with a notice, and every command's help has an example that parses."""

import argparse
import re
import shlex

import pytest

from vstent import cli
from vstent.cli.options import RENAMED, renamed

VALUES = {"--cell-size": ["0.2"], "--uncertain-flows": ["2"]}
"""Values of the options that take one."""
COMMAND_OF = {"--files": "batch"}
"""Command that has the option, where that is not ``run``."""


@pytest.mark.parametrize("joined", [False, True])
@pytest.mark.parametrize("old", RENAMED)
def test_an_old_name_gives_what_the_new_one_gives_and_a_notice(old: str, joined: bool) -> None:
    values = VALUES.get(old, [])
    words = [COMMAND_OF.get(old, "run"), "input", "--out", "out"]
    given = [f"{old}={values[0]}"] if joined and values else [old, *values]
    now, notices = renamed([*words, *given])
    assert vars(cli._parser().parse_args(now)) == vars(cli._parser().parse_args([*words, RENAMED[old], *values]))
    assert notices == [f"{old} is now called {RENAMED[old]}; the old name is accepted until version 0.3."]
    with pytest.raises(SystemExit):
        cli._parser().parse_args([*words, old, *values])  # only through the notice


def test_the_notice_is_printed_on_standard_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", "no.stl", "--out", "out", "--device-gpu", "--no-flow"]) == 2
    assert "vstent: note: --device-gpu is now called --gpu" in capsys.readouterr().err


def test_new_names_get_no_notice() -> None:
    words = ["run", "in", "--grid-spacing", "0.1", "--gpu"]
    assert renamed(words) == (words, [])


def parsers(parser: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    """Return a parser and those of all commands below it."""
    below = [one for a in parser._actions if isinstance(a, argparse._SubParsersAction) for one in a.choices.values()]
    return [parser, *(one for child in below for one in parsers(child))]


@pytest.mark.parametrize("command", parsers(cli._parser())[1:], ids=lambda one: one.prog)
def test_every_help_has_a_summary_and_an_example_that_parses(command: argparse.ArgumentParser) -> None:
    text = command.format_help()
    assert re.match(r"[A-Z].*\.$", command.description)
    example = re.search(r"Example:\n  vstent (.*)\n", text)
    assert example, text
    assert example[1].startswith(command.prog.removeprefix("vstent "))
    assert cli._parser().parse_args(shlex.split(example[1])).command
    assert "Research use only" in text


@pytest.mark.parametrize("command", parsers(cli._parser())[1:], ids=lambda one: one.prog)
def test_every_option_is_explained(command: argparse.ArgumentParser) -> None:
    assert all(action.help for action in command._actions if not isinstance(action, argparse._SubParsersAction))
