"""The commands `gpom query` and `gpom export`."""

import csv
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from clients.answers import MapPrediction
from clients.map_client import MapClient
from clients.options import DEFAULT_URL, Fusion, Url, parse_box
from clients.output import cannot_write, write
from gpom_core.errors import ConfigurationError, InvalidQueryError

COLUMNS = ("x", "y", "occupancy", "mean", "variance", "known")


def query(
    x: Annotated[str | None, typer.Argument(help="In m, in the map frame.", metavar="X")] = None,
    y: Annotated[str | None, typer.Argument(help="In m, in the map frame.", metavar="Y")] = None,
    points: Annotated[
        Path | None,
        typer.Option(
            help="Ask about many: a .csv with columns x, y, or an .npy of shape (N, 2).",
            metavar="FILE",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Write here, as .csv or .npy; default: CSV to stdout.",
            metavar="FILE",
        ),
    ] = None,
    fusion: Fusion = "bcm",
    url: Url = DEFAULT_URL,
) -> None:
    """Ask the map how likely places are occupied, and how sure it is.

    `gpom query 1.5 -2` prints JSON; --points asks about all places of a file at once.
    """
    one = x is not None or y is not None
    if one and points is not None:
        raise ConfigurationError("asked twice; expected either X and Y, or --points FILE, not both")
    if not one and points is None:
        raise ConfigurationError("nothing to ask about; expected X and Y, or --points FILE")
    with MapClient(url) as client:
        if points is None:
            place = _number("X", x), _number("Y", y)
            typer.echo(json.dumps(asdict(client.query_point(*place, fusion))))
            return
        where = read_points(points)
        answer = client.query(where, fusion)
    _write_answer(where, answer, output)
    typer.echo(f"{len(where)} points, map version {answer.map_version}", err=True)


def export(
    output: Annotated[
        Path,
        typer.Argument(
            help="File to write: .png (north up), .npy (float64, row 0 at ymin) or .zip (PGM and "
            "YAML for the ROS map_server).",
            metavar="FILE",
        ),
    ],
    bbox: Annotated[
        str | None,
        typer.Option(
            help="Part of the map in m; default: all of it.", metavar="XMIN,YMIN,XMAX,YMAX"
        ),
    ] = None,
    resolution_m: Annotated[
        float,
        typer.Option("--resolution-m", "--resolution", help="Side of a cell.", metavar="METRES"),
    ] = 0.05,
    layer: Annotated[str, typer.Option(help="occupancy, mean, variance or known.")] = "occupancy",
    url: Url = DEFAULT_URL,
) -> None:
    """Write the map as a raster."""
    formats = {".png": "png", ".npy": "npy", ".zip": "nav2"}
    file_format = formats.get(output.suffix.lower())
    if file_format is None:
        message = f"cannot write {output.name}; expected a name that ends in {', '.join(formats)}"
        raise ConfigurationError(message)
    with MapClient(url) as client:
        box = parse_box(bbox) if bbox is not None else client.status().bounds
        if box is None:
            raise InvalidQueryError("the map is empty, so it has no extent; give one with --bbox")
        content = client.raster(box, resolution_m, layer, file_format)
    write(output, content)
    typer.echo(f"wrote {output} ({len(content)} bytes)", err=True)


def read_points(path: Path) -> NDArray[np.float64]:
    """Read points (N, 2) from an .npy or .csv file; a CSV may have a header and more columns.

    Raises:
        InvalidQueryError: the file cannot be read as points.
    """
    try:
        points = _read_npy(path) if path.suffix.lower() == ".npy" else _read_csv(path)
    except OSError as error:
        message = f"cannot read {path}: {error.strerror or error}"
        raise InvalidQueryError(message) from error
    except (ValueError, EOFError) as error:
        message = f"{path} has no points: {error}; expected columns x, y or an .npy of (N, 2)"
        raise InvalidQueryError(message) from error
    if points.ndim != 2 or points.shape[1] != 2:
        message = f"{path} has shape {points.shape}; expected (N, 2), x and y in m"
        raise InvalidQueryError(message)
    return points


def _read_npy(path: Path) -> NDArray[np.float64]:
    try:
        return np.asarray(np.load(path, allow_pickle=False), dtype=np.float64)
    except (OSError, ValueError, EOFError):
        raise
    except Exception as error:  # numpy parses headers as Python, and lets its errors through
        message = f"its header cannot be parsed ({type(error).__name__})"
        raise ValueError(message) from error


def _read_csv(path: Path) -> NDArray[np.float64]:
    # Spreadsheets put a byte order mark in front.
    with path.open(newline="", encoding="utf-8-sig") as lines:
        rows = [row for row in csv.reader(lines) if row]
    columns = (0, 1)
    if rows and not _is_number(rows[0][0]):
        names = [name.strip().lower() for name in rows.pop(0)]
        if not {"x", "y"} <= set(names):
            raise ValueError(f"its columns are {', '.join(names)}")
        columns = (names.index("x"), names.index("y"))
    for number, row in enumerate(rows, 1):
        if len(row) <= max(columns):
            raise ValueError(f"row {number} has {len(row)} columns")
    return np.array([[float(row[at]) for at in columns] for row in rows]).reshape(-1, 2)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _number(name: str, text: str | None) -> float:
    if text is None:
        raise ConfigurationError(f"{name} is missing; expected X and Y in metres")
    if not _is_number(text):
        message = f"{name} is {text!r}; expected a number of metres"
        raise ConfigurationError(message)
    return float(text)


def _write_answer(points: NDArray[np.float64], answer: MapPrediction, output: Path | None) -> None:
    columns = (answer.occupancy, answer.mean, answer.variance, answer.known)
    if output is not None and output.suffix.lower() == ".npy":
        try:
            np.save(output, np.column_stack([points, *columns]))
        except OSError as error:
            raise cannot_write(output, error) from error
        return
    rows = [",".join(COLUMNS)]
    rows += [
        f"{x!r},{y!r},{p!r},{mean!r},{variance!r},{int(known)}"
        for (x, y), p, mean, variance, known in zip(
            points.tolist(), *(column.tolist() for column in columns), strict=True
        )
    ]
    text = "\n".join(rows) + "\n"
    if output is None:
        sys.stdout.write(text)
    else:
        write(output, text.encode())
