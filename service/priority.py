"""Which threads go first when there are more than processors, and how long others hold them up."""

import gc
import os
import sys
import threading

_SWITCH_S = 5e-4


def share_interpreter() -> None:
    """Keep threads that need the interpreter from waiting long for it; for the whole process.

    One that comes back from compiled code asks another to let go after 0.5 ms. With Python's 5 ms,
    scans and single points would wait for training again and again. And what is loaded by now stays
    to the end, so the garbage collector need not look through it while everybody waits.
    """
    sys.setswitchinterval(_SWITCH_S)
    gc.freeze()


def be_nice(steps: int) -> None:
    """Let the calling thread give way to others by so many steps of `nice`; on Linux only.

    Elsewhere priorities belong to whole processes, and nothing is changed.
    """
    if sys.platform == "linux":
        thread = threading.get_native_id()
        before = os.getpriority(os.PRIO_PROCESS, thread)
        os.setpriority(os.PRIO_PROCESS, thread, before + steps)
