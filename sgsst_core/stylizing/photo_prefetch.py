"""Prefetching of photos for a GPU: the next one is read while the device works on a step."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import torch
from torch import Tensor

#: Function that loads the content image [H, W, 3] of a view by its index, on the CPU.
PhotoLoader = Callable[[int], Tensor]


class PhotosAhead:
    """Loader that copies photos to a GPU without synchronizing, and prefetches one of them in a thread.

    Photos are loaded into pinned memory, so that a copy is just another entry in the device's stream. This memory is
    not overwritten before the copy is done: PyTorch marks pinned memory with an event at each such copy, and reuses it
    only once the device has reached that event. At most one photo is prefetched at a time, and the thread exists only
    between `start` and `stop`.

    The thread may allocate pinned memory while a graph is being captured, which invalidates the capture, unless the
    capture is restricted to its own thread (`capture_error_mode="thread_local"`).

    Args:
        load: Function that reads a photo; also called in the thread.
    """

    def __init__(self, load: PhotoLoader, device: torch.device) -> None:
        self._load = load
        # A new thread starts on the first device, so the device must be explicit.
        self._device = torch.device("cuda", torch.cuda.current_device()) if device.index is None else device
        self._thread: ThreadPoolExecutor | None = None
        self._next: tuple[int, Future[Tensor]] | None = None

    def start(self, index: int) -> None:
        """Start reading a photo in the thread; a different prefetched photo is discarded."""
        if self._next is not None:
            if self._next[0] == index:
                return
            self._next[1].cancel()
            self._next = None
        if self._thread is None:
            self._thread = ThreadPoolExecutor(1, thread_name_prefix="photo")
        self._next = index, self._thread.submit(self._pinned, index)

    def __call__(self, index: int) -> Tensor:
        """Return a photo [H, W, 3] on the device; it is read now unless it has been prefetched.

        Raises:
            ImageError: If reading fails.
        """
        if self._next is not None and self._next[0] == index:
            photo, self._next = self._next[1], None
            return self._copied(photo.result())
        return self._copied(self._pinned(index))

    def stop(self) -> None:
        """Stop the thread, and discard what it has read. `start` starts a new one."""
        if self._thread is not None:
            self._thread.shutdown(cancel_futures=True)
        self._thread = self._next = None

    def _pinned(self, index: int) -> Tensor:
        photo = self._load(index)
        with torch.cuda.device(self._device):
            return photo.pin_memory()

    def _copied(self, photo: Tensor) -> Tensor:
        return photo.to(self._device, non_blocking=True)
