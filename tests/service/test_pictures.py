import io
import zipfile

import numpy as np
import pytest
import yaml
from PIL import Image

from gpom_core.snapshot import Prediction
from service import nav2, render

# Bottom row: free, occupied. Top row: unknown, undecided.
GRID = Prediction(
    occupancy=np.array([[0.0, 1.0], [0.5, 0.5]]),
    mean=np.array([[-1.0, 1.0], [0.0, 0.0]]),
    variance=np.array([[0.0, 0.0], [2.0, 0.5]]),
    known=np.array([[True, True], [False, True]]),
)


def _pixels(layer: render.Layer):
    image = Image.open(io.BytesIO(render.png(GRID, layer, prior_variance=2.0)))
    assert image.format == "PNG"
    return np.asarray(image.convert("RGB"))


def test_occupancy_is_gray_with_north_up_and_unknown_is_no_gray() -> None:
    pixels = _pixels("occupancy")
    assert pixels.shape == (2, 2, 3)
    assert tuple(pixels[1, 0]) == (255, 255, 255)
    assert tuple(pixels[1, 1]) == (0, 0, 0)
    assert tuple(pixels[0, 0]) == render.UNKNOWN_COLOR
    assert len(set(pixels[0, 1])) == 1
    assert 120 < pixels[0, 1, 0] < 135
    assert len(set(render.UNKNOWN_COLOR)) > 1


def test_variance_gets_brighter() -> None:
    brightness = _pixels("variance").sum(axis=2)
    assert brightness[1, 0] < brightness[0, 1] < brightness[0, 0]


def test_mean_is_blue_when_free_and_red_when_occupied() -> None:
    pixels = _pixels("mean").astype(int)
    assert pixels[1, 0, 2] > pixels[1, 0, 0]
    assert pixels[1, 1, 0] > pixels[1, 1, 2]
    assert tuple(pixels[0, 0]) == render.UNKNOWN_COLOR


def test_known_is_white() -> None:
    np.testing.assert_array_equal(_pixels("known")[:, :, 0], [[0, 255], [255, 255]])


def test_values_beyond_the_scale_do_not_wrap_around() -> None:
    grid = Prediction(
        np.ones((1, 2)), np.array([[-3.0, 3.0]]), np.full((1, 2), 9.0), np.ones((1, 2), bool)
    )
    picture = render.png(grid, "mean", 1.0)
    left, right = np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"))[0].astype(int)
    assert left[2] > left[0]
    assert right[0] > right[2]


def _map_server(archive: bytes, name: str) -> np.ndarray:
    """Read a map as nav2_map_server does: cells of an OccupancyGrid, the first row at ymin."""
    with zipfile.ZipFile(io.BytesIO(archive)) as files:
        about = yaml.safe_load(files.read(f"{name}.yaml"))
        image = Image.open(io.BytesIO(files.read(about["image"])))
    assert about["resolution"] == 0.5
    assert about["origin"] == [-1.0, -2.0, 0.0]
    assert about["free_thresh"] < about["occupied_thresh"]
    channels = np.asarray(image.convert("LA")).astype(float)[::-1]
    shade, opaque = channels[..., 0] / 255.0, channels[..., 1] == 255.0
    occupied = shade if about["negate"] else 1.0 - shade
    low, high = about["free_thresh"], about["occupied_thresh"]
    if about["mode"] == "raw":
        value = np.round(shade * 255.0)
        return np.where((value >= 0) & (value <= 100), value, -1).astype(int)
    if about["mode"] == "trinary":
        between = np.full_like(shade, -1.0)
    else:
        between = np.where(opaque, np.rint((occupied - low) / (high - low) * 100.0), -1.0)
        occupied = np.where(opaque, occupied, (low + high) / 2.0)
    return np.select([occupied > high, occupied < low], [100.0, 0.0], between).astype(int)


@pytest.mark.parametrize(
    ("mode", "cells"),
    [
        ("trinary", [[0, 100], [-1, -1]]),
        ("scale", [[0, 100], [-1, 50]]),
        ("raw", [[0, 100], [-1, 50]]),
    ],
)
def test_map_server_reads_each_mode_and_keeps_the_unknown(mode, cells) -> None:
    archive = nav2.archive(GRID, (-1.0, -2.0, 0.0, -1.0), 0.5, mode=mode, prior_variance=2.0)

    np.testing.assert_array_equal(_map_server(archive, "map"), cells)
    np.testing.assert_array_equal(_map_server(archive, "variance"), [[0, 0], [100, 25]])


@pytest.mark.parametrize("layer", render.Layer.__args__)
def test_every_layer_can_be_drawn(layer) -> None:
    assert render.png(GRID, layer, 1.0).startswith(b"\x89PNG")
