"""Which threads go first when there are more than processors, and how long others hold them up."""

import gc
import os
import sys
import threading

_SWITCH_S = 5e-4


def share_interpreter() -> None:
    """Keep threads that need the interpreter from waiting long for it; for the whole process.

    One that comes back from compiled code asks another to let go after 0.5 ms. With Python's 5 ms,
    scans and single points would wait for training again and again.
    """
    sys.setswitchinterval(_SWITCH_S)


def load_without_collector() -> None:
    """Let garbage lie until `collect_what_is_new`: loading makes little, and looking costs much."""
    gc.disable()


def collect_what_is_new() -> None:
    """Collect garbage, but not among what was loaded by now.

    That stays to the end, and to look through it the collector would make everybody wait.
    """
    gc.freeze()
    gc.enable()


def be_nice(steps: int) -> None:
    """Let the calling thread give way to others by so many steps of `nice`; on Linux only.

    Elsewhere priorities belong to whole processes, and nothing is changed.
    """
    if sys.platform == "linux":
        thread = threading.get_native_id()
        before = os.getpriority(os.PRIO_PROCESS, thread)
        os.setpriority(os.PRIO_PROCESS, thread, before + steps)
