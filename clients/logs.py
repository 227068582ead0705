"""Recorded logs, whatever their format."""

from pathlib import Path

from clients.bag_content import bag_kind
from clients.bags import BagLog
from clients.carmen import CarmenLog
from clients.errors import LogReadError
from clients.log_reader import LogReader, LogSummary, NoReturns, ReadOptions, is_held_out

__all__ = ["LogReader", "LogSummary", "NoReturns", "ReadOptions", "is_held_out", "open_log"]


def open_log(path: Path, options: ReadOptions | None = None) -> LogReader:
    """Open a log with the reader of its format, told by its content.

    Raises:
        LogReadError: the file is missing, damaged, or no log that can be read.
    """
    if path.is_dir() or bag_kind(path) is not None:
        return BagLog(path, options)
    if options is not None and (options.topic or options.map_frame):
        message = f"{path} is no ROS bag, so it has no topics and frames to choose from"
        raise LogReadError(message)
    return CarmenLog(path, options)
