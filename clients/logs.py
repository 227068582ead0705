"""Recorded logs, whatever their format."""

from pathlib import Path

from clients.carmen import CarmenLog
from clients.log_reader import LogReader, LogSummary, NoReturns, ReadOptions, is_held_out

__all__ = ["LogReader", "LogSummary", "NoReturns", "ReadOptions", "is_held_out", "open_log"]


def open_log(path: Path, options: ReadOptions | None = None) -> LogReader:
    """Open a log with the reader of its format.

    Raises:
        LogReadError: the file is missing, damaged, or no log that can be read.
    """
    return CarmenLog(path, options)
