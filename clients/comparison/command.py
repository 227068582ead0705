"""The command `gpom compare`."""

import json
from collections import Counter
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from clients.comparison.peers import missing_peers
from clients.comparison.report import as_dict, as_markdown
from clients.comparison.study import Round, play
from clients.map_settings import read_config
from clients.output import require_folder, write
from clients.protocol import held_out_points, parse_share, read_scans
from gpom_core.errors import ConfigurationError


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
        bool, typer.Option(help="Also maps of OctoMap, scikit-learn and GPyTorch, where installed.")
    ] = True,
) -> None:
    """Score the map beside grids and other methods on the same held-out points.

    Scans 5, 15, 25 … are held out; nothing is fitted on them. Prints Markdown.
    """
    # what was asked is refused before the work, not after
    parts = sorted({parse_share(text) for text in shares.split(",")}, reverse=True)
    settings = read_config(config)
    sites = {label: read_scans(path) for label, path in labels(logs).items()}
    for label, scans in sites.items():
        held_out_points(scans, seed=0, log=label)
    if output is not None:
        require_folder(output)
    console = Console(stderr=True)
    missing = missing_peers() if peers else {}
    for name, package in missing.items():
        console.print(f"{name} takes no part: {package} is not installed")
    rounds: list[Round] = []
    try:
        for label, scans in sites.items():
            for share in parts:
                console.print(f"{label}: share {share} of the training scans", highlight=False)
                one = play(label, scans, share, draws, config=settings, with_peers=peers)
                rounds.append(one)
                if output is not None:
                    _write(output, rounds, missing)
    finally:
        if rounds:  # a long run that is stopped leaves what it has
            typer.echo(as_markdown(rounds, missing), nl=False)
    if output is not None:
        _draw(output, rounds, console)


def labels(logs: Sequence[Path]) -> dict[str, Path]:
    """Name every log: by the first word of its file's name, all of the name, or the path.

    Raises:
        ConfigurationError: a log is given twice.
    """
    real = Counter(path.resolve() for path in logs)
    if twice := [str(path) for path in logs if real[path.resolve()] > 1]:
        raise ConfigurationError(f"{' and '.join(twice)} are the same log; name it once")
    words = Counter(_first_word(path) for path in logs)
    names = Counter(path.name for path in logs)
    named = {}
    for path in logs:
        label = path.name if names[path.name] == 1 else str(path)
        named[_first_word(path) if words[_first_word(path)] == 1 else label] = path
    return named


def _first_word(path: Path) -> str:
    return path.name.partition(".")[0] or path.name


def _write(folder: Path, rounds: list[Round], missing: dict[str, str]) -> None:
    document = json.dumps(as_dict(rounds, missing), indent=1)
    write(folder / "comparison.json", (document + "\n").encode())
    write(folder / "comparison.md", as_markdown(rounds, missing).encode())


def _draw(folder: Path, rounds: list[Round], console: Console) -> None:
    if find_spec("matplotlib") is None:
        console.print("no figures: matplotlib is not installed")
        return
    from clients.comparison.figures import draw

    for path in draw(rounds, folder):
        console.print(f"wrote {path}")
