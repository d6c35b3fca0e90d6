"""Transport of the clients: each method is written once as a generator of steps, and two drivers run it.

A method yields steps (`Call`, `Hear`, `Fetch`, `Listen`, `FileWork`, `Wait`). The driver runs each step, and sends its
result or its error back to the method. `BlockingDriver` runs steps in the caller's thread. `AwaitingDriver` awaits
them, and runs file access in other threads. `Operation` and `Iteration` turn such a generator into a blocking or an
asynchronous method.
"""

from __future__ import annotations

import asyncio
import functools
import inspect
import os
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Generator, Iterator
from dataclasses import dataclass, field
from typing import Any, Concatenate, Generic, ParamSpec, Self, TypeVar, overload

import httpx
import stamina
from httpx_sse import ServerSentEvent, aconnect_sse, connect_sse

from api.client.answers import Event, checked, is_passing, unreachable
from api.client.downloads import BLOCK, Download
from api.client.events import EventStream

DEFAULT_URL = "http://127.0.0.1:8000"
#: Maximum number of attempts of a request, with waits of 1, 2, 4 ... seconds between them.
TRIES = 6
_RETRIES: dict[str, Any] = {
    "attempts": TRIES,
    "timeout": None,
    "wait_initial": 1.0,
    "wait_max": 2.0 ** (TRIES - 2),
    "wait_jitter": 0.0,
    "wait_exp_base": 2,
}

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class Call:
    """Request whose response is read completely. It is retried after temporary failures."""

    method: str
    path: str
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Hear:
    """Request whose response may be a stream of events.

    Each event is passed to `take`, and the step has no result. Any other response is handled like that of a `Call`.
    """

    call: Call
    take: Callable[[ServerSentEvent], None]


@dataclass(frozen=True)
class FileWork:
    """Blocking file access."""

    function: Callable[[], Any]


@dataclass(frozen=True)
class Fetch:
    """File to download. A broken download is resumed."""

    download: Download


@dataclass(frozen=True)
class Wait:
    """Pause of some seconds."""

    seconds: float


@dataclass(frozen=True)
class Item(Generic[T]):
    """Value that the method yields to its caller."""

    value: T


@dataclass(frozen=True)
class Listen:
    """Connection to a stream of events until it ends. Connection errors propagate; events are yielded."""

    stream: EventStream


Step = Call | Hear | FileWork | Fetch | Listen | Wait
Steps = Generator[Step, Any, T]
Walk = Generator[Step | Item[T], Any, None]


class Operation(Generic[P, T]):
    """Method with a result: called on a `BlockingDriver`, awaited on an `AwaitingDriver`."""

    def __init__(self, steps: Callable[Concatenate[Any, P], Steps[T]]) -> None:
        self.steps = steps

    @overload
    def __get__(self, client: BlockingDriver, owner: type) -> Callable[P, T]: ...

    @overload
    def __get__(self, client: AwaitingDriver, owner: type) -> Callable[P, Coroutine[Any, Any, T]]: ...

    def __get__(self, client: Any, owner: type) -> Any:
        """Declare the method's type for type checkers. `Methods` replaces the descriptor by a function."""
        raise NotImplementedError


class Iteration(Generic[P, T]):
    """Method that yields values: for `for` on a `BlockingDriver` and `async for` on an `AwaitingDriver`."""

    def __init__(self, steps: Callable[Concatenate[Any, P], Walk[T]]) -> None:
        self.steps = steps

    @overload
    def __get__(self, client: BlockingDriver, owner: type) -> Callable[P, Iterator[T]]: ...

    @overload
    def __get__(self, client: AwaitingDriver, owner: type) -> Callable[P, AsyncIterator[T]]: ...

    def __get__(self, client: Any, owner: type) -> Any:
        """Declare the method's type for type checkers, like `Operation`."""
        raise NotImplementedError


class Methods:
    """Base class for operations and iterations. In a subclass that is also a driver, they become methods.

    Attributes:
        url: Address of the service.
    """

    url: str

    def __init_subclass__(cls) -> None:
        """Replace the operations and iterations of the base classes by functions."""
        if not issubclass(cls, BlockingDriver | AwaitingDriver):
            return
        for base in cls.__mro__:
            for name, found in vars(base).items():
                if isinstance(found, Operation):
                    setattr(cls, name, _named(cls._as_method(found.steps), found.steps, "{}"))
                elif isinstance(found, Iteration):
                    setattr(cls, name, _named(cls._as_iterator(found.steps), found.steps, cls._iterator))


def _named(method: Any, steps: Callable[..., Any], answer: str) -> Any:
    """Give a method the name, docstring and signature of its steps, and return it.

    `answer` is the format string of the return annotation. The type of the steps' result is inserted into it.
    """
    functools.update_wrapper(method, steps)
    signature = inspect.signature(steps)
    result = str(signature.return_annotation).partition("[")[2].removesuffix("]")
    method.__signature__ = signature.replace(return_annotation=answer.format(result))
    return method


def _http_options(url: str | None, key: str | None) -> dict[str, Any]:
    key = key or os.environ.get("SGSST_KEY")
    return {
        "base_url": url or os.environ.get("SGSST_URL") or DEFAULT_URL,
        "headers": {"Authorization": f"Bearer {key}"} if key else {},
        "timeout": httpx.Timeout(30.0, read=900.0, write=120.0),
    }


def _has_file(response: httpx.Response) -> bool:
    """Return whether a response is a file, a part of one, or status 416, which means that all bytes were received."""
    return not response.is_error or response.status_code == httpx.codes.REQUESTED_RANGE_NOT_SATISFIABLE


def _has_events(response: httpx.Response) -> bool:
    kind: str = response.headers.get("content-type", "")
    return kind.startswith("text/event-stream")


class BlockingDriver:
    """Driver that runs steps in the caller's thread.

    Args:
        url: Address of the service. None uses the environment variable SGSST_URL, or port 8000 of this machine if the
            variable is not set.
        key: API key; None uses the environment variable SGSST_KEY.
    """

    _iterator = "Iterator[{}]"

    def __init__(self, url: str | None = None, key: str | None = None) -> None:
        self._http = httpx.Client(**_http_options(url, key))
        self.url = str(self._http.base_url)
        self._retrying = stamina.RetryingCaller(**_RETRIES).on(is_passing)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *ignored: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections."""
        self._http.close()

    @staticmethod
    def _as_method(steps: Callable[..., Steps[Any]]) -> Callable[..., Any]:
        """Return a method that runs the steps and returns their result."""

        def method(self: BlockingDriver, *args: Any, **options: Any) -> Any:
            return self._run(steps(self, *args, **options))

        return method

    @staticmethod
    def _as_iterator(steps: Callable[..., Walk[Any]]) -> Callable[..., Iterator[Any]]:
        """Return a method that runs the steps and yields their items."""

        def method(self: BlockingDriver, *args: Any, **options: Any) -> Iterator[Any]:
            yield from self._walk(steps(self, *args, **options))

        return method

    def _run(self, steps: Steps[Any]) -> Any:
        try:
            step = next(steps)
            while True:
                try:
                    result = self._do(step)
                except Exception as error:
                    step = steps.throw(error)
                else:
                    step = steps.send(result)
        except StopIteration as end:
            return end.value

    def _walk(self, steps: Walk[Any]) -> Iterator[Any]:
        try:
            step = next(steps)
            while True:
                try:
                    result = None
                    if isinstance(step, Item):
                        yield step.value
                    elif isinstance(step, Listen):
                        yield from self._events(step.stream)
                    else:
                        result = self._do(step)
                except Exception as error:
                    step = steps.throw(error)
                else:
                    step = steps.send(result)
        except StopIteration:
            return

    def _do(self, step: Step) -> Any:
        match step:
            case Call():
                return self._retry(self._call, step)
            case Hear():
                return self._retry(self._hear, step)
            case Fetch():
                return self._retry(self._fetch, step.download)
            case Listen():
                return sum(1 for _ in self._events(step.stream))
            case FileWork():
                return step.function()
            case Wait():
                return time.sleep(step.seconds)

    def _retry(self, function: Callable[[Any], Any], argument: Any) -> Any:
        try:
            return self._retrying(function, argument)
        except httpx.TransportError as error:
            raise unreachable(self.url, error) from None

    def _call(self, call: Call) -> httpx.Response:
        return checked(self._http.request(call.method, call.path, **call.options))

    def _hear(self, step: Hear) -> httpx.Response | None:
        call = step.call
        with connect_sse(self._http, call.method, call.path, **call.options) as source:
            if not _has_events(source.response):
                source.response.read()
                return checked(source.response)
            for sent in source.iter_sse():
                step.take(sent)
            return None

    def _fetch(self, download: Download) -> None:
        with self._http.stream("GET", download.path, headers=download.headers()) as response:
            if not _has_file(response):
                response.read()
                checked(response)
            if download.begin(response):
                for block in response.iter_bytes(BLOCK):
                    download.write(block)
                    download.report()
        download.finish()

    def _events(self, stream: EventStream) -> Iterator[Event]:
        with connect_sse(self._http, "GET", stream.path, **stream.options()) as source:
            if source.response.status_code != httpx.codes.OK:
                source.response.read()
                stream.refuse(source.response)
                return
            for sent in source.iter_sse():
                yield from stream.take(sent)


class AwaitingDriver:
    """Driver that awaits steps, and reads and writes files in other threads.

    Args:
        url: Address of the service. None uses the environment variable SGSST_URL, or port 8000 of this machine if the
            variable is not set.
        key: API key; None uses the environment variable SGSST_KEY.
    """

    _iterator = "AsyncIterator[{}]"

    def __init__(self, url: str | None = None, key: str | None = None) -> None:
        self._http = httpx.AsyncClient(**_http_options(url, key))
        self.url = str(self._http.base_url)
        self._retrying = stamina.AsyncRetryingCaller(**_RETRIES).on(is_passing)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *ignored: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close all connections."""
        await self._http.aclose()

    @staticmethod
    def _as_method(steps: Callable[..., Steps[Any]]) -> Callable[..., Any]:
        """Return a coroutine method that awaits the steps and returns their result."""

        async def method(self: AwaitingDriver, *args: Any, **options: Any) -> Any:
            return await self._run(steps(self, *args, **options))

        return method

    @staticmethod
    def _as_iterator(steps: Callable[..., Walk[Any]]) -> Callable[..., AsyncIterator[Any]]:
        """Return an asynchronous iterator method that awaits the steps and yields their items."""

        async def method(self: AwaitingDriver, *args: Any, **options: Any) -> AsyncIterator[Any]:
            async for item in self._walk(steps(self, *args, **options)):
                yield item

        return method

    async def _run(self, steps: Steps[Any]) -> Any:
        try:
            step = next(steps)
            while True:
                try:
                    result = await self._do(step)
                except Exception as error:
                    step = steps.throw(error)
                else:
                    step = steps.send(result)
        except StopIteration as end:
            return end.value

    async def _walk(self, steps: Walk[Any]) -> AsyncIterator[Any]:
        try:
            step = next(steps)
            while True:
                try:
                    result = None
                    if isinstance(step, Item):
                        yield step.value
                    elif isinstance(step, Listen):
                        async for event in self._events(step.stream):
                            yield event
                    else:
                        result = await self._do(step)
                except Exception as error:
                    step = steps.throw(error)
                else:
                    step = steps.send(result)
        except StopIteration:
            return

    async def _do(self, step: Step) -> Any:
        match step:
            case Call():
                return await self._retry(self._call, step)
            case Hear():
                return await self._retry(self._hear, step)
            case Fetch():
                return await self._retry(self._fetch, step.download)
            case Listen():
                return sum([1 async for _ in self._events(step.stream)])
            case FileWork():
                return await asyncio.to_thread(step.function)
            case Wait():
                return await asyncio.sleep(step.seconds)

    async def _retry(self, function: Callable[[Any], Coroutine[Any, Any, Any]], argument: Any) -> Any:
        try:
            return await self._retrying(function, argument)
        except httpx.TransportError as error:
            raise unreachable(self.url, error) from None

    async def _call(self, call: Call) -> httpx.Response:
        return checked(await self._http.request(call.method, call.path, **call.options))

    async def _hear(self, step: Hear) -> httpx.Response | None:
        call = step.call
        async with aconnect_sse(self._http, call.method, call.path, **call.options) as source:
            if not _has_events(source.response):
                await source.response.aread()
                return checked(source.response)
            async for sent in source.aiter_sse():
                step.take(sent)
            return None

    async def _fetch(self, download: Download) -> None:
        headers = await asyncio.to_thread(download.headers)
        async with self._http.stream("GET", download.path, headers=headers) as response:
            if not _has_file(response):
                await response.aread()
                checked(response)
            if await asyncio.to_thread(download.begin, response):
                async for block in response.aiter_bytes(BLOCK):
                    await asyncio.to_thread(download.write, block)
                    download.report()
        await asyncio.to_thread(download.finish)

    async def _events(self, stream: EventStream) -> AsyncIterator[Event]:
        async with aconnect_sse(self._http, "GET", stream.path, **stream.options()) as source:
            if source.response.status_code != httpx.codes.OK:
                await source.response.aread()
                stream.refuse(source.response)
                return
            async for sent in source.aiter_sse():
                for event in stream.take(sent):
                    yield event
