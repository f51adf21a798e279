"""Processes that end with their parent: an orphan must not work on beside the one that a new parent starts."""

import os
import threading
import time

ORPHANED = 3  # exit status


def end_with(parent: int) -> None:
    """From now on this process ends within a second after `parent` is no longer its parent, whatever it is doing.

    Nothing is given back: the lease of its job ends, and the reaper gives the job to another.
    """
    threading.Thread(target=_watch, args=(parent,), name="parent", daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(ORPHANED)
