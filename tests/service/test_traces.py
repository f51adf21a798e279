"""Spans of requests and jobs reach an OTLP collector, one correlation for what belongs together; none without a URL."""

import sys
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from typing import Any

import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

from service import traces
from tests.service.conftest import Serve
from tests.service.kit import Served, room


class Collector(ThreadingHTTPServer):
    """Keeps the spans that it is sent, by name."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Receiver)
        self.spans: dict[str, Any] = {}

    @property
    def url(self) -> str:
        """Where to send spans."""
        return f"http://127.0.0.1:{self.server_address[1]}/v1/traces"


class _Receiver(BaseHTTPRequestHandler):
    server: Collector

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        sent = ExportTraceServiceRequest.FromString(body)
        for resource in sent.resource_spans:
            for scope in resource.scope_spans:
                self.server.spans |= {span.name: span for span in scope.spans}
        self.send_response(200)
        self.end_headers()

    def log_message(self, *args: object) -> None:
        """Say nothing."""


@pytest.fixture
def collector() -> Iterator[Collector]:
    with Collector() as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.shutdown()
        thread.join()
    traces.provider(server.url).shutdown()  # type: ignore[attr-defined]  # the SDK's


def attribute(span: Any, name: str) -> str:
    return str({each.key: each.value.string_value for each in span.attributes}[name])


def test_a_request_and_its_jobs_are_spans_of_one_correlation(start: Serve, collector: Collector) -> None:
    served = start(traces_url=collector.url)
    project = served.project()
    served.upload(project, room(0))
    body = {"project": project, "count": 2, "strategy": "random"}
    assert served.client.post("/acquire", json=body, headers={"X-Correlation-ID": "mine"}).status_code == 202
    served.drain()
    traces.provider(collector.url).force_flush()  # type: ignore[attr-defined]  # the SDK's
    assert {"POST /acquire", "POST /projects", "job score_shard", "job merge_scores"} <= set(collector.spans)
    for name in ("POST /acquire", "job score_shard", "job merge_scores"):
        assert attribute(collector.spans[name], traces.CORRELATION) == "mine", name
    assert attribute(collector.spans["POST /projects"], traces.CORRELATION) != "mine"


def test_a_failed_job_is_a_failed_span(start: Serve, collector: Collector) -> None:
    served = start(traces_url=collector.url)
    project = served.project()
    trajectory = served.upload(project, room(0))[0]["id"]
    served.label(project, [{"trajectory": trajectory, "start": 0, "actions": [0]}])
    assert served.client.post("/rounds", json={"project": project}).status_code == 202
    for path in (served.settings.data_folder / "blobs").rglob("*"):
        if path.is_file():
            path.write_bytes(b"damaged")
    served.drain("train")
    traces.provider(collector.url).force_flush()  # type: ignore[attr-defined]  # the SDK's
    failed = {name: span for name, span in collector.spans.items() if span.status.code == 2}
    assert "job train_round" in failed
    assert [event.name for event in failed["job train_round"].events] == ["exception"]


def test_without_a_url_there_are_no_spans(served: Served) -> None:
    assert not served.settings.traces_url
    assert "opentelemetry.sdk" not in str(type(traces.provider("")))


def test_what_sends_traces_may_be_missing_and_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "opentelemetry.sdk.trace", None)
    with pytest.raises(traces.TracesNotInstalled, match=r"asim\[traces\]"):
        traces.provider("http://127.0.0.1:9/v1/traces")
