"""Long bodies in large pieces.

The server hands over what one read of the socket brought. A file of an upload that is on disk by then is written by a
thread, each piece by another trip to it, which costs more than the writing.
"""

from starlette.types import Message, Receive

ENOUGH = 2**18  # bytes


def gathered(receive: Receive) -> Receive:
    """The same body, ENOUGH bytes or more at a time but for its end."""
    kept: list[Message] = []  # what came after a piece and is no part of a body

    async def read() -> Message:
        message = kept.pop() if kept else await receive()
        if message["type"] != "http.request" or not message.get("more_body"):
            return message
        pieces, size = [message.get("body", b"")], len(message.get("body", b""))
        while size < ENOUGH and message.get("more_body"):
            following = await receive()
            if following["type"] != "http.request":
                kept.append(following)
                break
            message = following
            pieces.append(message.get("body", b""))
            size += len(pieces[-1])
        return {"type": "http.request", "body": b"".join(pieces), "more_body": message.get("more_body", False)}

    return read
