"""Failed API keys, counted by who sends them: after some a minute, no more are looked up for a while.

Counted in this process's memory; another API process counts its own.
"""

from ipaddress import ip_address, ip_network
from math import ceil
from time import time
from uuid import UUID

from limits import RateLimitItem
from limits.storage import MemoryStorage
from limits.strategies import MovingWindowRateLimiter

from service.errors import TooManyFailedKeys


class FailedKeys:
    """Failures of the last minute, by address and by the key that a secret claims to be of."""

    def __init__(self, per_address: RateLimitItem, per_key: RateLimitItem) -> None:
        self._per_key, self._per_address = per_key, per_address
        self._limiter = MovingWindowRateLimiter(MemoryStorage())

    def check(self, host: str, key: UUID | None) -> None:
        """Raises TooManyFailedKeys."""
        for limit, names in self._counted(host, key):
            if not self._limiter.test(limit, *names):
                free = self._limiter.get_window_stats(limit, *names).reset_time
                raise TooManyFailedKeys(limit.amount, max(1, ceil(free - time())))

    def count(self, host: str, key: UUID | None) -> None:
        """One more failure."""
        for limit, names in self._counted(host, key):
            self._limiter.hit(limit, *names)

    def _counted(self, host: str, key: UUID | None) -> list[tuple[RateLimitItem, tuple[str, ...]]]:
        network = _network(host)
        return [(self._per_address, ("address", network)), (self._per_key, ("key", network, str(key)))]


def _network(host: str) -> str:
    """An IPv4 address; of an IPv6 address the network, since each of its holders has all addresses of one."""
    try:
        address = ip_address(host)
    except ValueError:
        return host
    return str(ip_network(f"{address}/64", strict=False)) if address.version == 6 else host
