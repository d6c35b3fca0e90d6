"""Random machine failures in a cluster that runs small jobs and shares only PostgreSQL and S3.

python -m benchmarks.cluster_faults

The cluster has ten simulated hosts, which are Linux namespaces with their own network,
processes and disk: two for the API, two for dispatchers, one for Ray's head, three Ray nodes that compute, one for
PostgreSQL, and one for S3 (moto's server). As in a real cluster, services that exit are restarted, and a killed host
returns with an empty disk.

The benchmark counts accepted jobs that do not succeed (lost), jobs whose result is published twice, and results that
differ from those of `sgsst stylize` on one rank. Results of jobs on one rank must be bit-identical; for jobs on two
ranks, colors are compared. The benchmark also counts leftover files, and read requests that no API process answered
although the database was up. For each kind of fault it measures the seconds until a job continues to make steps.

Each host is connected to the switch by its own `Cable`: a pair of TAP devices between which this process forwards
packets. It can therefore drop or delay packets in one or both directions without any kernel module. The simulation
needs Linux, root, iproute2, util-linux and /dev/net/tun.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import heapq
import json
import os
import random
import re
import secrets
import selectors
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import httpx2

from benchmarks.common import parse, write_result
from benchmarks.service_kills import FINISHED, Attacked, spread
from tests.api.service import undisturbed
from tests.networks import install_tiny_weights
from tests.postgres import programs_folder
from tests.small_scenes import wall, write_files

PARAMETERS = {"preset": "standard", "steps_coarse": 0, "steps_sos": 150, "backbone": "vgg16", "early_stop": False}
SEEDS = (1, 2)
#: Number of unfinished jobs to maintain; every third job runs on two ranks. Number of faults.
QUEUE, TWO_RANKS_EVERY, FAULTS = 3, 3, 30
RAY_PORT, PG_PORT, S3_PORT, API_PORT = 6479, 5498, 5599, 8000
NODES, DISPATCHERS, APIS = ("n1", "n2", "n3"), ("d1", "d2"), ("a1", "a2")
#: Durations of faults in seconds: network cut (minimum, maximum), S3 outage, slow connection, full disk.
CUT, AWAY, SLOW, FULL = (5.0, 60.0), 30.0, 30.0, 20.0
DELAY, LOSS = 0.2, 0.05
#: Seconds after which leftover files must have been deleted.
SWEEP = 120.0
#: Size in bytes of a node's disk. It is small, so that a fault can fill it; scene, network and checkpoint still fit.
NODE_DISK = 96 << 20


class Cluster:
    """Hosts and the services that run on them."""

    def __init__(self, network: Network, weights: Path) -> None:
        self.network, self._weights = network, weights
        prefix = network.prefix
        self.urls = [f"http://{prefix}.{number}:{API_PORT}" for number in (2, 3)]
        self._addresses = {"s3": 10, "pg": 11, "head": 9, **dict(zip(NODES, (6, 7, 8), strict=True))}
        self._addresses |= {**dict(zip(APIS, (2, 3), strict=True)), **dict(zip(DISPATCHERS, (4, 5), strict=True))}
        self._ray = f"{prefix}.{self._addresses['head']}:{RAY_PORT}"
        self.database = f"postgresql+psycopg://sgsst@{prefix}.{self._addresses['pg']}:{PG_PORT}/postgres"
        self.store = {
            "AWS_ENDPOINT_URL": f"http://{prefix}.{self._addresses['s3']}:{S3_PORT}",
            "AWS_ACCESS_KEY_ID": "key",
            "AWS_SECRET_ACCESS_KEY": "secret",
            "AWS_DEFAULT_REGION": "us-east-1",
        }
        self._common = {
            "PYTHONPATH": str(Path.cwd()),
            "OMP_NUM_THREADS": "1",
            "NUMBA_NUM_THREADS": "1",
            "RAY_AUTH_MODE": "token",
            "RAY_AUTH_TOKEN": secrets.token_hex(32),
            "RAY_USAGE_STATS_ENABLED": "0",
            "NO_PROXY": "*",
            **self.store,
        }

    def __getitem__(self, name: str) -> Host:
        return self.network.hosts[name]

    def start(self) -> None:
        """Start the database and the object store, then all other services in arbitrary order."""
        for name, number in self._addresses.items():
            self.network.host(name, number, NODE_DISK if name in NODES else 1 << 30)
        self.start_services("pg")
        self.start_services("s3")
        _wait("S3", self._make_bucket)
        _wait("PostgreSQL", self.database_answers)
        for name in (*APIS, "head", *NODES, *DISPATCHERS):
            self.start_services(name)
        _wait("the service", lambda: all(_ready(url) for url in self.urls))

    def bring_back(self, name: str) -> None:
        """Restart a killed host, with an empty disk."""
        self[name].start()
        self.start_services(name)

    def start_services(self, name: str) -> None:
        """Start the services of a host."""
        host = self[name]
        python, disk = sys.executable, str(host.disk)
        if name == "pg":
            self._start_database(host)
        elif name == "s3":
            host.run([str(Path(python).with_name("moto_server")), "-H", host.address, "-p", str(S3_PORT)], self._common)
        elif name == "head":
            first = ["--head", "--port", str(RAY_PORT), "--temp-dir", f"{disk}/ray", "--include-dashboard=false"]
            host.run([*self._ray_start(host, 0), *first], self._common)
        elif name in NODES:
            own = {**self._common, "SGSST_DATA": f"{disk}/data", "SGSST_CACHE": f"{disk}/none"}
            host.run([*self._ray_start(host, 1), "--address", self._ray], own)
        elif name in APIS:
            host.run([python, "-m", "api.http.server"], {**self._service(host), "SGSST_HOST": host.address})
        else:
            host.run(
                [*self._ray_start(host, 0), "--address", self._ray], {**self._common, "SGSST_DATA": f"{disk}/data"}
            )
            host.run([python, "-m", "service.scheduling.dispatcher"], {**self._service(host), "RAY_ADDRESS": self._ray})

    def _service(self, host: Host) -> dict[str, str]:
        own = {
            "SGSST_DATA": f"{host.disk}/data",
            "SGSST_CACHE": str(self._weights),
            "SGSST_ARTIFACTS": "s3://files/sgsst",
            "SGSST_DATABASE": self.database,
            "SGSST_REQUIRE_KEYS": "false",
            "SGSST_MIN_FREE_BYTES": "0",
            "SGSST_RETRY_SECONDS": "2",
            "SGSST_CHECKPOINT_SECONDS": "1",
            "SGSST_PREVIEW_SECONDS": "5",
            "SGSST_PARALLEL_JOBS": "1",
        }
        return {**self._common, **own}

    def _ray_start(self, host: Host, cores: int) -> list[str]:
        return [
            *(sys.executable, "-m", "ray.scripts.scripts", "start", "--block", "--disable-usage-stats"),
            *("--node-ip-address", host.address, "--num-cpus", str(cores), "--num-gpus", "0"),
            *("--object-store-memory", str(80 << 20)),
        ]

    def _start_database(self, host: Host) -> None:
        programs = programs_folder()
        data = host.disk / "data"
        user = ["setpriv", "--reuid", "postgres", "--regid", "postgres", "--clear-groups"]
        host.call("chmod", "755", str(host.disk))
        host.call("install", "-d", "-o", "postgres", str(data))
        initialized = host.call(
            *user, f"{programs}/initdb", "-D", str(data), "-U", "sgsst", "-A", "trust", "--locale=C", "-EUTF8"
        )
        if initialized.returncode:
            raise RuntimeError(initialized.stderr.decode())
        host.call("sh", "-c", f"echo 'host all all {self.network.prefix}.0/24 trust' >> {data}/pg_hba.conf")
        host.run([*user, f"{programs}/postgres", "-D", str(data), "-h", host.address, "-p", str(PG_PORT), "-k", ""], {})

    def _make_bucket(self) -> bool:
        return httpx2.put(f"{self.store['AWS_ENDPOINT_URL']}/files", trust_env=False, timeout=5).status_code == 200

    def database_answers(self) -> bool:
        """Return whether PostgreSQL accepts connections."""
        with socket.create_connection((self["pg"].address, PG_PORT), timeout=2):
            return True


def _ready(url: str) -> bool:
    answer = httpx2.get(f"{url}/readyz", timeout=5, trust_env=False)
    return answer.status_code == 200 and answer.json()["status"] == "ok"


def _wait(what: str, condition: Callable[[], bool], seconds: float = 180.0) -> None:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        with contextlib.suppress(httpx2.HTTPError, OSError):
            if condition():
                return
        time.sleep(0.3)
    raise RuntimeError(f"{what} does not come")


@dataclass
class Run(Attacked):
    """Cluster under fault injection, and the figures collected."""

    cluster: Cluster = field(kw_only=True)
    chance: random.Random = field(kw_only=True)
    faults: list[dict[str, Any]] = field(default_factory=list)
    unanswered: list[float] = field(default_factory=list)
    database_away: bool = False
    over: threading.Event = field(default_factory=threading.Event)

    # --- through the API -------------------------------------------------------------------------------------------

    def fill(self) -> None:
        """Submit jobs until the queue is full."""
        for _ in range(QUEUE - self.waiting()):
            number = len(self.accepted)
            ranks = 2 if number % TWO_RANKS_EVERY == 2 else 1
            self.submit(seed=SEEDS[number % len(SEEDS)], workers=ranks)

    def steps(self) -> tuple[int, int]:
        """Return the number of ended jobs, and the total steps of running jobs.

        One of the two numbers grows whenever a job makes a step or ends.
        """
        jobs = self.jobs()
        running = [job for job in jobs if job["status"] == "running" and (job["progress"] or {}).get("loss")]
        ended = sum(job["status"] in FINISHED for job in jobs)
        return ended, sum(job["attempt"] * 1_000_000 + job["progress"]["step"] for job in running)

    def watch_reads(self) -> None:
        """Request a page of the job list every half second, and record for how long no API process responds."""
        while not self.over.wait(0.5):
            started = time.monotonic()
            if not any(self._reads(url) for url in self.urls) and not self.database_away:
                self.unanswered.append(time.monotonic() - started + 0.5)

    @staticmethod
    def _reads(url: str) -> bool:
        with contextlib.suppress(httpx2.TransportError):
            return httpx2.get(f"{url}/v1/jobs", params={"limit": 1}, timeout=3, trust_env=False).status_code == 200
        return False

    # --- faults ----------------------------------------------------------------------------------------------------

    def strike(self, kind: str) -> None:
        """Inject a fault, repair it, and record the seconds until a job makes a step."""
        self.fill()
        self.wait_for_steps(120)
        time.sleep(self.chance.uniform(0, 4))
        began = time.monotonic()
        fault, hosts = KINDS[kind]
        details = fault(self, hosts)
        mended = time.monotonic()
        self.fill()
        again = self.wait_for_steps(300)
        record = {
            "kind": kind,
            **details,
            "seconds": round(mended - began, 1),
            "until_steps_after_mending": None if again is None else round(again, 1),
        }
        self.faults.append(record)
        print(f"{len(self.faults):3} {time.strftime('%H:%M:%S')} {record}", flush=True)

    def wait_for_steps(self, seconds: float) -> float | None:
        """Wait until a job makes a step or ends, and return the seconds waited; return None after a timeout."""
        started = time.monotonic()
        before = self.steps()
        while time.monotonic() - started < seconds:
            time.sleep(0.3)
            now = self.steps()
            if now[0] > before[0] or now[1] > before[1]:
                return time.monotonic() - started
            before = min(before, now)
        return None

    def kill(self, names: Sequence[str]) -> dict[str, Any]:
        """Kill a host, and restart it."""
        name = self.chance.choice(names)
        self.cluster[name].kill()
        time.sleep(self.chance.uniform(1, 8))
        self.cluster.bring_back(name)
        return {"host": name}

    def cut(self, names: Sequence[str]) -> dict[str, Any]:
        """Cut the connection of a host in one direction or both."""
        name, seconds = self.chance.choice(names), self.chance.uniform(*CUT)
        cable, ways = self.cluster[name].cable, self.chance.choice(("both", "to", "from"))
        cable.to_host.cut, cable.from_host.cut = ways != "from", ways != "to"
        time.sleep(seconds)
        cable.mend()
        return {"host": name, "ways": ways}

    def slow(self, names: Sequence[str]) -> dict[str, Any]:
        """Delay and lose packets of a host."""
        name = self.chance.choice(names)
        for way in (self.cluster[name].cable.to_host, self.cluster[name].cable.from_host):
            way.delay, way.loss = DELAY / 2, LOSS
        time.sleep(SLOW)
        self.cluster[name].cable.mend()
        return {"host": name}

    def fill_disk(self, names: Sequence[str]) -> dict[str, Any]:
        """Fill the disk of a host."""
        name = self.chance.choice(names)
        full = self.cluster[name].disk / "full"
        self.cluster[name].call("dd", "if=/dev/zero", f"of={full}", "bs=1M", "count=4096")
        time.sleep(FULL)
        self.cluster[name].call("rm", "-f", str(full))
        return {"host": name}

    def restart(self, names: Sequence[str]) -> dict[str, Any]:
        """Restart PostgreSQL on its host."""
        self.database_away = True
        self.cluster[names[0]].call("pkill", "-INT", "-o", "postgres")
        time.sleep(1)
        _wait("PostgreSQL", self.cluster.database_answers)
        time.sleep(3)
        self.database_away = False
        return {}

    def lose(self, names: Sequence[str]) -> dict[str, Any]:
        """Cut the connection of a host in both directions, for `AWAY` seconds."""
        cable = self.cluster[names[0]].cable
        cable.to_host.cut = cable.from_host.cut = True
        time.sleep(AWAY)
        cable.mend()
        return {}


#: What each kind of fault does, and the hosts that it may strike.
KINDS: dict[str, tuple[Callable[[Run, Sequence[str]], dict[str, Any]], Sequence[str]]] = {
    "kill-node": (Run.kill, NODES),
    "cut-node": (Run.cut, NODES),
    "kill-dispatcher": (Run.kill, DISPATCHERS),
    "cut-dispatcher": (Run.cut, DISPATCHERS),
    "kill-head": (Run.kill, ["head"]),
    "slow": (Run.slow, NODES + DISPATCHERS),
    "fill-disk": (Run.fill_disk, NODES + DISPATCHERS),
    "restart-database": (Run.restart, ["pg"]),
    "lose-store": (Run.lose, ["s3"]),
    "kill-api": (Run.kill, APIS),
}


def main() -> None:
    """Inject faults, then print and store the figures."""
    parse(argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter))
    if reason := missing():
        raise SystemExit(reason)
    with tempfile.TemporaryDirectory(prefix="sgsst-c-", dir="/tmp", ignore_cleanup_errors=True) as folder:
        figures = measure(Path(folder), [*KINDS], FAULTS)
    print(json.dumps(figures, indent=2))
    print(write_result("cluster_faults", figures))
    sys.exit(bool(figures["lost"] or figures["published_twice"] or figures["different"]))


def measure(folder: Path, kinds: Sequence[str], faults: int) -> dict[str, Any]:
    """Run the cluster under faults and return all figures.

    Args:
        folder: Working folder. Its path must be short.
        kinds: Kinds of faults.
        faults: Number of faults.
    """
    folder.chmod(0o755)
    for name in ("inputs", "weights", "net", *map(str, SEEDS)):
        (folder / name).mkdir()
    install_tiny_weights(folder / "weights")
    ply, cameras, style = write_files(folder / "inputs", wall())
    files = {"scene": ply, "cameras": cameras, "style": style}
    with mock.patch.dict(os.environ, SGSST_CACHE=str(folder / "weights")):  # the cluster's network weights
        expected = {seed: undisturbed(files, {**PARAMETERS, "seed": seed}, folder / str(seed)) for seed in SEEDS}
    with Network(folder / "net") as network:
        cluster = Cluster(network, folder / "weights")
        cluster.start()
        run = Run(cluster.urls, files, PARAMETERS, cluster=cluster, chance=random.Random(0))
        reader = threading.Thread(target=run.watch_reads)
        reader.start()
        try:
            attacked = attack(run, kinds, faults)
            jobs = run.wait_for_all()
        finally:
            run.over.set()
            reader.join()
        return {"attacked_seconds": round(attacked, 1), **_count(run, jobs, expected, folder), **_left(run, jobs)}


def attack(run: Run, kinds: Sequence[str], faults: int) -> float:
    """Inject faults in rounds, each with all kinds in random order, and return the elapsed seconds."""
    started = time.monotonic()
    order: list[str] = []
    while len(run.faults) < faults:
        if not order:
            order = list(kinds)
            run.chance.shuffle(order)
        run.strike(order.pop())
    return time.monotonic() - started


def _count(run: Run, jobs: dict[str, dict[str, Any]], expected: dict[int, Path], folder: Path) -> dict[str, Any]:
    """Return the number of lost, twice published and differing jobs, and related figures."""
    ended = [job_id for job_id in run.accepted if jobs.get(job_id, {}).get("status") == "succeeded"]
    different, farthest = 0, 0.0
    for job_id in ended:
        wanted, ranks = expected[run.accepted[job_id]["seed"]], run.accepted[job_id]["workers"]
        if run.result(job_id) != wanted.read_bytes():
            distance = run.distance(job_id, wanted, folder)
            farthest = max(farthest, distance)
            different += ranks == 1 or distance > 0.05
    steps: dict[str, list[float | None]] = {}
    for record in run.faults:
        steps.setdefault(record["kind"], []).append(record["until_steps_after_mending"])
    return {
        "faults": len(run.faults),
        "jobs_accepted": len(run.accepted),
        "lost": len(run.accepted) - len(ended),
        "not_succeeded": [jobs.get(job_id, {}).get("error") for job_id in run.accepted if job_id not in ended],
        "published_twice": sum(run.published(job_id) != 1 for job_id in ended),
        "different": different,
        "farthest_of_two_ranks": farthest,
        "reads_unanswered": len(run.unanswered),
        "longest_unanswered_seconds": round(max(run.unanswered, default=0.0), 1),
        "seconds_until_steps_after_mending": {
            kind: {"never": each.count(None), **spread([value for value in each if value is not None])}
            for kind, each in sorted(steps.items())
        },
        "each": run.faults,
    }


def _left(run: Run, jobs: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return leftover files on hosts and in the object store, after dispatchers have had time to clean up."""
    deadline = time.monotonic() + SWEEP
    while True:
        hosts = {name: _files_of_jobs(run.cluster[name]) for name in (*NODES, *DISPATCHERS)}
        stray = _stray_objects(run, jobs)
        if (not any(hosts.values()) and not stray) or time.monotonic() > deadline:
            return {"left_on_hosts": hosts, "left_in_store": stray}
        time.sleep(5)


def _files_of_jobs(host: Host) -> int:
    below = [str(host.disk / "data" / name) for name in ("ranks", "work")]
    paths = host.call("find", *below, "-mindepth", "2").stdout.decode().split()
    return len(paths)


def _stray_objects(run: Run, jobs: dict[str, dict[str, Any]]) -> list[str]:
    """Return stored objects of jobs that are not published artifacts."""
    listing = subprocess.run(
        [sys.executable, "-c", _LIST],
        env={**os.environ, **run.cluster.store, "NO_PROXY": "*"},
        capture_output=True,
        text=True,
        check=True,
    )
    by_job: dict[str, list[str]] = {}
    for name in listing.stdout.split():
        if match := re.match(r"(job_[^/]+)/", name):
            by_job.setdefault(match[1], []).append(name)
    stray = []
    for job_id, names in by_job.items():
        known = {each["name"] for each in run.call("GET", f"/v1/jobs/{job_id}/artifacts").json()["artifacts"]}
        stray += names if job_id not in jobs else sorted(names)[len(known) :]
    return stray


_LIST = """
from service.files.objects import ObjectStore
print("\\n".join(ObjectStore("s3://files/sgsst").below("")))
"""

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
    if programs_folder() is None:
        return "initdb is missing: apt-get install -y postgresql"
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


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # exit normally, so that the hosts are removed too
    main()
