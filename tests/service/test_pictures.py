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


def test_nav2_archive_is_what_map_server_reads() -> None:
    archive = nav2.archive(GRID, (-1.0, -2.0, 0.0, -1.0), 0.5)
    with zipfile.ZipFile(io.BytesIO(archive)) as files:
        description = yaml.safe_load(files.read("map.yaml"))
        image = Image.open(io.BytesIO(files.read(description["image"])))
    assert description["resolution"] == 0.5
    assert description["origin"] == [-1.0, -2.0, 0.0]
    pixels = np.asarray(image)
    probability = (255 - pixels.astype(float)) / 255.0
    assert probability[1, 1] > description["occupied_thresh"], "occupied, bottom right"
    assert probability[1, 0] < description["free_thresh"], "free, bottom left"
    unknown = probability[0]
    assert np.all(unknown > description["free_thresh"])
    assert np.all(unknown < description["occupied_thresh"])


@pytest.mark.parametrize("layer", render.Layer.__args__)
def test_every_layer_can_be_drawn(layer) -> None:
    assert render.png(GRID, layer, 1.0).startswith(b"\x89PNG")
