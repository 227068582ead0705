"""The command line: help, errors, exit codes, commands of other packages."""

import sys
from importlib.metadata import EntryPoint

import pytest
import typer

from clients import cli
from clients.errors import DeliveryError
from gpom_core.errors import ConfigurationError, GpomError

OWN = ("demo", "simulate", "replay", "query", "export", "evaluate")


def fine(name: str = "you") -> None:
    """Greet someone."""
    typer.echo(f"hello {name}")


def refused() -> None:
    """Be asked wrongly."""
    raise ConfigurationError("the number is 3; expected 4")


def failed() -> None:
    """Fail while running."""
    raise DeliveryError("nobody is there")


def broken() -> None:
    """Have a bug."""
    raise KeyError("oops")


several = typer.Typer(help="Do several things.")


@several.command()
def one() -> None:
    """Do one."""
    typer.echo("one")


@several.command()
def two() -> None:
    """Do two."""


@pytest.fixture
def plugins(monkeypatch):
    """Register the commands of this file, and one whose import fails."""
    here = __name__
    monkeypatch.setitem(sys.modules, here, sys.modules[here])
    names = ("fine", "refused", "failed", "broken", "several")
    entries = [EntryPoint(name, f"{here}:{name}", cli.COMMAND_GROUP) for name in names]
    entries.append(EntryPoint("missing", "no_such_module:command", cli.COMMAND_GROUP))
    monkeypatch.setattr(cli, "entry_points", lambda group: entries)


def test_help_lists_all_commands(plugins, capsys):
    assert cli.run(["--help"]) == 0
    shown = capsys.readouterr().out
    for name in (*OWN, "fine", "several", "Greet someone.", "Do several things."):
        assert name in shown


@pytest.mark.parametrize("name", OWN)
def test_every_command_has_help(name, capsys):
    assert cli.run([name, "--help"]) == 0
    assert f"gpom {name}" in capsys.readouterr().out


def test_commands_of_other_packages_run(plugins, capsys):
    assert cli.run(["fine", "--name", "gpom"]) == 0
    assert cli.run(["several", "one"]) == 0
    assert capsys.readouterr().out == "hello gpom\none\n"


@pytest.mark.parametrize("args", [["missing"], ["missing", "--help"], ["missing", "x", "--y", "1"]])
def test_a_command_that_cannot_be_imported_says_so(plugins, capsys, args):
    assert cli.run(args) == 1
    shown = capsys.readouterr().err
    assert "`missing` cannot be loaded from no_such_module:command" in shown
    assert "Traceback" not in shown
    assert cli.run(["fine"]) == 0


def test_a_command_that_cannot_be_imported_is_listed(plugins, capsys):
    assert cli.run(["--help"]) == 0
    assert "cannot be loaded" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "code", "message"),
    [
        ("refused", 2, "gpom: the number is 3; expected 4\n"),
        ("failed", 1, "gpom: nobody is there\n"),
        ("broken", 1, "gpom: internal error, KeyError: 'oops'; --debug shows where\n"),
    ],
)
def test_errors_are_one_line_and_an_exit_code(plugins, capsys, name, code, message):
    assert cli.run([name]) == code
    assert capsys.readouterr() == ("", message)


@pytest.mark.parametrize("args", [["--debug", "refused"], ["refused", "--debug"]])
def test_debug_shows_the_traceback_wherever_it_stands(plugins, args):
    with pytest.raises(GpomError, match="expected 4"):
        cli.run(args)


@pytest.mark.parametrize("args", [["bogus"], ["replay"], ["simulate", "--robots", "0"]])
def test_wrong_usage_ends_with_2(args, capsys):
    assert cli.run(args) == 2
    assert "Usage: gpom" in capsys.readouterr().err


def test_version(capsys):
    assert cli.run(["--version"]) == 0
    assert capsys.readouterr().out.startswith("gpom ")


def test_main_ends_the_process(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["gpom", "--version"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 0
