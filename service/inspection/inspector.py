"""Asks `service.inspection.process` about users' files; the process that asks never reads them itself."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

from service.errors import BusyError, RefusedInputError
from service.files.staging import Staged, stage
from service.parameters import JobParameters
from service.settings import ServiceSettings
from service.store import Store

#: What is wanted of the inspecting process: prove that a job's inputs can be used, or plan the job as well.
Work = Literal["validate", "plan"]
#: Raised when validation changes, so that what older ones found does not count.
_VERSION = "1"
#: Requests that wait for the inspecting process at most; more are told to come back.
_MAX_WAITING = 64
_MAX_ANSWER = 64 << 20
_LEFT_SECONDS = 3600.0


class InspectionProcess:
    """The process, started when it is first needed and again when it has died; one request at a time."""

    def __init__(self) -> None:
        self._process: asyncio.subprocess.Process | None = None
        self._lock = asyncio.Lock()
        self._waiting = 0

    async def ask(self, request: dict[str, Any]) -> dict[str, Any]:
        """The answer to a request.

        Raises:
            BusyError: too many wait already, or the process died twice.
        """
        if self._waiting >= _MAX_WAITING:
            raise BusyError("Too many files are being checked. Try again later.", retry_after=10)
        self._waiting += 1
        try:
            async with self._lock:
                for _ in range(2):
                    answer = await self._exchange(json.dumps(request).encode() + b"\n")
                    if answer is not None:
                        return answer
        finally:
            self._waiting -= 1
        raise BusyError("Files cannot be checked at the moment. Try again later.", retry_after=10)

    async def _exchange(self, line: bytes) -> dict[str, Any] | None:
        if self._process is None or self._process.returncode is not None:
            self._process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-m",
                "service.inspection.process",
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                limit=_MAX_ANSWER,
                env={**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""},
                start_new_session=True,
            )
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(line)
            await process.stdin.drain()
            said = await process.stdout.readline()
            return json.loads(said) if said else None
        except (OSError, ValueError):
            return None
        except asyncio.CancelledError:  # its answer would be taken for that to the next request
            await self.close()
            raise
        finally:
            if process.returncode is None and process.stdout.at_eof():
                await self.close()

    async def close(self) -> None:
        """End the process."""
        process, self._process = self._process, None
        if process is not None and process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()


class Inspector:
    """Validates and plans whole jobs, once for the same files and parameters."""

    def __init__(self, settings: ServiceSettings, store: Store) -> None:
        self._settings = settings
        self._store = store
        self._validating, self._planning = InspectionProcess(), InspectionProcess()
        self._folder = settings.folder / "inspections"
        self._folder.mkdir(parents=True, exist_ok=True)
        for left in self._folder.iterdir():  # by a process that was killed
            if time.time() - left.stat().st_mtime > _LEFT_SECONDS:
                shutil.rmtree(left, ignore_errors=True)
        self._limits = {
            "gaussians": settings.max_gaussians,
            "views": settings.max_views,
            "pixels": settings.max_pixels,
            "image_pixels": settings.max_image_pixels,
        }

    def recall(
        self, work: Work, inputs: Sequence[Mapping[str, Any]], parameters: JobParameters
    ) -> dict[str, Any] | None:
        """What `inspect` found in the same files before; None where they are new.

        Raises:
            RefusedInputError: they were found to be of no use.
        """
        known = self._store.inputs.inspection(self._key(work, inputs, parameters))
        return None if known is None else _found_or_refused(known)

    async def inspect(
        self,
        work: Work,
        inputs: Sequence[Mapping[str, Any]],
        blobs: Mapping[str, Path],
        parameters: JobParameters,
    ) -> dict[str, Any]:
        """What `service.inspection.process` finds in a job's inputs.

        Raises:
            RefusedInputError: they cannot be used.
            BusyError: it cannot be told now.
        """
        recalled = await asyncio.to_thread(self.recall, work, inputs, parameters)
        if recalled is not None:
            return recalled
        answer = await self._ask_process(work, inputs, blobs, parameters)
        passing = answer.get("error", {}).get("code") in ("inspection-limit", "invalid-weights")
        if not passing:  # another day it may be otherwise
            key = self._key(work, inputs, parameters)
            await asyncio.to_thread(self._store.inputs.add_inspection, key, answer)
        return _found_or_refused(answer)

    async def _ask_process(
        self,
        work: str,
        inputs: Sequence[Mapping[str, Any]],
        blobs: Mapping[str, Path],
        parameters: JobParameters,
    ) -> dict[str, Any]:
        seconds = self._settings.inspection_seconds if work == "validate" else self._settings.dry_run_seconds
        process = self._validating if work == "validate" else self._planning
        with tempfile.TemporaryDirectory(dir=self._folder) as folder:
            staged = await asyncio.to_thread(stage, Path(folder), inputs, blobs)
            return await process.ask(
                {
                    "work": work,
                    "folder": folder,
                    "staged": _as_text(staged),
                    "parameters": parameters.model_dump(mode="json"),
                    "limits": self._limits,
                    "seconds": seconds,
                    "bytes": self._settings.inspection_bytes,
                }
            )

    def _key(self, work: str, inputs: Sequence[Mapping[str, Any]], parameters: JobParameters) -> str:
        files = sorted((entry["role"], entry["name"], entry["sha256"]) for entry in inputs)
        told = parameters.model_dump(mode="json", exclude={"name", "workers", "seed"})
        text = json.dumps([_VERSION, work, files, told, self._limits], sort_keys=True)
        return f"{work}:{hashlib.sha256(text.encode()).hexdigest()}"

    async def close(self) -> None:
        """End both processes."""
        await self._validating.close()
        await self._planning.close()


def _found_or_refused(answer: Mapping[str, Any]) -> dict[str, Any]:
    """What the process found; raises RefusedInputError where that is an error."""
    if "error" in answer:
        error = answer["error"]
        raise RefusedInputError(
            error["message"], error["code"], **({"input": error["input"]} if error["input"] else {})
        )
    found: dict[str, Any] = answer["found"]
    return found


def _as_text(staged: Staged) -> dict[str, str | None]:
    return {role: str(path) if path is not None else None for role, path in asdict(staged).items()}
