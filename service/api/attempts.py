"""Failed API keys, counted by who sends them: after some a minute, no more are looked up for a while.

Counted in this process's memory; another API process counts its own.
"""

import hashlib
from collections import OrderedDict
from ipaddress import ip_address, ip_network
from math import ceil
from time import time
from uuid import UUID

from limits import RateLimitItem
from limits.storage import MemoryStorage
from limits.strategies import MovingWindowRateLimiter

from service.errors import ServiceError

MOST_GOOD = 1_000


class TooManyFailedKeys(ServiceError):
    """Too many API keys that open nothing came from here."""

    status_code = 429

    def __init__(self, failures: int, seconds: int) -> None:
        super().__init__(
            f"authorization: {failures} keys of this machine failed within a minute; try again in {seconds} s"
        )
        self.headers = {"Retry-After": str(seconds)}


class FailedKeys:
    """Failures of the last minute, by address and by the key that a secret claims to be of."""

    def __init__(self, per_address: RateLimitItem, per_key: RateLimitItem) -> None:
        self._per_key, self._per_address = per_key, per_address
        self._limiter = MovingWindowRateLimiter(MemoryStorage())
        self._good: OrderedDict[bytes, None] = OrderedDict()  # hashes of secrets that opened something, newest last

    def vouch(self, secret: str) -> None:
        """This secret opened something: the failures of others at its address do not lock it out."""
        self._good[_hash(secret)] = None
        self._good.move_to_end(_hash(secret))
        if len(self._good) > MOST_GOOD:
            self._good.popitem(last=False)

    def is_good(self, secret: str) -> bool:
        """Whether it opened something lately; it is looked up all the same."""
        return _hash(secret) in self._good

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


def _hash(secret: str) -> bytes:
    return hashlib.sha256(secret.encode("utf-8", "surrogateescape")).digest()


def _network(host: str) -> str:
    """An IPv4 address; of an IPv6 address the network, since each of its holders has all addresses of one."""
    try:
        address = ip_address(host)
    except ValueError:
        return host
    return str(ip_network(f"{address}/64", strict=False)) if address.version == 6 else host
