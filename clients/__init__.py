"""What robots and users of the map import, and the command `gpom`.

Rooms, from the ground up; each may use those above it in this list, and gpom_core:

1. errors: the clients' branch of the tree of errors. children: processes that a command starts.
2. keys: names and addresses. bag_content: what is in a ROS bag. listener: all that robots say.
   fleet_frames: where their sensors are. outbox: where scans wait. receipts: who hears what became
   of them. log_reader: what a reader of logs offers.
   world: geometry of simulated sites. answers: what the map service answers.
3. link: a zenoh session and one stream on it. cursors: how far the map has it. carmen, bags:
   formats of logs. building: a furnished site. sensor: a simulated scanner. calls: the HTTP
   interface as values.
4. reliable: what is not stored is sent again. publisher: numbered scans of one sensor.
   logs: whatever the format. motion: how robots drive. map_client: asks the map, blocking or not.
5. simulate: robots that drive and scan. protocol: how accuracy is measured. dispatch: scans sent
   when they are due.
6. replay: a log as one robot or several. fleet: robots of one process on the way to the map.
   contenders: maps to measure. options: that commands share. output: files that they write.
   examination: what is wrong with a fleet.
7. demo, doctor, evaluate, record, *_command: the commands.
8. cli: the command line.

The names below can be imported from `clients` itself.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from clients.answers import MapPrediction, MapStatus, PointPrediction, RobotStatus
    from clients.errors import (
        DeliveryError,
        LogReadError,
        MapProtocolError,
        MapRequestError,
        MapServiceError,
        MapTimeoutError,
        MapUnavailableError,
        MapUnreachableError,
    )
    from clients.link import SessionSettings, open_session
    from clients.logs import open_log
    from clients.map_client import AsyncMapClient, MapClient
    from clients.outbox import OutboxSettings
    from clients.publisher import ScanPublisher

__all__ = [
    "AsyncMapClient",
    "DeliveryError",
    "LogReadError",
    "MapClient",
    "MapPrediction",
    "MapProtocolError",
    "MapRequestError",
    "MapServiceError",
    "MapStatus",
    "MapTimeoutError",
    "MapUnavailableError",
    "MapUnreachableError",
    "OutboxSettings",
    "PointPrediction",
    "RobotStatus",
    "ScanPublisher",
    "SessionSettings",
    "open_log",
    "open_session",
]

# Whoever asks the map needs no zenoh, so it comes last.
_ROOMS = ("answers", "errors", "map_client", "logs", "link", "outbox", "publisher")


def __getattr__(name: str) -> Any:
    if name in __all__:
        for room in _ROOMS:
            module = import_module(f"clients.{room}")
            if name in vars(module):
                return vars(module)[name]
    message = f"module {__name__!r} has no attribute {name!r}"
    raise AttributeError(message)
