"""Requests to servers that are not trusted.

Each request has its own connection, to an address that was checked. Nothing depends on the environment: no proxy, no
certificate authorities of its own. Callers limit the time and the bytes of the response.
"""

import asyncio
import ipaddress
import re
import socket
import ssl
import threading
from collections.abc import AsyncIterator, Mapping
from concurrent.futures import Future
from contextlib import asynccontextmanager
from functools import cache

import httpx2

_MAX_URL = 2000
#: Host name as in DNS; `_` is not allowed in host names but is in use.
_NAME = re.compile(r"(?=.{1,253}$)[a-z0-9_-]{1,63}(\.[a-z0-9_-]{1,63})*\.?", re.ASCII)
#: The only part of IPv6 that is assigned for global unicast.
_GLOBAL_UNICAST = ipaddress.IPv6Network("2000::/3")
#: IETF protocol assignments, including a cloud's metadata service; older versions of Python consider most of it public.
_PROTOCOL_ASSIGNMENTS = ipaddress.IPv4Network("192.0.0.0/24")
#: Prefix under which NAT64 translates to IPv4 (RFC 6052).
_NAT64 = ipaddress.IPv6Network("64:ff9b::/96")


def parse_url(url: str) -> httpx2.URL:
    """Parse a URL in the same way as the client that sends the request.

    Raises:
        ValueError: If the URL cannot be called; the message is the reason.
    """
    if len(url) > _MAX_URL:
        raise ValueError(f"it has {len(url):,} characters, at most {_MAX_URL:,} are allowed")
    try:
        parsed = httpx2.URL(url)
        host, port = parsed.raw_host.decode(), parsed.port
    except (httpx2.InvalidURL, UnicodeError) as error:
        raise ValueError(f"it is not a valid URL ({error})") from error
    if parsed.scheme not in ("http", "https"):
        raise ValueError("its scheme is neither http nor https")
    if parsed.userinfo:
        raise ValueError("it holds a user name or password")
    if port is not None and not 0 < port < 65536:
        raise ValueError("its port must be between 1 and 65535")
    if "%" in host or not (_NAME.fullmatch(host) or ":" in host):  # httpx2 has checked bracketed hosts
        raise ValueError("it has no valid host name")
    return parsed


def is_public(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> bool:
    """Return whether an address is public; an IPv6 address with an embedded IPv4 address counts as the latter."""
    if isinstance(address, ipaddress.IPv6Address):
        embedded = address.ipv4_mapped or address.sixtofour
        if address in _NAT64:
            embedded = ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)
        if embedded is not None:
            return is_public(embedded)
        if address not in _GLOBAL_UNICAST or address.teredo is not None:
            return False
    return address.is_global and not address.is_multicast and address not in _PROTOCOL_ASSIGNMENTS


def _look_up(host: str, port: int) -> Future[list[str]]:
    """Look up the addresses of a host on a daemon thread.

    The resolver cannot be interrupted, and the thread of an executor would delay the exit of the process. A thread that
    outlives its request ends with the resolver's own timeout.
    """
    future: Future[list[str]] = Future()
    future.set_running_or_notify_cancel()

    def run() -> None:
        try:
            entries = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError) as error:
            future.set_exception(OSError(f"{host} is not known ({error})"))
        else:
            future.set_result([str(entry[4][0]) for entry in entries])

    threading.Thread(target=run, name="lookup", daemon=True).start()
    return future


async def checked_address(host: str, port: int, *, private_allowed: bool) -> str:
    """Return an address of a host that may be called; callers connect to this address, not to the name.

    Raises:
        PermissionError: If any address of the host is not public.
        OSError: If the name is unknown.
    """
    addresses = [address.partition("%")[0] for address in await asyncio.wrap_future(_look_up(host, port))]
    if not private_allowed:
        for address in addresses:
            if not is_public(ipaddress.ip_address(address)):
                raise PermissionError(f"{host} leads to {address}, which is not public")
    return addresses[0]


def origin(url: httpx2.URL) -> tuple[str, str, int]:
    """Return the scheme, host and port of a URL, as they are looked up and connected to."""
    return url.scheme, url.raw_host.decode(), url.port or (443 if url.scheme == "https" else 80)


def parse_origins(text: str) -> frozenset[tuple[str, str, int]]:
    """Return the origins of a list such as "files.example.com, http://minio:9000"; the default scheme is https.

    Raises:
        ValueError: If an entry is not an origin.
    """
    origins = set()
    for entry in filter(None, (each.strip() for each in text.split(","))):
        try:
            url = parse_url(entry if "://" in entry else f"https://{entry}")
        except ValueError as error:
            raise ValueError(f"{entry!r} is not a host: {error}") from error
        if url.raw_path != b"/" or url.fragment or "?" in entry:
            raise ValueError(f"{entry!r} is not a host: leave out its path")
        origins.add(origin(url))
    return frozenset(origins)


@cache
def public_authorities() -> ssl.SSLContext:
    """Return the settings that verify servers by the public certificate authorities, which are read from a file."""
    return httpx2.create_ssl_context(trust_env=False)


@asynccontextmanager
async def send(
    method: str,
    url: httpx2.URL,
    headers: Mapping[str, str],
    *,
    private_allowed: bool,
    content: bytes | None = None,
    tls: ssl.SSLContext | None = None,
) -> AsyncIterator[httpx2.Response]:
    """Send a request to a checked address, and provide the response, whose body has not been read.

    Redirects are not followed. The certificate must belong to the host of the URL.

    Args:
        url: Address from `parse_url`.
        private_allowed: Whether the host may have addresses that are not public.
        tls: SSL context for verifying the server; None for the public certificate authorities.

    Raises:
        PermissionError: If an address of the host is not allowed.
        OSError: If the host is unknown.
        httpx2.TransportError: If there is no valid response.
    """
    _, host, port = origin(url)
    address = await checked_address(host, port, private_allowed=private_allowed)
    verify = await asyncio.to_thread(public_authorities) if tls is None else tls
    async with (
        # one client per request: a pooled connection to an address would be reused for other names
        httpx2.AsyncClient(verify=verify, timeout=None, follow_redirects=False, trust_env=False) as client,
        client.stream(
            method,
            url.copy_with(host=address, port=port),
            content=content,
            headers={**headers, "host": url.netloc.decode()},
            extensions={"sni_hostname": host},
        ) as response,
    ):
        yield response
