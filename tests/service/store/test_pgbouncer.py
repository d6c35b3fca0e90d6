"""Tests of the store behind pgbouncer, which runs each transaction on any of its connections to the server."""

import os
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import create_engine, text
from sqlalchemy.engine import make_url

from service.store import open_store
from tests.api.service import wait_for
from tests.ports import free_port
from tests.postgres import fresh_database
from tests.service.store.helpers import SHA, queue, store_settings

CONFIGURATION = """
[databases]
* = host={host} port={port} user={user}
[pgbouncer]
listen_addr = 127.0.0.1
listen_port = {listens}
unix_socket_dir =
auth_type = any
pool_mode = transaction
default_pool_size = 4
"""
#: Executions of a statement after which psycopg would prepare it on the server.
REPEATED = 8


@pytest.fixture
def pooled(postgres: str) -> Iterator[str]:
    """Run pgbouncer and yield the URL of an empty database behind it."""
    program = shutil.which("pgbouncer", path="/usr/sbin:/usr/bin:/usr/local/sbin:/usr/local/bin")
    if program is None:
        pytest.skip("pgbouncer is not installed (apt-get install pgbouncer)")
    server, port = make_url(fresh_database(postgres)), free_port()
    folder = Path(tempfile.mkdtemp(prefix="sgsst-pgbouncer-"))
    configuration = CONFIGURATION.format(host=server.host, port=server.port, user=server.username, listens=port)
    (folder / "pgbouncer.ini").write_text(configuration)
    user: dict[str, Any] = {}
    if os.geteuid() == 0:  # it refuses to run as root
        shutil.chown(folder, "postgres")
        shutil.chown(folder / "pgbouncer.ini", "postgres")
        user = {"user": "postgres", "group": "postgres", "extra_groups": []}
    process = subprocess.Popen([program, "--quiet", folder / "pgbouncer.ini"], cwd=folder, **user)

    def listens() -> bool:
        assert process.poll() is None, "pgbouncer has ended"
        with socket.socket() as client:
            return client.connect_ex(("127.0.0.1", port)) == 0

    try:
        wait_for(listens, "pgbouncer to listen")
        yield server.set(port=port).render_as_string()
    finally:
        process.terminate()
        process.wait()
        shutil.rmtree(folder)


def test_statements_repeat_on_shared_connections(pooled: str, tmp_path: Path) -> None:
    """The second process executes what the first would have prepared under the same name, on the same connection."""
    first, second = (open_store(store_settings(tmp_path, pooled)) for _ in range(2))
    try:
        first.inputs.add_blob(SHA, "blob", 3)
        for number in range(REPEATED):
            for store in (first, second):
                _, text = store.keys.create(f"key {number}")
                assert store.keys.find(text) is not None
                queue(store)
        assert len(first.keys.all()) == len(second.jobs.page(None)) == 2 * REPEATED
    finally:
        first.close()
        second.close()


def test_connection_that_the_server_has_closed_is_replaced(postgres: str, tmp_path: Path) -> None:
    store = open_store(store_settings(tmp_path, fresh_database(postgres)))
    try:
        store.keys.all()
        with create_engine(store.database.url).connect() as other:
            ended = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = current_database()"
            assert other.execute(text(f"{ended} AND pid != pg_backend_pid()")).all()
        assert store.keys.all() == []
    finally:
        store.close()
