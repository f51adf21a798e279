"""Long bodies are handed on in larger pieces, whole and in order; who leaves in the midst of one is heard."""

import asyncio
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from starlette.types import Message

from service.api.gathering import ENOUGH, gathered

GONE: Message = {"type": "http.disconnect"}


def handed_on(messages: Sequence[Message]) -> list[Message]:
    """All that comes through, up to the end of the body or to a disconnect."""

    async def ask() -> list[Message]:
        left = iter(messages)

        async def receive() -> Message:
            return next(left)

        read, found = gathered(receive), list[Message]()
        while not found or found[-1].get("more_body"):
            found.append(await read())
        return found

    with ThreadPoolExecutor(1) as thread:  # a browser's test may have left this one a loop that runs
        return thread.submit(asyncio.run, ask()).result()


def body(sizes: Sequence[int], *, ends: bool = True) -> list[Message]:
    pieces = [bytes([number % 256]) * size for number, size in enumerate(sizes)]
    last = len(pieces) - 1
    return [
        {"type": "http.request", "body": piece, "more_body": number < last or not ends}
        for number, piece in enumerate(pieces)
    ]


def test_a_body_comes_whole_in_fewer_pieces() -> None:
    sent = body([65_536] * 50 + [1])
    found = handed_on(sent)
    assert b"".join(each["body"] for each in found) == b"".join(each["body"] for each in sent)
    assert min(len(each["body"]) for each in found[:-1]) >= ENOUGH
    assert len(found) <= 14


def test_a_short_body_is_handed_on_as_it_is() -> None:
    for sent in (body([0]), body([12]), body([ENOUGH + 1])):
        assert handed_on(sent) == sent


def test_a_client_that_leaves_is_heard_after_what_it_sent() -> None:
    found = handed_on([*body([10, 10], ends=False), GONE])
    assert found == [{"type": "http.request", "body": b"\0" * 10 + b"\1" * 10, "more_body": True}, GONE]
