"""Runner of functions on several gloo ranks, which are single-threaded processes that are reused by all tests."""

import atexit
import functools
import multiprocessing
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import nullcontext
from datetime import timedelta
from typing import Any

import torch

from tests.ports import free_port
from tests.pretend_cuda.runtime import pretend_cuda
from worker.ranks.process_group import process_group

MOST_RANKS = 8


def on_ranks(
    size: int,
    function: Callable[..., Any],
    *arguments: Any,
    timeout: float = 60.0,
    device: str = "cpu",
    host: str = "127.0.0.1",
) -> list[Any]:
    """Run function(collectives, *arguments) on `size` ranks, and return all results. Raise the first error of a rank.

    The function and its arguments must be picklable. Collective operations time out after `timeout` seconds. With the
    device "cuda:0", each rank has a simulated GPU. Rank 0 listens on the address `host`.
    """
    address = f"{host}:{free_port()}"
    futures = [_pool().submit(_run, rank, size, address, timeout, device, function, arguments) for rank in range(size)]
    return [_result(future) for future in futures]


@functools.cache
def _pool() -> ProcessPoolExecutor:
    # A task waits for all other ranks, so each process runs exactly one of them.
    context = multiprocessing.get_context("forkserver")  # imports the modules once for all ranks
    context.set_forkserver_preload(["sgsst_core.stylizing.stylizer", "worker.ranks.process_group"])
    pool = ProcessPoolExecutor(MOST_RANKS, mp_context=context)
    atexit.register(pool.shutdown, cancel_futures=True)
    return pool


def _run(
    rank: int,
    size: int,
    address: str,
    timeout: float,
    device: str,
    function: Callable[..., Any],
    arguments: tuple[Any, ...],
) -> Any:
    torch.set_num_threads(1)
    with (
        nullcontext() if device == "cpu" else pretend_cuda(),
        process_group(rank, size, address, device=device, timeout=timedelta(seconds=timeout)) as collectives,
    ):
        return function(collectives, *arguments)


def _result(future: Future[Any]) -> Any:
    return future.result(timeout=300)
