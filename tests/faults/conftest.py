from collections.abc import Callable, Iterator

import pytest

from tests.faults.parts import Part, Robot


@pytest.fixture
def run() -> Iterator[Callable[..., None]]:
    """Start parts and robots; whatever happens, they end with the test."""
    started: list[Part | Robot] = []

    def start(*parts: Part | Robot) -> None:
        for part in parts:
            started.append(part)
            part.start()

    yield start
    for part in reversed(started):
        if isinstance(part, Robot):
            part.abandon()
    for part in reversed(started):
        if isinstance(part, Part):
            part.kill()
