"""The command `gpom`: its own commands, and those that other packages register.

A package adds a command by an entry point in the group `gpom.commands`, whose name is the command
and whose object is a function for typer or a typer application. Commands are imported when they
run; one that cannot be imported says so and leaves the others alone.
"""

import logging
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, PackageNotFoundError, entry_points, version
from typing import Annotated, Any, Final

import typer
from typer.core import TyperGroup
from typer.main import get_command as to_command

from clients.errors import RUNTIME_EXIT_CODE, USAGE_EXIT_CODE
from gpom_core.errors import GpomError

COMMAND_GROUP = "gpom.commands"

_MARKUP: Final = "markdown"


class CommandUnavailableError(GpomError):
    """A registered command cannot be imported."""

    exit_code = RUNTIME_EXIT_CODE


@dataclass(frozen=True, slots=True)
class _Source:
    """Where a command is found, and how its arguments are read."""

    entry: EntryPoint
    context: dict[str, Any] = field(default_factory=dict)


def _own(name: str, where: str, **context: Any) -> tuple[str, _Source]:
    return name, _Source(EntryPoint(name, where, COMMAND_GROUP), context)


_OWN_COMMANDS = dict(
    [
        _own("demo", "clients.demo:demo"),
        _own("simulate", "clients.simulate_command:simulate"),
        _own("replay", "clients.replay_command:replay"),
        # -1.5 is a place, not an option.
        _own("query", "clients.query_command:query", ignore_unknown_options=True),
        _own("export", "clients.query_command:export"),
        _own("record", "clients.record:record"),
        _own("doctor", "clients.doctor:doctor"),
        _own("evaluate", "clients.evaluate:evaluate_command"),
        _own("tune", "clients.tune:tune"),
        _own("compare", "clients.comparison.command:compare"),
        _own("paper", "clients.paper.command:paper"),
    ]
)


class _Commands(TyperGroup):
    """Finds commands by name, and imports only what is asked for."""

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ARG002 - the caller's interface
        return list(_sources())

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ARG002 - likewise
        source = _sources().get(cmd_name)
        return None if source is None else _load(cmd_name, source)


app = typer.Typer(
    name="gpom",
    cls=_Commands,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=_MARKUP,
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"gpom {_version()}")
        raise typer.Exit


@app.callback()
def _root(
    _show_version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version and end.", is_eager=True, callback=_print_version
        ),
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show tracebacks and all log messages.")
    ] = False,
) -> None:
    """One live, continuous occupancy map of a site, from the laser scans of a whole fleet."""
    if debug:
        logging.basicConfig(level=logging.DEBUG)


def main(args: Sequence[str] | None = None) -> None:
    """Run the command line and end the process: 0 well, 1 failed while running, 2 asked wrongly."""
    sys.exit(run(sys.argv[1:] if args is None else list(args)))


def run(args: Sequence[str]) -> int:
    """Run the command line and give the exit code; errors are one message on stderr.

    `--debug` may stand anywhere and shows tracebacks.
    """
    debug = "--debug" in args
    rest = [arg for arg in args if arg != "--debug"]
    try:
        app(["--debug", *rest] if debug else rest, prog_name="gpom")
    except SystemExit as done:
        return done.code if isinstance(done.code, int) else int(done.code is not None)
    except GpomError as error:
        if debug:
            raise
        typer.echo(f"gpom: {error}", err=True)
        return int(getattr(error, "exit_code", USAGE_EXIT_CODE))
    except Exception as error:
        if debug:
            raise
        kind = type(error).__name__
        typer.echo(f"gpom: internal error, {kind}: {error}; --debug shows where", err=True)
        return RUNTIME_EXIT_CODE
    return 0


def _sources() -> dict[str, _Source]:
    registered = {entry.name: _Source(entry) for entry in entry_points(group=COMMAND_GROUP)}
    return dict(sorted(registered.items())) | _OWN_COMMANDS


def _load(name: str, source: _Source) -> Any:
    try:
        found = source.entry.load()
        if isinstance(found, typer.Typer):
            command = to_command(found)
            command.name = name
            return command
        return _from_function(name, found, source.context)
    except Exception as error:  # noqa: BLE001 - foreign code may fail in any way at its import
        return _unavailable(name, source, error)


def _from_function(name: str, function: Callable[..., Any], context: dict[str, Any]) -> Any:
    alone = typer.Typer(
        add_completion=False, rich_markup_mode=_MARKUP, pretty_exceptions_enable=False
    )
    alone.command(name, context_settings=context)(function)
    return to_command(alone)


def _unavailable(name: str, source: _Source, error: Exception) -> Any:
    def explain() -> None:
        message = (
            f"the command `{name}` cannot be loaded from {source.entry.value} "
            f"({type(error).__name__}: {error}); --debug shows where"
        )
        raise CommandUnavailableError(message) from error

    explain.__doc__ = f"(cannot be loaded: {error})"
    return _from_function(
        name,
        explain,
        # Whatever follows it, even --help, the answer is why it is not there.
        {"ignore_unknown_options": True, "allow_extra_args": True, "help_option_names": []},
    )


def _version() -> str:
    try:
        return version("gpom")
    except PackageNotFoundError:
        return "(not installed)"


if __name__ == "__main__":
    main()
