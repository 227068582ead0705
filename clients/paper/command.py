"""``gpom paper``: the paper's tables and figures, in one folder."""

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from clients.output import require_folder
from gpom_core.errors import ConfigurationError

Output = Annotated[Path, typer.Option(help="Folder for figures, tables.md and results.json.")]
Seeds = Annotated[
    int | None, typer.Option(min=1, help="Experiments to average over.  [default: 5; quick: 2]")
]
Workers = Annotated[int, typer.Option(min=0, help="Processes; 0 for this one alone.")]
Quick = Annotated[bool, typer.Option("--quick", help="A coarse run of a minute, to look around.")]


def paper(
    output: Output = Path("paper"), seeds: Seeds = None, workers: Workers = 2, quick: Quick = False
) -> None:
    """Reproduce Kim & Kim (Sensors 2022): all methods, figures and tables, in a few minutes."""
    require_matplotlib()
    from dataclasses import replace

    from clients.paper.report import COARSE, QUICK, Budget, reproduce

    require_folder(output)
    console = Console(stderr=True)
    budget = replace(QUICK if quick else Budget(), workers=workers)
    budget = replace(budget, seeds=seeds or budget.seeds)
    with console.status(f"{budget.seeds} experiments; the first run compiles its loops …"):
        results, claims = reproduce(output, budget, console.print)
    for claim in claims:
        console.print(f"{'holds' if claim.holds else 'FAILS'}  {claim.name}: {claim.found}",
                      highlight=False)  # fmt: skip
    if budget.coarse:
        console.print(COARSE)
    typer.echo(f"{output} written in {results['duration_s']:.0f} s")


def require_matplotlib() -> None:
    """Say what to install.

    Raises:
        ConfigurationError: matplotlib is missing.
    """
    if find_spec("matplotlib") is None:
        raise ConfigurationError(
            "`gpom paper` draws with matplotlib, which is not installed; "
            "install it with the extra `paper`: pip install 'gpom[paper]'"
        )
