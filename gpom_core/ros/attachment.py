"""What rmw_zenoh attaches to every message: its number, its time, its publisher.

======  =========================  ===============================================
offset  33 bytes (since 2025-04)   77 bytes (before)
======  =========================  ===============================================
0       sequence number i64        length 15 and ``sequence_number``
8       source time i64 ns
16      length 16                  sequence number i64
17      gid, 16 bytes
24                                 length 16 and ``source_timestamp``
41                                 source time i64 ns
49                                 length 10 and ``source_gid``
60                                 length 16
61                                 gid, 16 bytes
======  =========================  ===============================================

Little endian. Source: rmw_zenoh_cpp, ``attachment_helpers.cpp``; the change came with 0.1.2 for
Humble, 0.2.4 for Jazzy, 0.6.0 for Rolling.
"""

import struct
from typing import NamedTuple

from gpom_core.errors import RosMessageError

_GID_BYTES = 16
_PLAIN = struct.Struct("<qqB16s")
_NUMBER, _TIME, _GID = b"\x0fsequence_number", b"\x10source_timestamp", b"\x0asource_gid"
_LABELLED = struct.Struct(f"<{len(_NUMBER)}sq{len(_TIME)}sq{len(_GID)}sB16s")


class Attachment(NamedTuple):
    """Where a message comes from.

    Attributes:
        sequence: number of the message among those of its publisher.
        source_ns: when it was published, since the epoch.
        gid: of the publisher; a new one after each start.
    """

    sequence: int
    source_ns: int
    gid: bytes


def read(data: bytes) -> Attachment:
    """Read an attachment of either layout.

    Raises:
        RosMessageError: ``bad_attachment``.
    """
    if len(data) == _PLAIN.size:
        sequence, source_ns, length, gid = _PLAIN.unpack(data)
        labels = (_NUMBER, _TIME, _GID)
    elif len(data) == _LABELLED.size:
        *_, length, gid = fields = _LABELLED.unpack(data)
        labels, (sequence, source_ns) = (fields[0], fields[2], fields[4]), (fields[1], fields[3])
    else:
        message = (
            f"the attachment has {len(data)} bytes; expected {_PLAIN.size} or {_LABELLED.size} as "
            "rmw_zenoh writes them"
        )
        raise RosMessageError("bad_attachment", message)
    if length != _GID_BYTES or labels != (_NUMBER, _TIME, _GID):
        message = "the attachment is not laid out as rmw_zenoh does"
        raise RosMessageError("bad_attachment", message)
    return Attachment(sequence, source_ns, gid)


def write(attachment: Attachment) -> bytes:
    """Write an attachment as rmw_zenoh does today."""
    return _PLAIN.pack(attachment.sequence, attachment.source_ns, _GID_BYTES, attachment.gid)
