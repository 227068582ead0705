"""The command `gpom compare`."""

import json
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from clients.comparison.peers import missing_peers
from clients.comparison.report import as_dict, as_markdown
from clients.comparison.study import Round, play
from clients.map_settings import read_config
from clients.protocol import parse_share, read_scans


def compare(
    logs: Annotated[list[Path], typer.Argument(help="CARMEN logs, or ROS bags.")],
    shares: Annotated[
        str, typer.Option(help="Shares of the training scans that build the maps.")
    ] = "1,1/3,1/10,1/30",
    draws: Annotated[int, typer.Option(min=1, help="Draws of the test points.")] = 5,
    output: Annotated[
        Path | None, typer.Option(help="Folder for JSON, Markdown and figures.")
    ] = None,
    config: Annotated[Path | None, typer.Option(help="YAML file of the map's settings.")] = None,
    peers: Annotated[
        bool, typer.Option(help="Also OctoMap and scikit-learn's maps, where installed.")
    ] = True,
) -> None:
    """Score the map beside grids and other methods on the same held-out points.

    Scans 5, 15, 25 … are held out; nothing is fitted on them. Prints Markdown.
    """
    parts = sorted({parse_share(text) for text in shares.split(",")}, reverse=True)
    settings = read_config(config)
    console = Console(stderr=True)
    missing = missing_peers() if peers else {}
    for name, package in missing.items():
        console.print(f"{name} takes no part: {package} is not installed")
    rounds: list[Round] = []
    for path in logs:
        scans = read_scans(path)
        for share in parts:
            console.print(f"{path.name}: share {share} of the training scans", highlight=False)
            name = path.name.partition(".")[0]
            one = play(name, scans, share, draws, config=settings, with_peers=peers)
            rounds.append(one)
            if output is not None:  # a long run that is stopped leaves what it has
                _write(output, rounds, missing)
    if output is not None:
        _draw(output, rounds, console)
    typer.echo(as_markdown(rounds, missing), nl=False)


def _write(folder: Path, rounds: list[Round], missing: dict[str, str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    document = json.dumps(as_dict(rounds, missing), indent=1)
    (folder / "comparison.json").write_text(document + "\n", encoding="utf-8")
    (folder / "comparison.md").write_text(as_markdown(rounds, missing), encoding="utf-8")


def _draw(folder: Path, rounds: list[Round], console: Console) -> None:
    if find_spec("matplotlib") is None:
        console.print("no figures: matplotlib is not installed")
        return
    from clients.comparison.figures import draw

    for path in draw(rounds, folder):
        console.print(f"wrote {path}")
