"""Client of the service for programs without an event loop: the methods of `AsyncClient`, run by a portal's thread.

with Client("http://127.0.0.1:8000") as client:
    job = client.submit("scene.ply", "style.jpg", cameras="cameras.json", preset="preview")
    job = client.wait(job.id)
    client.download(job.id, "stylized.ply")
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterator
from contextlib import ExitStack
from typing import Any, Concatenate, ParamSpec, Self, TypeVar, cast

from anyio.from_thread import start_blocking_portal

from api.client.async_client import AsyncClient

P = ParamSpec("P")
T = TypeVar("T")
_END = object()


def _blocking(
    method: Callable[Concatenate[AsyncClient, P], Coroutine[Any, Any, T]],
) -> Callable[Concatenate[Client, P], T]:
    """Return a blocking method for a coroutine method, with its signature and docstring."""

    @functools.wraps(method)
    def blocking(client: Client, *args: P.args, **options: P.kwargs) -> T:
        return client._run(functools.partial(method, client._client, *args, **options))

    return cast("Callable[Concatenate[Client, P], T]", blocking)


def _iterating(
    method: Callable[Concatenate[AsyncClient, P], AsyncIterator[T]],
) -> Callable[Concatenate[Client, P], Iterator[T]]:
    """Return an iterator method for an asynchronous iterator method, with its signature and docstring."""

    @functools.wraps(method)
    def iterating(client: Client, *args: P.args, **options: P.kwargs) -> Iterator[T]:
        items: Any = method(client._client, *args, **options)

        async def following() -> Any:
            return await anext(items, _END)

        try:
            while (item := client._run(following)) is not _END:
                yield item
        finally:
            # An interrupt can leave the iteration running; it is canceled with the portal.
            with contextlib.suppress(RuntimeError):
                client._run(items.aclose)

    return cast("Callable[Concatenate[Client, P], Iterator[T]]", iterating)


class Client:
    """Client of the service over HTTP, with the arguments, errors and attributes of `AsyncClient`."""

    def __init__(self, url: str | None = None, key: str | None = None) -> None:
        self._client = AsyncClient(url, key)  # first: if it raises, no thread may be left running
        self._stack = ExitStack()
        self._portal = self._stack.enter_context(start_blocking_portal())
        # cancels coroutines that interrupted calls left running
        self._stack.callback(self._portal.call, self._portal.stop, True)
        self._stack.callback(self._portal.call, self._client.close)
        self.url = self._client.url

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *ignored: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections."""
        self._stack.close()

    def _run(self, function: Callable[[], Awaitable[T]]) -> T:
        """Run a coroutine function in the portal's thread. If this thread is interrupted, the coroutine is canceled."""
        future = self._portal.start_task_soon(function)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    submit = _blocking(AsyncClient.submit)
    plan = _blocking(AsyncClient.plan)
    upload = _blocking(AsyncClient.upload)
    job = _blocking(AsyncClient.job)
    jobs = _iterating(AsyncClient.jobs)
    watch = _iterating(AsyncClient.watch)
    wait = _blocking(AsyncClient.wait)
    artifacts = _blocking(AsyncClient.artifacts)
    download = _blocking(AsyncClient.download)
    blend = _blocking(AsyncClient.blend)
    video = _blocking(AsyncClient.video)
    rename = _blocking(AsyncClient.rename)
    act = _blocking(AsyncClient.act)
    finish = _blocking(AsyncClient.finish)
    cancel = _blocking(AsyncClient.cancel)
    retry = _blocking(AsyncClient.retry)
    share = _blocking(AsyncClient.share)
    shares = _blocking(AsyncClient.shares)
    revoke_share = _blocking(AsyncClient.revoke_share)
    delete = _blocking(AsyncClient.delete)
