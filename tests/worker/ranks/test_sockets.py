"""Tests of the sockets of ranks: if all ranks are on one machine, other machines cannot reach them."""

import os
import pickle
import sys
from ipaddress import IPv6Address, ip_address
from pathlib import Path
from typing import Any

import psutil
import pytest
import torch
import torch.distributed as dist

from sgsst_core.parallel import Collectives
from tests.worker.ranks.faults import name_of, small_request
from tests.worker.ranks.spawn import on_ranks
from tests.worker.ranks.test_attempts import command, start

pytestmark = [
    pytest.mark.usefixtures("one_thread"),
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a process's sockets are read in Linux's /proc"),
]


def listening(process: psutil.Process) -> list[str]:
    """Return the addresses on which a process accepts connections or datagrams; none if it has ended."""
    sockets: list[str] = []
    try:
        connections = process.net_connections("inet")
    except psutil.NoSuchProcess:
        return sockets
    for socket in connections:
        if socket.status == psutil.CONN_LISTEN or (socket.type.name == "SOCK_DGRAM" and not socket.raddr):
            address = ip_address(socket.laddr.ip)
            mapped = address.ipv4_mapped if isinstance(address, IPv6Address) else None
            sockets.append(str(mapped or address))
    return sockets


@pytest.mark.slow
def test_single_machine_job_listens_on_loopback_only(tmp_path: Path, tiny_installed: Path) -> None:
    process = start(command(small_request(tmp_path, 400)))
    try:
        driver = psutil.Process(process.pid)
        family = [driver, *driver.children(recursive=True)]
        sockets = {f"{name_of(each)} {each.pid}": listening(each) for each in family}
    finally:
        process.terminate()
        process.communicate(timeout=120)
    ranks = [addresses for name, addresses in sockets.items() if "RankProcess" in name]
    assert [len(addresses) >= 2 for addresses in ranks] == [True, True], (
        f"ranks without sockets of their group: {sockets}"
    )
    for daemon in ("raylet", "gcs_server"):
        assert any(daemon in name and addresses for name, addresses in sockets.items()), sockets
    elsewhere = {
        name: addresses
        for name, addresses in sockets.items()
        if not all(ip_address(each).is_loopback for each in addresses)
    }
    assert elsewhere == {}


def own_sockets(collectives: Collectives) -> list[str]:
    """Return the addresses that a rank listens on while it is a member of a process group."""
    collectives.all_gather(None)
    return listening(psutil.Process())


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2"])
def test_ranks_listen_only_on_the_address_of_their_job(host: str) -> None:
    """In this test, 127.0.0.2 represents the address of a cluster's network interface."""
    first, second = on_ranks(2, own_sockets, host=host)
    assert host in first, "the ranks' store"
    assert {"127.0.0.1", host} >= {*first, *second}


class Evil:
    """Object that creates a folder when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)


def send_raw(data: bytes, source: int) -> None:
    """Send raw bytes in place of a message of rank `source`, after receiving those of the ranks below it."""
    message = torch.frombuffer(bytearray(data), dtype=torch.uint8)
    for rank in range(source + 1):
        size = torch.tensor([len(data)])
        dist.broadcast(size, rank)
        dist.broadcast(message if rank == source else torch.empty(int(size), dtype=torch.uint8), rank)


def receive(collectives: Collectives, path: Path, broadcast: bool) -> str:
    """Send a pickle from one rank to the other, and return the error message of the receiver."""
    if collectives.rank == (0 if broadcast else 1):
        send_raw(pickle.dumps(Evil(path)), collectives.rank)
        return ""
    try:
        collectives.broadcast(lambda: None) if broadcast else collectives.all_gather(None)
    except Exception as error:
        return str(error)
    return "nothing was raised"


@pytest.mark.parametrize("broadcast", [False, True], ids=["all_gather", "broadcast"])
def test_pickle_from_another_rank_is_not_loaded(tmp_path: Path, broadcast: bool) -> None:
    answers = on_ranks(2, receive, tmp_path / "made", broadcast)
    assert not (tmp_path / "made").exists()
    assert "not a message of this program" in answers[1 if broadcast else 0]
