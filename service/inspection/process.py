"""The process that looks into users' files: `python -m service.inspection.process`.

It imports what takes long once, then forks for each request a child with limits on time and memory, which reads the
files and dies. So a hostile file can break nothing but the answer to its own request. Requests and answers are lines of
JSON on stdin and stdout, one at a time.
"""

from __future__ import annotations

import json
import os
import resource
import select
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import torch

from service.files.staging import Staged
from service.parameters import JobParameters
from service.request import scene_request, stylize_request
from sgsst_core.errors import CameraError, InvalidInputError, SgsstError, WeightsError
from sgsst_core.features.network_weights import list_network_weights, load_network_weights
from sgsst_core.files.images import check_photos, image_size, load_image
from sgsst_core.files.ply import read_scene
from sgsst_core.files.ply_header import element_offsets, read_header
from sgsst_core.planning.planner import make_plan
from sgsst_core.report.document import plan_json
from sgsst_core.scene.camera import Camera, fit_cameras
from sgsst_core.scene.gaussians import Scene
from worker.inputs import check_something_in_view, read_cameras_of
from worker.request import check_steps


class RefusedError(Exception):
    """An input beyond the service's own limits; code and message for the user."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


def validate(staged: Staged, parameters: JobParameters, limits: dict[str, Any]) -> dict[str, Any]:
    """Read every input of a job as the job would; nothing is rendered.

    Returns:
        `gaussians`, `dropped`, `sh_degree`, `views`, `pixels` (of all views), `style` (width, height), `photos`.

    Raises:
        RefusedError, InvalidInputError: an input that cannot be used, with `part`, the role that it has.
    """
    return _read_inputs(staged, parameters, limits)[0]


def _read_inputs(
    staged: Staged, parameters: JobParameters, limits: dict[str, Any]
) -> tuple[dict[str, Any], Scene, list[Camera]]:
    """What `validate` finds, and what it has read: the scene and the cameras."""
    settings = parameters.settings()
    check_steps(settings)
    _check_network_weights(parameters.backbone)
    found: dict[str, Any] = {}
    source = scene_request(staged, parameters)
    with _ErrorsOf("scene"):
        header = read_header(staged.scene)
        element_offsets(staged.scene, header)
        declared = header.vertex.count if "vertex" in header.names else 0
        if declared > limits["gaussians"]:
            raise RefusedError(
                "too-many-gaussians", f"The scene has {declared:,} Gaussians; {limits['gaussians']:,} may be."
            )
        file = read_scene(source.scene, drop_invalid=source.drop_invalid)
        found |= {"gaussians": len(file.scene), "dropped": file.dropped, "sh_degree": file.scene.sh_degree}
    with _ErrorsOf("style"):
        _check_pixel_count(staged.style, limits)
        image = load_image(staged.style)
        found["style"] = [image.shape[1], image.shape[0]]
    with _ErrorsOf("cameras"):
        if source.cameras is not None:
            _check_frames_have_sizes(source.cameras)
        cameras = fit_cameras(read_cameras_of(source, file.scene), settings)
        if len(cameras) > limits["views"]:
            raise RefusedError("too-many-views", f"There are {len(cameras):,} views; {limits['views']:,} may be.")
        pixels = sum(camera.width * camera.height for camera in cameras)
        if pixels > limits["pixels"]:
            raise RefusedError("too-many-pixels", f"All views have {pixels:,} pixels; {limits['pixels']:,} may be.")
        check_something_in_view(file.scene, cameras, source.near)
        found |= {"views": len(cameras), "pixels": pixels}
    with _ErrorsOf("photos"):
        paths = check_photos(staged.photos, cameras) if staged.photos else []
        for path in paths:
            _check_pixel_count(path, limits)
            load_image(path)
        found["photos"] = len(paths)
    return found, file.scene, cameras


def plan(staged: Staged, parameters: JobParameters, limits: dict[str, Any]) -> dict[str, Any]:
    """What a job would do: what `validate` finds, and the plan of `sgsst plan`."""
    found, scene, cameras = _read_inputs(staged, parameters, limits)
    request = stylize_request(staged, parameters)
    weights = load_network_weights(request.backbone)
    made, _ = make_plan(scene, cameras, request.settings, weights=weights, measured=True)
    seconds = memory = on_device = None
    if made.prediction:
        memory, on_device = made.prediction.peak_bytes, made.prediction.device_bytes
        coarse = made.prediction.seconds_coarse or made.prediction.seconds
        seconds = made.prediction.seconds * request.settings.steps_sos + coarse * made.steps_coarse
    return {
        **found,
        "plan": plan_json(made),
        "estimated_seconds": seconds,
        "memory_bytes": memory,
        "device_memory_bytes": on_device,
    }


WORK: dict[str, Callable[[Staged, JobParameters, dict[str, Any]], dict[str, Any]]] = {
    "validate": validate,
    "plan": plan,
}


class _ErrorsOf:
    """Marks errors with the part of the request that they are about."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __enter__(self) -> None:
        return

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is not None and not hasattr(error, "part"):
            error.part = self._name  # type: ignore[attr-defined]


def _check_network_weights(backbone: str) -> None:
    installed = [entry.name for entry in list_network_weights() if entry.path]
    wanted = [name for name in ("vgg19", "vgg16") if backbone in ("auto", name)]
    if not any(name in installed for name in wanted):
        raise WeightsError(f"The service has no weights of {' or '.join(wanted)}: its operator has to fetch them.")


def _check_pixel_count(path: Path, limits: dict[str, Any]) -> None:
    width, height = image_size(path)
    if width * height > limits["image_pixels"]:
        raise RefusedError(
            "image-too-large", f"{path.name}: has {width} x {height} pixels; {limits['image_pixels']:,} may be."
        )


def _check_frames_have_sizes(path: Path) -> None:
    """Refuse frames of a transforms.json that leave their size to an image: its path may lead anywhere on this machine,
    and the answer would tell what is there.
    """
    for file in sorted(path.glob("*.json")) if path.is_dir() else [path]:
        try:
            content = json.loads(file.read_text(encoding="utf-8-sig"))
        except (ValueError, RecursionError):
            continue  # the reader says what is wrong with it
        frames = content.get("frames") if isinstance(content, dict) else None
        for index, frame in enumerate(frames if isinstance(frames, list) else []):
            if isinstance(frame, dict) and not {"w", "h"} <= {**content, **frame}.keys():
                raise CameraError(f"{file}: camera {index}: gives no size. Add the sizes of the images as 'w' and 'h'.")


# --- one request in a child ----------------------------------------------------------------------------------------


def _inspect(request: dict[str, Any]) -> dict[str, Any]:
    """What a child writes: `{"found": ...}` or `{"error": {"code", "message", "input"}}`."""
    try:
        os.chdir(request["folder"])
        paths = {role: Path(path) if path else None for role, path in request["staged"].items()}
        staged = Staged(**paths)  # type: ignore[arg-type]
        return {"found": WORK[request["work"]](staged, JobParameters(**request["parameters"]), request["limits"])}
    except (RefusedError, InvalidInputError) as error:
        return _refusal(error.code, str(error), getattr(error, "part", None))
    except MemoryError as error:
        return _refusal("inspection-limit", "Reading it takes more memory than allowed.", getattr(error, "part", None))
    except SgsstError as error:
        return _refusal(error.code, str(error), getattr(error, "part", None))
    except Exception as error:  # a reader that broke on it is the file's fault until shown otherwise
        if "memory" in str(error).lower():
            return _refusal("inspection-limit", "Reading it takes more memory than allowed.", None)
        print(f"inspection: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
        return _refusal("invalid-input", "The files cannot be read.", getattr(error, "part", None))


def _refusal(code: str, message: str, part: str | None) -> dict[str, Any]:
    return {"error": {"code": code, "message": message.removeprefix(f"{part}/"), "input": part}}


def _limit_resources(seconds: float, size: int) -> None:
    own = psutil.Process().memory_info().vms
    resource.setrlimit(resource.RLIMIT_AS, (own + size, own + size))
    cpu = max(1, int(seconds))
    resource.setrlimit(resource.RLIMIT_CPU, (cpu, cpu + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _inspect_in_child(request: dict[str, Any]) -> bytes:
    """Fork, limit, answer; what the child has to say comes through a pipe. A child that says nothing hit a limit."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        try:
            _limit_resources(request["seconds"], request["bytes"])
            with os.fdopen(writing, "wb") as file:
                file.write(json.dumps(_inspect(request)).encode())
        finally:
            os._exit(0)
    os.close(writing)
    answer = _read_to_end(reading, time.monotonic() + 2 * request["seconds"])
    os.close(reading)
    if answer is None:
        os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    try:
        json.loads(answer or b"")
    except ValueError:
        limit = "Reading the files takes more time or memory than allowed, or breaks their reader."
        return json.dumps(_refusal("inspection-limit", limit, None)).encode()
    return answer or b""


def _read_to_end(descriptor: int, deadline: float) -> bytes | None:
    """All that comes until the other end closes; None where it is still open at the deadline."""
    parts: list[bytes] = []
    while (left := deadline - time.monotonic()) > 0:
        if select.select([descriptor], [], [], left)[0]:
            part = os.read(descriptor, 1 << 16)
            if not part:
                return b"".join(parts)
            parts.append(part)
    return None


def main() -> None:
    """Answer requests until stdin closes."""
    torch.set_num_threads(1)  # a forked child of a process with threads could wait for them for ever
    from worker.processes import die_with_parent

    die_with_parent()
    for line in sys.stdin.buffer:
        sys.stdout.buffer.write(_inspect_in_child(json.loads(line)) + b"\n")
        sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
