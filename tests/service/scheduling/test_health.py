"""Tests of container health checks, and of the dependencies that processes wait for at startup."""

from __future__ import annotations

from pathlib import Path

import pytest

from service.health import dispatcher_is_healthy
from service.prepare import main as prepare
from service.scheduling.capacity import is_dead, is_of_this_machine, own_name
from service.settings import ServiceSettings
from service.store import Store, open_store


def test_dispatcher_is_healthy_while_it_sends_heartbeats(tmp_path: Path) -> None:
    now = 1000.0
    store = open_store(ServiceSettings(data=tmp_path, lease_seconds=30), lambda: now)
    assert not dispatcher_is_healthy(store)
    store.operations.record_heartbeat("elsewhere-01234567-1-1", 1, 1)
    assert not dispatcher_is_healthy(store), "that is another machine's"
    store.operations.record_heartbeat(own_name(), 1, 1)
    assert dispatcher_is_healthy(store)
    now += 31
    assert not dispatcher_is_healthy(store)
    store.close()


def test_dispatcher_is_healthy_during_a_database_outage() -> None:
    url = "postgresql+psycopg://nobody@127.0.0.1:1/none"
    pytest.importorskip("psycopg", reason="psycopg is not installed: see the extra [postgresql]")
    assert dispatcher_is_healthy(Store(ServiceSettings(database=url)))


def test_dispatcher_names_identify_the_machine() -> None:
    assert is_of_this_machine(own_name())
    assert not is_dead(own_name())
    for name in ("", "host", "host-01234567-1-1", "a-b-c-d-e"):
        assert not is_of_this_machine(name)
        assert not is_dead(name)


def test_prepare_creates_the_tables_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SGSST_DATA", str(tmp_path))
    assert prepare() == prepare() == 0
    store = Store(ServiceSettings())
    assert store.database.is_up_to_date()
    store.close()
    monkeypatch.setenv("SGSST_DATABASE", "postgresql+psycopg://nobody@127.0.0.1:1/none")
    monkeypatch.setenv("SGSST_START_SECONDS", "0")
    assert prepare() == 1
