"""Tests of the message about a Ray cluster that does not answer."""

from __future__ import annotations

import socket
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest

from sgsst_core.errors import ClusterAwayError
from tests.http_servers import serve
from worker.ranks.cluster import Cluster


@pytest.mark.parametrize("address", ["127.0.0.1:{port}", "ray://127.0.0.1:{port}", "127.0.0.1:99999", "a..b:6379"])
def test_cluster_that_is_not_there_is_reported_at_once(address: str) -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        address = address.format(port=closed.getsockname()[1])
        with pytest.raises(ClusterAwayError, match=f"{address} cannot be reached: .* Check RAY_ADDRESS"):
            Cluster(1, address).open()


def test_other_program_at_the_address_is_reported() -> None:
    with ThreadingHTTPServer(("127.0.0.1", 0), SimpleHTTPRequestHandler) as server:
        serve(server)
        with pytest.raises(ClusterAwayError, match=r"cannot be reached: ConnectionError: .*is not Ray|is not Ray"):
            Cluster(1, f"127.0.0.1:{server.server_port}").open()
        server.shutdown()
