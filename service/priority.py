"""Which threads go first when there are more than processors."""

import os
import sys
import threading


def be_nice(steps: int) -> None:
    """Let the calling thread give way to others by so many steps of `nice`; on Linux only.

    Elsewhere priorities belong to whole processes, and nothing is changed.
    """
    if sys.platform == "linux":
        thread = threading.get_native_id()
        before = os.getpriority(os.PRIO_PROCESS, thread)
        os.setpriority(os.PRIO_PROCESS, thread, before + steps)
