"""Headers of npy files that strangers wrote."""

from typing import BinaryIO

import numpy as np
from numpy.lib import format as npy_format

_READERS = {
    (1, 0): npy_format.read_array_header_1_0,
    (2, 0): npy_format.read_array_header_2_0,
}


def read_header(stream: BinaryIO, bytes_max: int) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Read a header, of at most `bytes_max` bytes; the data comes next in the stream.

    Returns:
        Shape, whether in Fortran's order, and type of the elements: a claim, held against nothing.

    Raises:
        ValueError: it is none, or of another version of the format than 1.0 and 2.0.
    """
    version = npy_format.read_magic(stream)
    if version not in _READERS:
        raise ValueError(f"npy format {version} is not understood")
    try:
        return _READERS[version](stream, max_header_size=bytes_max)
    except ValueError:
        raise
    except Exception as error:  # numpy parses it as Python, and lets most errors of that through
        raise ValueError(f"its header cannot be parsed ({type(error).__name__})") from error
