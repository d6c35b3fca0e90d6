"""Simulated hosts on one machine: Linux namespaces with their own network, processes, name and disk, on one switch.

Each host is connected to the switch by its own `Cable`: a pair of TAP devices between which this process forwards
packets. It can therefore drop or delay packets in one or both directions without any kernel module. The simulation
needs Linux, root, iproute2, util-linux and /dev/net/tun.
"""

from __future__ import annotations

import contextlib
import fcntl
import heapq
import os
import random
import selectors
import shutil
import signal
import struct
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

#: From `linux/if_tun.h`: request to name a TAP device, and flag for packets without a header.
_TUNSETIFF, _TAP_WITHOUT_HEADER = 0x400454CA, 0x0002 | 0x1000
_LARGEST_PACKET = 65536
_TOOLS = ("ip", "unshare", "nsenter", "mount")
#: Numbers N for networks 10.77.N. The scripts in deploy/ use numbers from 81 on.
_NETWORKS = range(61, 80)


def missing() -> str | None:
    """Return why this machine cannot run simulated hosts, or None if it can."""
    if os.name != "posix" or not hasattr(os, "geteuid") or os.geteuid() != 0:
        return "hosts of namespaces need Linux and root"
    for tool in _TOOLS:
        if shutil.which(tool) is None:
            return f"{tool} is missing: apt-get install -y iproute2 util-linux mount"
    return None if Path("/dev/net/tun").exists() else "/dev/net/tun is missing"


@dataclass
class Way:
    """One direction of a cable.

    Attributes:
        cut: Whether all packets are dropped.
        delay: Delay of each packet in seconds.
        loss: Fraction of packets that are lost.
    """

    cut: bool = False
    delay: float = 0.0
    loss: float = 0.0


@dataclass
class Cable:
    """Cable between a host and the switch."""

    to_host: Way = field(default_factory=Way)
    from_host: Way = field(default_factory=Way)

    def mend(self) -> None:
        """Restore both directions."""
        for way in (self.to_host, self.from_host):
            way.cut, way.delay, way.loss = False, 0.0, 0.0


class Carrier(threading.Thread):
    """Thread that forwards the packets of all cables."""

    def __init__(self) -> None:
        super().__init__(name="cables", daemon=True)
        self._selector = selectors.DefaultSelector()
        self._lock = threading.Lock()
        self._late: list[tuple[float, int, int, bytes]] = []
        self._count = 0
        self._chance = random.Random(0)
        self._ended = threading.Event()

    def add(self, source: int, way: Way, target: int) -> None:
        """Start forwarding packets from the device with descriptor `source` to the one with descriptor `target`."""
        with self._lock:
            self._selector.register(source, selectors.EVENT_READ, (way, target))

    def remove(self, *descriptors: int) -> None:
        """Stop forwarding packets of the given descriptors."""
        with self._lock:
            for each in descriptors:
                self._drop(each)
            self._late = [packet for packet in self._late if packet[2] not in descriptors]
            heapq.heapify(self._late)

    def end(self) -> None:
        """Stop the thread."""
        self._ended.set()
        self.join()

    def run(self) -> None:
        """Forward packets until `end` is called."""
        while not self._ended.is_set():
            wait = min(0.05, max(0.0, self._late[0][0] - time.monotonic())) if self._late else 0.05
            ready = self._selector.select(wait)
            with self._lock:
                for key, _ in ready:
                    self._carry(key.fd, *key.data)
                while self._late and self._late[0][0] <= time.monotonic():
                    _, _, target, packet = heapq.heappop(self._late)
                    self._write(target, packet)

    def _carry(self, source: int, way: Way, target: int) -> None:
        if source not in self._selector.get_map():  # removed since it became ready
            return
        try:
            packet = os.read(source, _LARGEST_PACKET)
        except BlockingIOError:
            return
        except OSError:  # its device is gone
            self._drop(source)
            return
        if way.cut or (way.loss and self._chance.random() < way.loss):
            return
        if way.delay:
            self._count += 1
            heapq.heappush(self._late, (time.monotonic() + way.delay, self._count, target, packet))
        else:
            self._write(target, packet)

    def _drop(self, descriptor: int) -> None:
        with contextlib.suppress(KeyError, ValueError, OSError):
            self._selector.unregister(descriptor)

    @staticmethod
    def _write(target: int, packet: bytes) -> None:
        with contextlib.suppress(OSError):  # a full queue drops packets, as a switch does; a device may be gone
            os.write(target, packet)


class Network:
    """Switch with hosts, in the first unused network of `_NETWORKS`. This machine has the address `gateway`.

    The context manager removes everything on exit. Several instances on one machine do not interfere. If a killed
    process has left its network behind, the next free network is used.

    Args:
        folder: New folder for logs and the hosts' disks.

    Attributes:
        prefix: First three numbers of all addresses; set when the context is entered.
        name: Name of the switch, and prefix of the devices' names.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.prefix, self.name = folder, "", ""
        self.carrier = Carrier()
        self.hosts: dict[str, Host] = {}

    @property
    def gateway(self) -> str:
        """Address of this machine."""
        return f"{self.prefix}.1"

    def __enter__(self) -> Network:
        self._take()
        _ip("link", "set", self.name, "up")
        _ip("address", "add", f"{self.gateway}/24", "dev", self.name)
        self.carrier.start()
        return self

    def __exit__(self, *_: object) -> None:
        for host in self.hosts.values():
            host.kill()
        self.carrier.end()
        _ip("link", "delete", self.name, check=False)

    def _take(self) -> None:
        """Create a switch with an unused name, so that no other process uses the same network."""
        for number in _NETWORKS:
            self.prefix, self.name = f"10.77.{number}", f"sgsst{number}"
            process = subprocess.run(["ip", "link", "add", self.name, "type", "bridge"], capture_output=True, text=True)
            if process.returncode == 0:
                return
        raise RuntimeError(
            f"no network of 10.77.{_NETWORKS[0]} to {_NETWORKS[-1]} could be taken: {process.stderr.strip()}"
        )

    def host(self, name: str, number: int, disk_bytes: int = 1 << 30) -> Host:
        """Create and start a host."""
        host = Host(self, name, f"{self.prefix}.{number}", disk_bytes)
        self.hosts[name] = host
        host.start()
        return host


class Host:
    """Simulated host. Services that `run` has started are restarted when they exit, until the host is killed.

    Attributes:
        disk: Folder of the host's disk. It is in memory, and empty after each start.
        log: Log file of the host's services, across restarts.
    """

    def __init__(self, network: Network, name: str, address: str, disk_bytes: int) -> None:
        self.network, self.name, self.address = network, name, address
        self.cable = Cable()
        self.disk = network.folder / "disk"
        self.log = network.folder / f"{name}.log"
        self._disk_bytes = disk_bytes
        self._space = f"{network.name}-{name}"
        self._descriptors: tuple[int, ...] = ()
        self._first: subprocess.Popen[bytes] | None = None
        self._services: list[subprocess.Popen[bytes]] = []

    @property
    def runs(self) -> bool:
        """Whether the host is running."""
        return self._first is not None

    def start(self) -> None:
        """Start the host, with an empty disk and no services."""
        self.disk.mkdir(parents=True, exist_ok=True)
        _ip("netns", "delete", self._space, check=False)  # its file survives a reboot if /run is on a disk
        _ip("netns", "add", self._space)
        self._plug_in()
        setup = (
            f"hostname {self.name}; mount -t tmpfs -o size={self._disk_bytes} tmpfs {self.disk}; exec sleep infinity"
        )
        command = ["ip", "netns", "exec", self._space, "unshare", "--uts", "--pid", "--mount", "--fork", "--mount-proc"]
        with self.log.open("ab") as log:
            self._first = subprocess.Popen([*command, "--kill-child", "bash", "-c", setup], stdout=log, stderr=log)
        deadline = time.monotonic() + 20
        while self.call("mountpoint", "-q", str(self.disk)).returncode:
            if time.monotonic() > deadline:
                raise RuntimeError(f"host {self.name} did not start: {self.log.read_text()}")
            time.sleep(0.05)

    def kill(self) -> None:
        """Kill all processes of the host at once, and delete its disk."""
        if self._first is None:
            return
        self._first.send_signal(signal.SIGKILL)
        self._first.wait()
        for process in self._services:
            process.kill()
            process.wait()
        self._first, self._services = None, []
        self.network.carrier.remove(*self._descriptors)
        for descriptor in self._descriptors:
            os.close(descriptor)
        self._descriptors = ()
        self.cable.mend()
        _ip("netns", "delete", self._space, check=False)

    def call(self, *command: str) -> subprocess.CompletedProcess[bytes]:
        """Run a command on the host and wait for it."""
        return subprocess.run([*self._enter(), *command], capture_output=True, check=False)

    def run(self, command: Sequence[str], environment: Mapping[str, str]) -> None:
        """Run a service on the host; restart it a second after it exits, as a supervisor would."""
        again = 'while true; do "$@"; sleep 1; done'
        with self.log.open("ab") as log:
            self._services.append(
                subprocess.Popen(
                    [*self._enter(), "bash", "-c", again, "supervisor", *command],
                    env={**os.environ, **environment},
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                )
            )

    def _enter(self) -> list[str]:
        """Return the command prefix that runs a command on the host."""
        assert self._first is not None
        children = Path(f"/proc/{self._first.pid}/task/{self._first.pid}/children")
        deadline = time.monotonic() + 10
        while not (pids := children.read_text().split()) and time.monotonic() < deadline:
            time.sleep(0.02)
        return ["nsenter", "-t", pids[0], "-n", "-u", "-p", "-m", f"--wd={Path.cwd()}"]

    def _plug_in(self) -> None:
        """Connect the host: create a device in its network and one at the switch."""
        own, other = f"{self._space}-h"[:15], f"{self._space}-s"[:15]
        host, switch = _tap(own), _tap(other)
        self._descriptors = (host, switch)
        _ip("link", "set", other, "master", self.network.name, "up")
        _ip("link", "set", own, "netns", self._space, "name", "eth0")
        inside = ("-n", self._space)
        _ip(*inside, "link", "set", "lo", "up")
        _ip(*inside, "link", "set", "eth0", "up")
        _ip(*inside, "address", "add", f"{self.address}/24", "dev", "eth0")
        _ip(*inside, "route", "add", "default", "via", self.network.gateway)
        self.network.carrier.add(host, self.cable.from_host, switch)
        self.network.carrier.add(switch, self.cable.to_host, host)


def _tap(name: str) -> int:
    """Create a TAP device and return its descriptor; closing it removes the device."""
    descriptor = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    fcntl.ioctl(descriptor, _TUNSETIFF, struct.pack("16sH", name.encode(), _TAP_WITHOUT_HEADER))
    return descriptor


def _ip(*arguments: str, check: bool = True) -> None:
    subprocess.run(["ip", *arguments], check=check, capture_output=not check)
