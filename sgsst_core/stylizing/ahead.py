"""Photos for a GPU: the next one is read while the device works on a step."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import torch
from torch import Tensor

#: Content image [H, W, 3] of a view by its index, on the CPU.
PhotoLoader = Callable[[int], Tensor]


class PhotosAhead:
    """Hands out photos on a GPU without a wait for it, and has a thread read one of them in advance.

    Photos lie in pinned memory until they are copied, so that the copy is only one more entry in the device's stream.
    Their memory is not written to before it is done: PyTorch marks pinned memory with an event at each such copy, and
    gives it out again only once the device has come there. There is never more than one photo in advance, and no thread
    but between `begin` and `end`.

    The thread reserves pinned memory whenever it comes to it, which CUDA takes for a mistake of a graph that is
    captured at the time, unless the capture heeds its own thread alone (`capture_error_mode="thread_local"`).

    Args:
        load: reads a photo; called in the thread too.
        device: a CUDA device.
    """

    def __init__(self, load: PhotoLoader, device: torch.device) -> None:
        self._load = load
        # A thread begins with the first device as its own: it has to be told which one is meant.
        self._device = torch.device("cuda", torch.cuda.current_device()) if device.index is None else device
        self._thread: ThreadPoolExecutor | None = None
        self._next: tuple[int, Future[Tensor]] | None = None

    def begin(self, index: int) -> None:
        """Let the thread read a photo; the one that was read in advance, if it is another one, is given up."""
        if self._next is not None:
            if self._next[0] == index:
                return
            self._next[1].cancel()
            self._next = None
        if self._thread is None:
            self._thread = ThreadPoolExecutor(1, thread_name_prefix="photo")
        self._next = index, self._thread.submit(self._pinned, index)

    def __call__(self, index: int) -> Tensor:
        """A photo [H, W, 3] on the device: the one that was read in advance, or another one, read now.

        Raises:
            ImageError: whatever `load` raises, in the thread or here.
        """
        if self._next is not None and self._next[0] == index:
            photo, self._next = self._next[1], None
            return self._copied(photo.result())
        return self._copied(self._pinned(index))

    def end(self) -> None:
        """Wait until the thread is gone, and give up what it has read. `begin` would start another one."""
        if self._thread is not None:
            self._thread.shutdown(cancel_futures=True)
        self._thread = self._next = None

    def _pinned(self, index: int) -> Tensor:
        photo = self._load(index)
        with torch.cuda.device(self._device):
            return photo.pin_memory()

    def _copied(self, photo: Tensor) -> Tensor:
        return photo.to(self._device, non_blocking=True)
