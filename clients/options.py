"""Options that several commands share."""

from enum import StrEnum
from typing import Annotated

import typer

from clients.keys import DEFAULT_ENDPOINT, DEFAULT_PREFIX, DEFAULT_URL
from gpom_core.errors import ConfigurationError

DEFAULT_ENDPOINTS = [DEFAULT_ENDPOINT]
DEFAULT_WAIT_S = 10.0

Connect = Annotated[
    list[str], typer.Option(help="zenoh router to connect to; may be repeated.", metavar="ENDPOINT")
]
Prefix = Annotated[str, typer.Option(help="Prefix of the site's zenoh keys.", metavar="KEY")]
Sensor = Annotated[str, typer.Option(help="Name of the sensor.", metavar="NAME")]
Wait = Annotated[
    float, typer.Option(help="Wait so long for the map service.", min=0.0, metavar="SECONDS")
]
Url = Annotated[str, typer.Option(help="Address of the map service.", metavar="URL")]
Topic = Annotated[
    str | None, typer.Option(help="Topic of the scans, in a ROS bag with several.", metavar="TOPIC")
]
MapFrame = Annotated[
    str | None,
    typer.Option(help="Frame to place scans in, in a ROS bag.  [default: map]", metavar="FRAME"),
]


class RosTransport(StrEnum):
    """How ROS 2 comes over zenoh."""

    RMW_ZENOH = "rmw_zenoh"
    BRIDGE = "bridge"


Transports = Annotated[
    list[RosTransport] | None,
    typer.Option(help="How ROS 2 comes; may be repeated.  [default: both]"),
]
Domain = Annotated[int, typer.Option(help="ROS_DOMAIN_ID; rmw_zenoh only.", min=0, max=232)]
Fusion = Annotated[str, typer.Option(help="Rule that merges experts: bcm, rbcm or poe.")]

__all__ = [
    "DEFAULT_ENDPOINTS",
    "DEFAULT_PREFIX",
    "DEFAULT_URL",
    "DEFAULT_WAIT_S",
    "Connect",
    "Domain",
    "Fusion",
    "MapFrame",
    "Prefix",
    "RosTransport",
    "Sensor",
    "Topic",
    "Transports",
    "Url",
    "Wait",
    "parse_box",
]


def parse_box(text: str) -> tuple[float, float, float, float]:
    """Read `xmin,ymin,xmax,ymax`.

    Raises:
        ConfigurationError: it is something else.
    """
    try:
        xmin, ymin, xmax, ymax = map(float, text.split(","))
    except ValueError as error:
        message = f"the box {text!r} is not understood; expected xmin,ymin,xmax,ymax in m"
        raise ConfigurationError(message) from error
    return xmin, ymin, xmax, ymax
