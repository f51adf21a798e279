"""OpenTelemetry: a span for each request and each job, sent to where ASIM_TRACES_URL says; without it there are none.

Spans of one request, and of the jobs that go back to it, share the attribute `asim.correlation`.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from importlib.metadata import version

from opentelemetry import trace
from opentelemetry.trace import NoOpTracerProvider, Status, StatusCode, TracerProvider

CORRELATION = "asim.correlation"


class TracesNotInstalled(ImportError):
    """Traces are asked for, and what sends them is not installed."""


@cache
def provider(url: str) -> TracerProvider:
    """Of this process; sends to an OTLP collector by HTTP, "" to none. Raises TracesNotInstalled."""
    if not url:
        return NoOpTracerProvider()
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider as Provider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError as error:
        wanted = "pip install 'asim[traces]'"
        raise TracesNotInstalled(f"ASIM_TRACES_URL is {url}, and what sends traces is missing: {wanted}") from error
    made = Provider(resource=Resource.create({"service.name": "asim", "service.version": version("asim")}))
    made.add_span_processor(BatchSpanProcessor(OTLPSpanExporter(endpoint=url)))
    return made


@contextmanager
def span(url: str, name: str, attributes: Mapping[str, str | int]) -> Iterator[None]:
    """Around a piece of work."""
    with provider(url).get_tracer("asim").start_as_current_span(name, attributes=attributes):
        yield


def note(name: str, value: str) -> None:
    """An attribute of the span that is open here, if one is."""
    trace.get_current_span().set_attribute(name, value)


def failed(error: Exception) -> None:
    """The span that is open here ends in this error."""
    open_here = trace.get_current_span()
    open_here.record_exception(error)
    open_here.set_status(Status(StatusCode.ERROR, type(error).__name__))
