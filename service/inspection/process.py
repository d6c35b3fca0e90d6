"""Process that reads users' files, and makes files from results: `python -m service.inspection.process`.

The process imports slow modules once. For each request it forks a child with limits on time and memory, which reads the
files and exits. The child is confined (`service.inspection.sandbox`): a hostile file that takes over the child can
falsify the response to its own request and the one file that the request lets it write, and nothing else. Requests and
responses are lines of JSON on stdin and stdout, one request at a time. The final response of work that takes long is
preceded by lines of progress, `{"planning": ...}`.
"""

import contextlib
import json
import math
import os
import re
import resource
import select
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, NoReturn

import psutil
import torch
from scipy import ndimage, spatial  # noqa: F401  # before the first fork, for orbits

from service import problems
from service.inputs import RESULT, ROLES, JobParameters, Staged, WorkRequest, job_spec
from service.inspection.sandbox import confine, installation
from service.states import install_command
from sgsst_core.budget import default_memory_limit
from sgsst_core.compiled import cache_in_memory, kernel_folders, load_registries
from sgsst_core.devices import seconds_left
from sgsst_core.errors import InvalidInputError, SceneError, SettingsError, SgsstError, WeightsError
from sgsst_core.features.network_weights import list_network_weights
from sgsst_core.features.weight_files import cache_folder
from sgsst_core.files.images import image_size
from sgsst_core.files.scene_file import SceneFile, read_scene, write_scene
from sgsst_core.orbit import find_upright_subject
from sgsst_core.planning.survey import OTHER_FRAME
from sgsst_core.progress import Progress, warnings_of
from sgsst_core.report.document import plan_json
from sgsst_core.scene import kernels as scene_kernels  # noqa: F401  # see `_confine`
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.style import STARRY_NIGHT
from sgsst_core.stylizing.checkpoint import versions
from sgsst_core.stylizing.job import estimate
from worker.derived import VideoRequest, blend, convert, render_video, write_page, write_poster
from worker.execute import dry_run
from worker.inputs import Inputs, choose_axes, cropped, errors_of, orbit_request, read_inputs, read_job_capture
from worker.job import SceneRequest, check_steps
from worker.options import JobVideo, Viewpoint, Viewpoints
from worker.painting import PaintInputs, read_paintings
from worker.processes import die_with_parent, process_start

with contextlib.suppress(ImportError):
    import av  # noqa: F401  # before the first fork, so that every child has it

load_registries()  # before the first fork too
#: Seconds from the start of this process to its first request, nearly all of them for imports.
_START_SECONDS = time.time() - process_start()
#: Maximum size of a response in bytes.
MAX_ANSWER = 64 << 20
#: Maximum number of progress messages of one child that are passed on. The calling process keeps them until its client
#: has read them.
MAX_REPORTS = 10_000
#: Fields of a progress message; all but the first are numbers.
_PROGRESS = {"stage", "step", "total", "fraction", "eta_s"}
#: Address space that each thread reserves but hardly uses: its stack, and an arena of the C library.
_THREAD_BYTES = 1 << 28
#: Remaining weight (1 minus the sum of weights) up to which it counts as zero, because floats are rounded.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class _Limits:
    """Limits of the service, as `worker.inputs.InputLimits`.

    Attributes:
        gaussians, views, pixels: Maximum numbers of Gaussians, of views, and of pixels of all views.
    """

    gaussians: int
    views: int
    pixels: int
    image_pixels: int

    def check_count(self, count: int, growth: float) -> None:
        """Check the number of Gaussians of a scene and its refinement."""
        count = int(count * growth)
        if count > self.gaussians:
            note = f" once it is refined to at most {growth:g} times as many" if growth > 1 else ""
            raise problems.TOO_MANY_GAUSSIANS(count=count, note=note, limit=self.gaussians, input="scene")

    def check_cameras(self, cameras: Sequence[Camera]) -> None:
        """Check the number of views and their pixels."""
        if len(cameras) > self.views:
            raise problems.TOO_MANY_VIEWS(count=len(cameras), limit=self.views, input="cameras")
        if (pixels := _pixels(cameras)) > self.pixels:
            raise problems.TOO_MANY_PIXELS(count=pixels, limit=self.pixels, input="cameras")

    def check_image(self, path: Path) -> None:
        """Check the number of pixels of an image."""
        width, height = image_size(path)
        if width * height > self.image_pixels:
            raise problems.IMAGE_TOO_LARGE(name=path.name, width=width, height=height, limit=self.image_pixels)


#: Callback for responses of a child before the final one.
_Send = Callable[[dict[str, Any]], None]


def _read(request: WorkRequest) -> Inputs | PaintInputs:
    """Read every input of a job as the job would, without rendering more than that needs."""
    if request.staged.painted:
        return read_paintings(job_spec(request.staged, request.parameters), _Limits(**request.limits))
    check_steps(request.parameters.settings())
    installed = [entry.name for entry in list_network_weights() if entry.path]
    wanted = [name for name in ("vgg19", "vgg16") if request.parameters.backbone in ("auto", name)]
    if not any(name in installed for name in wanted):
        raise WeightsError(f"The service has no weights of {' or '.join(wanted)}: its operator has to fetch them.")
    with errors_of("style"):
        spec = job_spec(request.staged, request.parameters)
    return read_inputs(spec, limits=_Limits(**request.limits))


def _findings(inputs: Inputs | PaintInputs) -> dict[str, Any]:
    """Return `gaussians`, `dropped`, `sh_degree`, `style` (width, height), `photos`, `views`, and `pixels` of these.

    `up` is that of an orbit, in the format of the API; None with cameras. `foreign` says that cameras hardly show the
    scene; None if they do. Both are None for painted views, which are those of `views`; they have no style.
    """
    scene = inputs.scene_file.scene
    of_scene = {"gaussians": len(scene), "dropped": inputs.scene_file.dropped, "sh_degree": scene.sh_degree}
    of_scene |= {"views": len(inputs.cameras), "pixels": _pixels(inputs.cameras)}
    if isinstance(inputs, PaintInputs):
        return {**of_scene, "style": [], "photos": 0, "up": None, "foreign": None}
    image, up = inputs.style.images[0], inputs.orbit and inputs.orbit.up
    foreign = [f"{each.decision}; {each.reason}" for each in inputs.decisions if each.decision.startswith(OTHER_FRAME)]
    return {
        **of_scene,
        "style": [image.shape[1], image.shape[0]],
        "photos": len(inputs.photos or []),
        "up": up and {"direction": up.name, "sure": up.sure, "candidates": up.candidates, "reason": up.reason},
        "foreign": foreign[0].removeprefix("warning: ") if foreign else None,
    }


def _pixels(cameras: Sequence[Camera]) -> int:
    """Return the number of pixels of all views."""
    return sum(camera.width * camera.height for camera in cameras)


def _plan(request: WorkRequest, send: _Send) -> dict[str, Any]:
    """Return the findings about a job's inputs and the plan of `sgsst plan`; write the plan for the job."""
    started = time.perf_counter()
    inputs, settings = _read(request), request.parameters.settings()
    findings, spec = _findings(inputs), job_spec(request.staged, request.parameters)
    if isinstance(inputs, PaintInputs):
        return {
            **findings,
            "plan": inputs.plan,
            "estimated_seconds": inputs.seconds,
            "total_seconds": _START_SECONDS + time.perf_counter() - started + inputs.seconds,
            "warnings": warnings_of(inputs.decisions),
            "memory_bytes": inputs.peak_bytes,
        }
    to_write = request.output and request.output_file
    left = seconds_left(settings.within, time.time() - _START_SECONDS - (time.perf_counter() - started))
    job = dry_run(spec, inputs, lambda now: _show(now, send), to_write, left)
    if chosen := job.plan.time_choice:
        inputs = inputs.chosen(chosen, chosen.applied(settings))
    # The job starts a process with the same modules as this one, then reads and plans as was done here.
    expected, before = estimate(job), _START_SECONDS + time.perf_counter() - started
    return {
        **findings,
        "views": len(inputs.cameras),
        "pixels": _pixels(inputs.cameras),
        "plan": plan_json(job),
        "estimated_seconds": expected.job - expected.measuring,
        "total_seconds": before + expected.job + expected.ending,
        "warnings": warnings_of(job.plan.decisions),
        "memory_bytes": job.plan.peak_bytes,
        "device_memory_bytes": job.plan.device_bytes,
    }


def _show(now: Progress, send: _Send) -> None:
    send({"planning": now.model_dump(include=_PROGRESS)})


def _compress(request: WorkRequest, _send: _Send) -> dict[str, Any]:
    """Compress a result, and return the loss of quality."""
    settings, photos = request.parameters.settings(), request.staged.photos
    result = request.source.model_copy(update={"scene": Path(RESULT)})
    converted = convert(result, request.output_file, compare=True, images=photos, settings=settings, in_place=True)
    assert converted.loss is not None
    return converted.loss.as_dict()


def _blend(request: WorkRequest, _send: _Send) -> dict[str, Any]:
    """Blend results, the job's own first, with the job's scene, which has the remaining weight up to 1."""
    parts = [(SceneRequest(scene=Path(path)), weight) for path, weight in request.options["parts"].items()]
    rest = 1 - math.fsum(weight for _, weight in parts)
    if abs(rest) > _ROUNDING:
        axes, _ = choose_axes(request.source, request.staged.photos)
        parts.append((request.source.model_copy(update={"spz_axes": axes}), rest))
    blend(parts, request.output_file, in_place=True)
    return {}


def _read_both(request: WorkRequest) -> tuple[SceneFile, SceneFile]:
    """Read a job's scene and its result, to be drawn in the same mode."""
    source = request.source
    axes, _ = choose_axes(source, request.staged.photos)
    original = read_scene(source.scene, drop_invalid=source.drop_invalid, spz_axes=axes)
    stylized = read_scene(Path(RESULT))
    return original.rendered(source.render_mode, source.eps2d), stylized.rendered(source.render_mode, source.eps2d)


def _page(request: WorkRequest, _send: _Send) -> dict[str, Any]:
    """Write a result as an HTML page, beside the job's scene if that has the same Gaussians and harmonics."""
    source, options = request.source, request.options
    original, stylized = _read_both(request)
    job = job_spec(request.staged, request.parameters)
    cameras, upright = [], None
    if source.cameras is None:
        remaining = cropped(job.regions, original, source.near)
        upright = find_upright_subject(original.scene, orbit_request(source).up, remaining)[1].direction.tolist()
    else:
        cameras = read_job_capture(job, original).cameras
    write = partial(
        write_page,
        request.output_file,
        options["viewer"],
        stylized,
        background=job.settings.background,
        up=upright,
        cameras=cameras,
        viewpoints=Viewpoints(**options.get("viewpoints", {})),
        in_place=True,
    )
    try:
        write(original, options["title"])
    except SceneError:  # Gaussians were split, for example
        write(None, options["title"])
    return {}


def _poster(request: WorkRequest, _send: _Send) -> dict[str, Any]:
    """Write an image of a result at a viewpoint, beside the job's scene."""
    original, stylized = (file.scene for file in _read_both(request))
    viewpoint, background = Viewpoint(**request.options["viewpoint"]), request.parameters.settings().background
    near = request.source.near
    write_poster(request.output_file, original, stylized, viewpoint, background=background, near=near)
    return {}


def _video(request: WorkRequest, send: _Send) -> dict[str, Any]:
    """Render a video of a result, and return the width, the height and the number of its frames."""
    try:
        import av  # noqa: F401
    except ImportError as error:
        command = install_command("video")
        raise SettingsError(f"The service cannot encode videos: its operator has to run `{command}`.") from error
    options = JobVideo(**request.options["video"])
    parameters = request.parameters.model_copy(update={"resolution": options.resolution})
    job = job_spec(request.staged, parameters)
    source = job.source.model_copy(update={"scene": Path(RESULT)})
    started = time.monotonic()

    def progress(done: int, total: int) -> None:
        left = (time.monotonic() - started) / done * (total - done)
        _show(Progress(stage="video", step=done, total=total, eta_s=left), send)

    compared, background = job.source.scene if options.compare else None, job.settings.background
    wanted = VideoRequest(source, request.output_file, options, background, compared, job=job)
    cameras = render_video(wanted, progress, in_place=True)
    return {"width": cameras[0].width, "height": cameras[0].height, "frames": len(cameras)}


#: Function of each kind of work, and its title for messages.
WORK: dict[str, tuple[Callable[[WorkRequest, _Send], dict[str, Any]], str]] = {
    "validate": (lambda request, send: _findings(_read(request)), "Reading the files"),
    "plan": (_plan, "Planning the job"),
    "compress": (_compress, "Compressing the result"),
    "blend": (_blend, "Blending the results"),
    "page": (_page, "Writing the page"),
    "poster": (_poster, "Rendering the viewpoint"),
    "video": (_video, "Rendering the video"),
}


# --- one request in a child ----------------------------------------------------------------------------------------


def _inspect(request: WorkRequest, send: _Send) -> dict[str, Any]:
    """Return the final response of a child: `{"findings": ...}` or `{"error": {"code", "message", "input"}}`."""
    try:
        os.chdir(request.folder)
        return {"findings": WORK[request.work][0](request, send)}
    except MemoryError as error:
        return _over_limit("Reading it takes more memory than allowed.", getattr(error, "role", None))
    except SgsstError as error:
        return _refusal(error.code, str(error), getattr(error, "role", None))
    except Exception as error:  # a crash of a reader is attributed to the file
        if "memory" in str(error).lower():
            return _over_limit("Reading it takes more memory than allowed.")
        refusal = _refusal(InvalidInputError.code, "The files cannot be read.", getattr(error, "role", None))
        return {**refusal, "log": f"{type(error).__name__}: {error}"}


def _refusal(code: str, message: str, role: str | None) -> dict[str, Any]:
    plain = re.sub(rf"(?<!\S)(?:{'|'.join(ROLES)})/", "", message)  # users did not give the folders of the staging area
    return {"error": {"code": code, "message": plain, "input": role}}


def _over_limit(message: str, role: str | None = None) -> dict[str, Any]:
    return _refusal(problems.INSPECTION_LIMIT.code, message, role)


def _limit_resources(seconds: float, size: int) -> None:
    """Limit this child's CPU time and memory."""
    used = psutil.Process().memory_info().vms
    resource.setrlimit(resource.RLIMIT_AS, (used + size, used + size))
    cpu = max(1, int(seconds))
    resource.setrlimit(resource.RLIMIT_CPU, (cpu, cpu + 1))


def _inspect_in_child(request: WorkRequest) -> Iterator[bytes]:
    """Fork a confined child and yield the lines that it sends through a pipe.

    A child that ends without a response has exceeded one of three limits: the CPU time of all its threads, its memory,
    or its wall-clock time (twice the requested `seconds`).
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        _run_child(request, writing)
    os.close(writing)
    answer, until = None, time.monotonic() + 2 * request.seconds
    try:
        for number, line in enumerate(_lines(reading, until)):
            if "planning" not in line:
                answer = line
                break
            if number < MAX_REPORTS:
                yield json.dumps(line).encode()
    finally:
        os.close(reading)
        os.kill(child, signal.SIGKILL)  # an exited child stays a zombie until waitpid, so its id is still valid
        _, status = os.waitpid(child, 0)
    # the child is dead, so it can no longer change the files that the response refers to
    if answer is None:
        answer = {**_over_limit(_limit_text(request)), "log": f"wait status {status}, no answer"}
    if answer.pop("compiled", False):
        _compile_kernels()
    if "log" in answer:
        print(f"inspection: {str(answer.pop('log'))[:500]!r}", file=sys.stderr, flush=True)
    yield json.dumps(answer).encode()


def _run_child(request: WorkRequest, writing: int) -> NoReturn:
    """Process a request in the forked child and exit, without running cleanup code of the parent."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        die_with_parent()  # the setting is not inherited across a fork
        _close_descriptors(writing)
        if request.threads > 1:  # the parent has no other threads, which a fork would not copy
            torch.set_num_threads(request.threads)
        with contextlib.suppress(OSError):  # if the machine runs out of memory, the kernel kills this rather than a job
            Path("/proc/self/oom_score_adj").write_text("500")
        # RLIMIT_CPU counts all threads, even those that spin
        _limit_resources(request.seconds * request.threads, request.memory + _memory_besides_reading(request))
        with os.fdopen(writing, "w") as file:

            def send(response: dict[str, Any]) -> None:
                print(json.dumps(response), file=file, flush=True)

            try:
                uncompiled = _confine(request)
            except OSError as error:
                refusal = _over_limit("The files cannot be checked at the moment.")
                send({**refusal, "log": f"cannot be confined: {error}"})
            else:
                send({**_inspect(request, send), "compiled": bool(uncompiled)})
    finally:
        os._exit(0)


def _close_descriptors(retained: int = 2) -> None:
    """Close all file descriptors except `retained`; others lead to responses to other requests and to the log."""
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in range(3):
        os.dup2(null, descriptor)
    os.closerange(3, retained)
    os.closerange(max(3, retained + 1), resource.getrlimit(resource.RLIMIT_NOFILE)[0])


def _confine(request: WorkRequest) -> list[None]:
    """Restrict this child to reading its job's files and the installation, and to writing the derived file.

    Numba looks for a writable cache folder when a module with kernels is imported. This process therefore imports all
    such modules before it forks; a confined child that imported one would compile its kernels for each request.

    Returns:
        List to which an entry is appended for each kernel that has to be compiled.
    """
    folder = request.folder
    links = [*folder.rglob("*"), *cache_folder().glob("*.safetensors")]
    linked = [path.resolve() for path in links if path.is_symlink()]
    versions()  # is cached: the files that it reads may not be among those of the installation
    output, most_bytes = None, 0
    if request.output:
        name, most_bytes = request.output
        output = folder / name
        output.touch()
    uncompiled: list[None] = []
    cache_in_memory(lambda: uncompiled.append(None))
    confine([folder, *linked, cache_folder(), *kernel_folders(), *installation()], output, most_bytes)
    return uncompiled


@cache
def _compile_kernels() -> None:
    """Compile kernels for later children, by planning a small built-in scene in an unconfined child.

    Confined children cannot store compiled kernels on disk. This runs at most once per process, because an untrusted
    child requests it. Nothing waits for the new child, and it dies with this process.
    """
    if os.fork():
        return
    try:
        die_with_parent()
        _close_descriptors()
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            scene = Path("scene.ply")
            shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh_dc": (3,), "sh_rest": (15, 3)}
            write_scene(scene, Scene(*(torch.rand(64, *shape) for shape in shapes.values())))
            request = WorkRequest(
                work="plan",
                folder=Path(folder),
                staged=Staged(scene=scene, styles=(STARRY_NIGHT,), cameras=None, photos=None),
                parameters=JobParameters(orbit="3", resolution=96),
                seconds=0,
                memory=0,
                limits=dict.fromkeys(("gaussians", "views", "pixels", "image_pixels"), 1 << 40),
            )
            _plan(request, lambda response: None)
    finally:
        os._exit(0)


def _memory_besides_reading(request: WorkRequest) -> int:
    """Return the memory limit in bytes for everything but reading: threads, and rendering or writing."""
    threads: int = request.threads * _THREAD_BYTES
    if request.work == "validate" and not request.parameters.renders_views:
        return threads
    default = default_memory_limit()
    return threads + min(request.parameters.settings().memory_limit or default, default)


def _limit_text(request: WorkRequest) -> str:
    what = WORK[request.work][1]
    text = f"{what} takes more time ({request.seconds:.0f} s of a processor) or memory "
    text += f"({request.memory / 1e9:.1f} GB) than allowed for files of this size, or crashes their reader."
    return text if request.work != "plan" else f"{text} Ask for fewer views, or submit it without a dry run."


def _lines(descriptor: int, until: float) -> Iterator[dict[str, Any]]:
    """Yield messages until the child closes the pipe or sends an invalid message, or the deadline passes."""
    incomplete = b""
    while (left := until - time.monotonic()) > 0 and len(incomplete) < MAX_ANSWER:
        if not select.select([descriptor], [], [], left)[0]:
            continue
        data = os.read(descriptor, 1 << 16)
        if not data:
            return
        *lines, incomplete = (incomplete + data).split(b"\n")
        for line in lines:
            try:
                answer = json.loads(line)
            except (ValueError, RecursionError):
                return
            if not _is_response(answer):
                return
            yield answer


def _is_response(answer: Any) -> bool:
    """Return whether the message of an untrusted child has the format that the calling process accepts."""
    if not isinstance(answer, dict) or not answer.keys() & {"planning", "findings", "error"}:
        return False
    planning = answer.get("planning", {})
    if not isinstance(planning, dict) or (planning and planning.keys() != set(_PROGRESS)):
        return False
    if not isinstance(planning.get("stage", ""), str):
        return False
    if not all(value is None or isinstance(value, int | float) for key, value in planning.items() if key != "stage"):
        return False
    error = answer.get("error", {"code": "", "message": "", "input": None})
    if not isinstance(error, dict) or error.keys() != {"code", "message", "input"}:
        return False
    texts = [error["code"], error["message"], error["input"] or ""]
    return isinstance(answer.get("findings", {}), dict) and all(isinstance(text, str) for text in texts)


def main() -> None:
    """Process requests until stdin is closed."""
    torch.set_num_threads(1)  # a child forked from a process with threads could wait for them forever
    die_with_parent()
    for line in sys.stdin.buffer:
        for response in _inspect_in_child(WorkRequest.model_validate_json(line)):
            sys.stdout.buffer.write(response + b"\n")
            sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
