"""What this process answered, for Prometheus: other processes count their own."""

from fastapi import Request
from prometheus_client import CollectorRegistry, Counter, Histogram

UNKNOWN = "unknown"  # a path of no route: as its own it would make a time series a typing error


class Answered:
    """Requests by method, route and status, and how long they took."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        labels = ["method", "route"]
        self._count = Counter("asim_requests", "Requests answered", [*labels, "status"], registry=self.registry)
        self._seconds = Histogram("asim_request_seconds", "Until the answer was sent", labels, registry=self.registry)

    def tell(self, request: Request, status: int, seconds: float) -> None:
        """One more."""
        route = getattr(request.scope.get("route"), "path", UNKNOWN)
        method = request.method if route != UNKNOWN else UNKNOWN
        self._count.labels(method, route, str(status)).inc()
        self._seconds.labels(method, route).observe(seconds)
