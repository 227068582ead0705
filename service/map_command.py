"""The commands ``gpom map export`` and ``gpom map import``: the whole map as one file."""

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    help="The whole map as one file, out of a data directory and into another.",
    no_args_is_help=True,
    add_completion=False,
)

_DataDir = Annotated[Path, typer.Option(help="that of `gpom serve`, which must not run")]
_Config = Annotated[Path | None, typer.Option(help="YAML file with settings, as for `gpom serve`")]


@app.command("export")
def export_map(
    file: Annotated[Path, typer.Argument(help="to write, such as site.gpom", metavar="FILE")],
    data_dir: _DataDir,
    config: _Config = None,
) -> None:
    """Write the map of a data directory, with all scans that were acknowledged, to one file."""
    from service.archive import Archive, catch_up  # noqa: PLC0415
    from service.clock import SystemClock  # noqa: PLC0415
    from service.errors import MapFileError  # noqa: PLC0415
    from service.map_file import write_map  # noqa: PLC0415
    from service.settings_file import load_settings  # noqa: PLC0415

    settings = load_settings(config, {"data_dir": data_dir})
    clock = SystemClock()
    archive = Archive(data_dir, settings.journal, settings.map, clock)
    if not archive.journal.path.exists():
        raise MapFileError(f"{data_dir} is no data directory of gpom: it has no journal.sqlite")
    archive.open()
    try:
        mapper, position = archive.load()
        integrated = catch_up(mapper, archive.journal, position)
        saved = archive.packed(mapper, archive.journal.position)
        write_map(file, saved, compress=True)
    finally:
        archive.close()
    typer.echo(
        f"{file}: {mapper.scan_count} scans, {mapper.expert_count} experts, "
        f"{file.stat().st_size / 1e6:.1f} MB ({integrated} scans were not in the checkpoint)"
    )


@app.command("import")
def import_map(
    file: Annotated[Path, typer.Argument(help="written by `gpom map export`", metavar="FILE")],
    data_dir: Annotated[Path, typer.Option(help="to start with this map; must be empty")],
    config: _Config = None,
) -> None:
    """Start a data directory with a map from a file, for `gpom serve --data-dir` to go on with."""
    from gpom_core.image import load  # noqa: PLC0415
    from service.archive import Archive  # noqa: PLC0415
    from service.clock import SystemClock  # noqa: PLC0415
    from service.errors import MapFileError  # noqa: PLC0415
    from service.map_file import read_map  # noqa: PLC0415
    from service.settings_file import load_settings  # noqa: PLC0415

    settings = load_settings(config, {"data_dir": data_dir})
    saved = read_map(file, settings.journal.map_bytes_max)
    if clash := settings.map.clash(saved.config):
        wanted = ", ".join(f"map.{name}: {value!r}" for name, value in clash.items())
        message = f"{file} was made with other settings; give them in --config: {wanted}"
        raise MapFileError(message)
    mapper = load(saved.image, settings.map)  # refuses what only looks like a map
    archive = Archive(data_dir, settings.journal, settings.map, SystemClock())
    if archive.journal.path.exists() or archive.checkpoints():
        raise MapFileError(f"{data_dir} holds a map already; import into an empty directory")
    archive.open()
    try:
        archive.save(saved.image, 0)
    finally:
        archive.close()
    typer.echo(f"{data_dir}: {mapper.scan_count} scans, {mapper.expert_count} experts")
