"""Names and help texts of the options: old names, abbreviations, examples, defaults."""

import argparse
import shlex
from collections.abc import Iterator

import pytest

from vstent import cli
from vstent.cli import options

OLD = {
    "--cell-size": (["flow", "a.stl", "--out", "case"], "0.2"),
    "--close-up": (["run", "a.stl", "--out", "case"], None),
    "--thinning": (["export", "openfoam", "a.stl", "--out", "case"], None),
    "--device-gpu": (["demo"], None),
    "--uncertain-flows": (["run", "a.stl", "--out", "case", "--uncertainty", "8"], "-1"),
    "--files": (["batch", "scans", "--out", "cohort"], None),
    "--crate": (["run", "a.stl", "--out", "case"], None),
}
"""Every old name with a command that has the option, and a value where it takes one."""


def commands(parser: argparse.ArgumentParser, before: str) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Every command with its name, commands of commands included."""
    yield before, parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, command in action.choices.items():
                yield from commands(command, f"{before} {name}")


COMMANDS = dict(commands(cli._parser(), "vstent"))


def test_every_old_name_is_tested() -> None:
    assert set(OLD) == set(options.RENAMED)


@pytest.mark.parametrize("name", OLD)
def test_an_old_name_is_taken_for_the_present_one_with_a_notice(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    command, value = OLD[name]
    present = options.RENAMED[name]
    dest = present.removeprefix("--").replace("-", "_")
    unset = vars(cli.parse(command))[dest]
    for form in ["{}"] if value is None else [f"{{}} {value}", f"{{}}={value}"]:
        wanted = vars(cli.parse([*command, *form.format(present).split()]))
        assert wanted[dest] != unset
        assert capsys.readouterr().err == ""
        assert vars(cli.parse([*command, *form.format(name).split()])) == wanted
        notice = f"vstent: note: {name} is now {present}; the old name will be removed in version 0.3.\n"
        assert capsys.readouterr().err == notice


def test_a_name_given_twice_is_noticed_once_and_words_after_two_dashes_stay() -> None:
    words = ["--device-gpu", "--files", "--device-gpu", "--out=--files", "--", "--files"]
    present, notices = options.with_present_names(words)
    assert present == ["--gpu", "--keep-files", "--gpu", "--out=--files", "--", "--files"]
    assert [notice.split()[1] for notice in notices] == ["--device-gpu", "--files"]


@pytest.mark.parametrize("words", [["--grid", "0.2"], ["--flow", "4"], ["--cell", "0.2"]])
def test_abbreviations_are_refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        cli.parse(["run", "a.stl", "--out", "case", *words])
    assert stopped.value.code == 2
    assert f"unrecognized arguments: {words[0]}" in capsys.readouterr().err


@pytest.mark.parametrize("name", COMMANDS)
def test_every_help_ends_with_an_example_that_parses(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    said = COMMANDS[name].format_help().splitlines()
    example = said[said.index("example:") + 1].strip()
    assert example.startswith(name)
    assert callable(cli.parse(shlex.split(example)[1:]).command)
    assert capsys.readouterr().err == ""
    assert "Research use only" in "\n".join(said[said.index("example:") :])
    assert COMMANDS[name].description.endswith(".")


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_says_its_default_or_that_it_is_required(name: str) -> None:
    for action in COMMANDS[name]._actions:
        if action.option_strings and action.dest not in ("help", "version"):
            said = action.help or ""
            assert "default" in said or (action.required and "(required)" in said), action.option_strings


@pytest.mark.parametrize("name", COMMANDS)
def test_options_stand_in_groups_with_known_titles(name: str) -> None:
    shown = [group for group in COMMANDS[name]._action_groups[2:] if group._group_actions]
    assert [group.title for group in shown] == [title for title in options.GROUPS if title in {g.title for g in shown}]
    for group in COMMANDS[name]._action_groups[:2]:
        dests = {action.dest for action in group._group_actions}
        assert dests <= {"help", "version", argparse.SUPPRESS}, dests
