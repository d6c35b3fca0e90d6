"""Progress of a transfer: a live bar on a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, TextColumn, TimeRemainingColumn

from sgsst_core.stylizing.progress_bar import live_bar


@contextmanager
def transfer_bar(console: Console, description: str) -> Iterator[Callable[[int, int], None]]:
    """Show the progress of a transfer; yield a function that receives the transferred and the total bytes."""
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with live_bar(console, *columns) as bar:
        task = bar.add_task(description, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total or None)
