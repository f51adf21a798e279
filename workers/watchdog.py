"""A process that hangs ends itself: nobody else would, and nothing of its queues would be done any more.

The time runs in a thread of C (`faulthandler`), so that it also ends a process whose simulator never comes back from a
call and lets no other Python thread run.
"""

import faulthandler
import sys


class Watchdog:
    """Of this process, of which there is one. Where the time is over, the process tells on stderr what its threads were
    at and ends with status 1; its job's lease ends, and another worker has the job."""

    def __init__(self, *, armed: bool) -> None:
        """armed: whether it bites. It does not in processes that do more than jobs."""
        self._armed = armed

    def wait(self, seconds: float) -> None:
        """End the process after so long, unless this is called again before, or `rest`."""
        if self._armed:
            faulthandler.dump_traceback_later(seconds, exit=True, file=sys.__stderr__ or sys.stderr)

    def rest(self) -> None:
        """Nothing is waited for."""
        if self._armed:
            faulthandler.cancel_dump_traceback_later()
