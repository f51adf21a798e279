"""Python's garbage collector in a process that answers or trains."""

import gc


def freeze_imports() -> None:
    """Have the collector leave alone what is there now: it lives as long as the process.

    Once a process, after its imports. A full collection takes an eighth of a second otherwise, and a request with it.
    """
    if gc.get_freeze_count() == 0:
        gc.collect()
        gc.freeze()
