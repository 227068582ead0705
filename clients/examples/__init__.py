"""One short script for each kind of use; run them with ``python -m clients.examples.NAME URL``."""

import sys
from collections.abc import Callable

import httpx

from clients.calls import to_unreachable
from gpom_core.errors import GpomError


def run(main: Callable[..., None], address: str) -> None:
    """Run an example as the command line says, or at the usual address; what fails is one line."""
    arguments = sys.argv[1:] or [address]
    try:
        main(*arguments)
    except GpomError as error:
        sys.exit(str(error))
    except httpx.RequestError as error:
        sys.exit(str(to_unreachable(error, arguments[0])))
