"""A thread that repeats one step, survives what goes wrong in it, and can be asked how it is."""

import logging
import threading
from collections.abc import Callable

logger = logging.getLogger(__name__)


class Worker:
    """Calls `step` until it returns False.

    An exception in a step is logged and counted, and the next step is made: bad input must not
    stop a service. The thread is a daemon, so a step that hangs cannot hold the process.
    """

    def __init__(
        self, name: str, step: Callable[[], bool], on_error: Callable[[str], None] | None = None
    ) -> None:
        self.name = name
        self._step = step
        self._on_error = on_error
        self._thread = threading.Thread(target=self._run, name=f"gpom-{name}", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def join(self, timeout_s: float) -> bool:
        """Wait for the end; tell whether it came."""
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def is_alive(self) -> bool:
        """Whether its thread runs."""
        return self._thread.is_alive()

    def trouble(self) -> str | None:
        """Why no steps are made; None while they are."""
        return None if self._thread.is_alive() else f"the {self.name} thread is not running"

    def _run(self) -> None:
        going = True
        while going:
            try:
                going = self._step()
            except Exception:
                logger.exception("unexpected error in the %s thread; it goes on", self.name)
                if self._on_error is not None:
                    self._on_error(self.name)
