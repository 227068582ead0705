"""The command ``gpom serve``. It imports what is slow to load only when it runs."""

from pathlib import Path
from typing import Annotated, Any

import typer


def serve(
    host: Annotated[str | None, typer.Option(help="address for HTTP [127.0.0.1]")] = None,
    port: Annotated[int | None, typer.Option(help="port for HTTP, 0 picks one [8080]")] = None,
    zenoh_listen: Annotated[
        list[str] | None,
        typer.Option(help="zenoh endpoint to listen on; repeatable, '' for none [port 7447]"),
    ] = None,
    zenoh_connect: Annotated[
        list[str] | None, typer.Option(help="zenoh router or peer to connect to; repeatable")
    ] = None,
    data_dir: Annotated[
        Path | None, typer.Option(help="where the map is kept over restarts [in memory]")
    ] = None,
    config: Annotated[Path | None, typer.Option(help="YAML file with settings")] = None,
    insecure: Annotated[
        bool,
        typer.Option("--insecure", help="let others reach it without any credentials [refused]"),
    ] = False,
    print_config: Annotated[
        bool, typer.Option("--print-config", help="print all settings as a YAML file, and end")
    ] = False,
) -> None:
    """Run the map service.

    Settings come from defaults, the file of --config, GPOM_* variables and flags, the last one
    wins. Ends with 0 on SIGINT or SIGTERM, with 2 when a setting is bad or a port is taken.
    """
    from service.ending import Ending  # noqa: PLC0415
    from service.priority import load_without_collector  # noqa: PLC0415

    ending = Ending()  # first, for what follows takes seconds
    load_without_collector()
    from gpom_core.errors import ConfigurationError  # noqa: PLC0415
    from service.settings_file import annotated_yaml, load_settings  # noqa: PLC0415

    flags = {
        "data_dir": data_dir,
        "access": _given(insecure=insecure or None),
        "http": _given(host=host, port=port),
        "zenoh": _given(listen=_named(zenoh_listen), connect=_named(zenoh_connect)),
    }
    try:
        settings = load_settings(config, _given(**flags))
    except ConfigurationError as error:
        raise _failure(str(error)) from error
    if print_config:
        typer.echo(annotated_yaml(settings), nl=False)
        return
    if ending.wanted:
        return

    from service import logs, server  # noqa: PLC0415
    from service.errors import JournalError, MapFileError, SourceError  # noqa: PLC0415

    logs.configure(settings.log_level)
    code = 0
    try:
        server.run(settings, announce=typer.echo, ending=ending)
    except (ConfigurationError, JournalError, MapFileError, SourceError) as error:
        code = _failure(str(error)).exit_code
    server.leave(code)
    raise typer.Exit(code)


def _given(**values: Any) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value not in (None, {})}


def _named(values: list[str] | None) -> list[str] | None:
    return None if values is None else [value for value in values if value]


def _failure(message: str) -> typer.Exit:
    typer.echo(f"gpom serve: {message}", err=True)
    return typer.Exit(2)
