from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gpom_core.errors import RosMessageError
from gpom_core.ros.attachment import Attachment, read, write
from tests.gpom_core.ros.vectors import GID, LABELLED, PLAIN, SEQUENCE, SOURCE_NS


@pytest.mark.parametrize("data", [PLAIN, LABELLED])
def test_reads_both_layouts(data) -> None:
    assert read(data) == (SEQUENCE, SOURCE_NS, GID)


@given(
    st.integers(-(2**63), 2**63 - 1),
    st.integers(-(2**63), 2**63 - 1),
    st.binary(min_size=16, max_size=16),
)
def test_what_is_written_is_read(sequence, source_ns, gid) -> None:
    assert read(write(Attachment(sequence, source_ns, gid))) == (sequence, source_ns, gid)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        PLAIN[:-1],
        LABELLED + b"x",
        PLAIN[:16] + b"\x08" + GID,
        LABELLED.replace(b"gid", b"gif"),
    ],
)
def test_refuses_others(data) -> None:
    with pytest.raises(RosMessageError) as caught:
        read(data)
    assert caught.value.reason == "bad_attachment"


@given(st.binary(max_size=100))
def test_survives_anything(data) -> None:
    with suppress(RosMessageError):
        read(data)
