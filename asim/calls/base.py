"""What all calls stand on: one transport, answers as schemas, listings page by page."""

from collections.abc import Iterator
from typing import Self, TypeVar
from uuid import UUID

from pydantic import BaseModel

from api_schemas.base import Page
from asim.transport import Transport

Schema = TypeVar("Schema", bound=BaseModel)
Id = UUID | str
PAGE_SIZE = 1000  # the largest that the service gives
LONGEST_HOLD = 20.0  # seconds that the service is asked to hold back an answer


class Calls:
    """Connections to one service, closed at the end of a `with` block or by `close`."""

    def __init__(self, transport: Transport, timeout: float) -> None:
        self._transport = transport
        self._hold = min(LONGEST_HOLD, timeout / 2)  # an answer that is held back must not count as lost

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._transport.close()

    def _get(self, path: str, schema: type[Schema], **params: object) -> Schema:
        return schema.model_validate_json(self._transport.request("GET", path, params=params).content)

    def _post(self, path: str, body: BaseModel, schema: type[Schema]) -> Schema:
        return schema.model_validate_json(self._transport.request("POST", path, body=body).content)

    def _bytes(self, path: str, **params: object) -> bytes:
        return self._transport.request("GET", path, params=params).content

    def _pages(self, path: str, schema: type[Schema], **params: object) -> Iterator[Schema]:
        while True:
            page = self._page(path, schema, limit=PAGE_SIZE, **params)
            yield from page.items
            if page.next is None or not page.items:
                return
            params["cursor"] = page.next

    def _page(self, path: str, schema: type[Schema], **params: object) -> Page[Schema]:
        page_of = Page[schema]  # type: ignore[valid-type]  # pydantic builds the page's class at run time
        page: Page[Schema] = page_of.model_validate_json(self._bytes(path, **params))
        return page
