"""Files of a form come out as they went in, wherever the body is held and however it is cut; faults are named."""

import asyncio
import gc
import tracemalloc
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from fastapi import HTTPException, Request
from fastapi.exceptions import RequestValidationError
from starlette.requests import ClientDisconnect
from starlette.types import Message

from service.api.uploads import IN_MEMORY, MOST_FILES, PIECE, uploads
from service.errors import InvalidField
from tests.service.kit import Served, npz, refused, room

EDGE = "-----edge"
FORM = {"content-type": f"multipart/form-data; boundary={EDGE}"}
GONE: Message = {"type": "http.disconnect"}
Read = list[tuple[str, bytes]]


def read(messages: Sequence[Message], headers: Mapping[str, str] = FORM) -> Read:
    """Name and content of each file."""
    left = iter(messages)

    async def receive() -> Message:
        return next(left)

    told = [(name.encode(), value.encode()) for name, value in headers.items()]
    request = Request({"type": "http", "method": "POST", "headers": told}, receive)
    with ThreadPoolExecutor(1) as thread:  # a browser's test may have left this one a loop that runs
        found = thread.submit(asyncio.run, uploads(request)).result()
    return [(name, bytes(content)) for name, content in found]


def form(*parts: tuple[bytes, bytes]) -> bytes:
    """Of headers and contents."""
    edge = b"--" + EDGE.encode()
    whole = b"".join(b"%s\r\n%s\r\n\r\n%s\r\n" % (edge, headers, content) for headers, content in parts)
    return whole + edge + b"--\r\n"


def file(name: str, content: bytes) -> tuple[bytes, bytes]:
    return f'Content-Disposition: form-data; name="files"; filename="{name}"'.encode(), content


def cut(body: bytes, size: int) -> list[Message]:
    starts = range(0, len(body), size)
    return [
        {"type": "http.request", "body": body[start : start + size], "more_body": start != starts[-1]}
        for start in starts
    ]


def contents() -> Iterator[bytes]:
    """With all of the edge in them but its last letter, at beginning, end and in between."""
    almost = b"\r\n--" + EDGE[:-1].encode()
    yield from (b"", b"\r\n", almost, almost * 3 + b"\r", b"x" + almost + b"--\r\n" + b"\r\n--", EDGE.encode())
    yield np.random.default_rng(0).bytes(5000)


@pytest.mark.parametrize("size", [1, 2, 3, 7, 64, 1000, 100_000])
@pytest.mark.parametrize("told", ["its length", "nothing", "both"])
def test_files_come_out_as_they_went_in_however_the_body_is_cut(size: int, told: str) -> None:
    sent = [(f"{number}.npz", content) for number, content in enumerate(contents())]
    body = form(*(file(*each) for each in sent))
    length = {} if told == "nothing" else {"content-length": str(len(body))}
    chunked = {"transfer-encoding": "chunked"} if told == "both" else {}
    assert read(cut(body, size), FORM | length | chunked) == sent


def test_a_long_body_goes_to_the_disk_whole() -> None:
    sent = [("a", np.random.default_rng(1).bytes(IN_MEMORY)), ("b", b"ab" * PIECE)]
    body = form(*(file(*each) for each in sent))
    assert read(cut(body, 300_000), FORM | {"content-length": str(len(body))}) == sent


def test_other_fields_are_passed_over_and_files_may_have_no_name() -> None:
    body = form(
        (b'Content-Disposition: form-data; name="note"', b"some words"),
        (b"X-Else: what", b"no field"),
        (b'content-DISPOSITION: form-data; filename="a \xc3\xa9.npz"; name="files"\r\nContent-Type: text/x', b"one"),
        (b'Content-Disposition: form-data; name="files"; filename="\xe9"', b"two"),
        (b'Content-Disposition: form-data; name="files"', b"three"),
    )
    assert read(cut(body, 10)) == [("a é.npz", b"one"), ("é", b"two"), ("file", b"three")]


@pytest.mark.parametrize("size", [1, 10_000])
def test_a_form_that_ends_too_early_is_refused(size: int) -> None:
    body = form(file("a", b"content"), file("b", b"content"))
    for length in (10, len(EDGE) + 30, len(body) // 2, len(body) - len(EDGE), len(body) - 4):
        with pytest.raises(HTTPException, match="no whole multipart/form-data") as refusal:
            read(cut(body[:length], size))
        assert refusal.value.status_code == 400


def test_a_body_that_is_no_form_of_files_is_refused() -> None:
    with pytest.raises(HTTPException, match="names no boundary"):
        read(cut(form(file("a", b"")), 10), {"content-type": "multipart/form-data"})
    with pytest.raises(HTTPException, match="longer than the 12 bytes that content-length tells"):
        read(cut(form(file("a", b"content" * 2)), 10), FORM | {"content-length": "12"})
    for headers, body in ((FORM, form()), ({}, b"{}"), ({"content-type": "application/json"}, b"{}")):
        with pytest.raises(RequestValidationError, match="files"):
            read(cut(body, 10), headers)
    with pytest.raises(InvalidField, match=f"files: .*{MOST_FILES + 1}"):
        read(cut(form(*(file("a", b"") for _ in range(MOST_FILES + 1))), 10_000))
    with pytest.raises(ClientDisconnect):
        read([*cut(form(file("a", b"content")), 50)[:1], GONE])


def test_the_memory_of_a_body_goes_with_its_files_and_waits_for_no_collection() -> None:
    size = 8 * 2**20
    body = form(file("a", bytes(size)))
    messages, headers = cut(body, 2**18), FORM | {"content-length": str(len(body))}
    read(messages, headers)
    gc.disable()
    tracemalloc.start()
    try:
        read(messages, headers)
        left, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
        gc.enable()
    assert peak > size
    assert left < size // 8


def test_the_service_says_what_is_wrong_with_a_form(served: Served) -> None:
    project, content = served.project(), npz(room(0))
    for headers, body, status, words in (
        ({"Content-Type": "multipart/form-data"}, b"", 400, ["body", "boundary"]),
        (FORM, form(file("a.npz", content))[:-20], 400, ["body", "no whole"]),
        (FORM, form(*(file("a.npz", b"") for _ in range(MOST_FILES + 1))), 422, ["files", MOST_FILES + 1, MOST_FILES]),
        (FORM, form((b'Content-Disposition: form-data; name="file"', content)), 422, ["files"]),
    ):
        answer = served.client.post("/trajectories", params={"project": project}, content=body, headers=headers)
        kind = {400: "bad-request", 422: "malformed-request" if len(words) == 1 else "invalid-field"}[status]
        refused(answer, status, kind, *words)
    chunks = (form(file("a.npz", content))[start : start + 999] for start in range(0, len(content) + 999, 999))
    answer = served.client.post("/trajectories", params={"project": project}, content=chunks, headers=FORM)
    assert [item["source"] for item in answer.json()["items"]] == ["a.npz"]
