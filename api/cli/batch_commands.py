"""Command `batch`: several scenes in several styles, on this machine or by a service, with a contact sheet."""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from api.cli.client_commands import KeyOption, conclude, follow, open_client
from api.cli.console import FAILURE, JOB_FAILED, Invocation, error_console, print_field, transfer_bar
from api.cli.options import JobArguments, flags, folder_to_write, local_path, path_to_read, with_options
from api.cli.stylize_commands import run_job
from api.client.uploads import camera_files, different_names
from sgsst_core.errors import InvalidInputError, SettingsError, SgsstError, is_out_of_memory
from sgsst_core.files.atomic import file_digest, write_json
from sgsst_core.files.formats import SUFFIXES, scene_path
from sgsst_core.settings import declared
from worker.job import JobSpec, Outputs, check_is_not_input
from worker.options import ESSENTIALS, RunOptions, StylizeOptions
from worker.run import WorkerOptions

if TYPE_CHECKING:
    from torch import Tensor

    from api.client import Client
    from sgsst_core.scene.gaussians import Scene

#: Names of the record of a batch, and of its contact sheet, in the folder of the results.
_RECORD, _SHEET = "batch.json", "batch.jpg"
#: Longer side of the renders in the contact sheet, in pixels.
_SIDE = 480


@dataclass(frozen=True)
class _Entry:
    """Record of a result.

    Attributes:
        inputs: Digest of the files and options that it is made from.
        complete: Whether it has been made.
        job: Job of the service that makes it; empty on this machine.
    """

    inputs: str = ""
    complete: bool = False
    job: str = ""


class _Batch:
    """Results of a batch in a folder, and their record, which is written after each change.

    Attributes:
        failed: Names of results that could not be made.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self.failed = folder, list[str]()
        try:
            entries = json.loads((folder / _RECORD).read_text(encoding="utf-8"))
            self._entries = {name: _Entry(**entry) for name, entry in entries.items()}
        except FileNotFoundError:
            self._entries = {}
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise InvalidInputError(f"{folder / _RECORD}: is no record of a batch. Choose another --out.") from error

    def result(self, name: str) -> Path:
        """Return the path of a result."""
        return self._folder / f"{name}.ply"

    def entry(self, name: str, inputs: str) -> _Entry:
        """Return the record of a result, which is empty if it was made from other inputs or is gone."""
        entry = self._entries.get(name, _Entry())
        if entry.inputs != inputs or (entry.complete and not self.result(name).is_file()):
            return _Entry(inputs)
        return entry

    def record(self, name: str, entry: _Entry) -> None:
        """Record a result."""
        self._folder.mkdir(parents=True, exist_ok=True)
        self._entries[name] = entry
        write_json(self._folder / _RECORD, {name: asdict(each) for name, each in self._entries.items()})

    @contextmanager
    def attempt(self, name: str) -> Iterator[None]:
        """Report an error of a result in the block, so that the others go on."""
        try:
            yield
            return
        except typer.Exit as end:
            if end.exit_code not in (FAILURE, JOB_FAILED):  # interrupted
                raise
        except (SgsstError, OSError, MemoryError, RuntimeError) as error:
            if isinstance(error, RuntimeError) and not is_out_of_memory(error):
                raise
            text = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) and error.filename else error
            error_console.print(f"error: {name}: {text}")
        self.failed.append(name)


@with_options(StylizeOptions)
@with_options(RunOptions, "run", without=("resume",))
def batch(
    context: typer.Context,
    scenes: Annotated[
        list[Path],
        typer.Argument(parser=local_path, metavar="SCENE...", help=f"3DGS scenes: {SUFFIXES}.", show_default=False),
    ],
    style: Annotated[
        list[Path],
        typer.Option(
            parser=local_path,
            metavar="FILE",
            help="Style image; may be repeated. Each one makes results of its own.",
            show_default=False,
            rich_help_panel=ESSENTIALS,
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            help="Folder for the results, which are named after scene and style.",
            callback=folder_to_write,
            rich_help_panel=ESSENTIALS,
        ),
    ],
    cameras: Annotated[
        Path | None,
        path_to_read("Cameras of all scenes. [default: those beside each scene]", rich_help_panel=ESSENTIALS),
    ] = None,
    url: Annotated[
        str | None, typer.Option("--url", help="URL of a service that makes the results. [default: this machine]")
    ] = None,
    key: KeyOption = None,
    *,
    options: StylizeOptions,
    run: RunOptions,
) -> None:
    """Stylize several scenes in each of several styles; what is done already is not repeated.

    With --url, a service makes the results. Exit with 1 if any could not be made.
    """
    if url is None and key is not None:
        raise SettingsError("--key requires --url. Add it, or omit --key.")
    if url is not None and run.model_fields_set:
        option = flags(declared(RunOptions)[min(run.model_fields_set)])
        raise SettingsError(f"{option}: is for results that this machine makes. Omit it, or --url.")
    results = _Batch(out)
    jobs = {}
    pairs = list(product(zip(_names(scenes), scenes, strict=True), zip(_names(style), style, strict=True)))
    names = different_names([Path(f"{scene_name}_{style_name}") for (scene_name, _), (style_name, _) in pairs])
    for name, ((_, scene), (_, image)) in zip(names, pairs, strict=True):
        inputs = JobArguments(str(scene), [str(image)], str(cameras) if cameras else None)
        jobs[name] = inputs.request(options, results.result(name))
        for each in scenes:
            check_is_not_input(results.result(name), scene_path(each), "scene of another result")
    invocation: Invocation = context.obj
    if url is not None:
        _make_by_service(results, jobs, options, url, key)
    else:
        for name, request in jobs.items():
            with results.attempt(name):
                _make(results, name, request, options, run, invocation)
    if any(request.out.is_file() for request in jobs.values()):
        _write_sheet(out / _SHEET, jobs, len(style))
        print_field("contact sheet", out / _SHEET)
    if results.failed:
        error_console.print(
            f"{len(results.failed)} of {len(jobs)} results could not be made: {', '.join(results.failed)}"
        )
        raise typer.Exit(FAILURE)


def _names(paths: Sequence[Path]) -> list[str]:
    """Return the parts that files have in the names of results."""
    plain = [scene_path(path).parent if scene_path(path) != path else path.with_suffix("") for path in paths]
    return different_names(plain)


def _make(
    results: _Batch, name: str, request: JobSpec, options: StylizeOptions, run: RunOptions, invocation: Invocation
) -> None:
    """Make a result on this machine, from its checkpoint if there is one."""
    entry = results.entry(name, _inputs(request))
    print_field("complete" if entry.complete else "result", request.out)
    if entry.complete:
        return
    resume = Outputs.of(request.out).checkpoint.exists()
    worker_options = WorkerOptions(run.rank_timeout, run.checkpoint_seconds, resume_required=False)
    command = shlex.join(["sgsst", *invocation.arguments])
    run_job(request.model_copy(update={"resume": resume}), command, options.workers, worker_options)
    results.record(name, replace(entry, complete=True))


def _make_by_service(
    results: _Batch, jobs: dict[str, JobSpec], options: StylizeOptions, url: str, key: str | None
) -> None:
    """Submit all results that are not complete, then wait for each and download it."""
    waiting: dict[str, _Entry] = {}
    with open_client(url, key) as client:
        for name, request in jobs.items():
            with results.attempt(name):
                entry = results.entry(name, _inputs(request))
                if not entry.complete:
                    waiting[name] = entry = replace(entry, job=_submitted(client, entry.job, name, request, options))
                    results.record(name, entry)
                print_field("complete" if entry.complete else "job", entry.job or request.out)
        for name, entry in waiting.items():
            with results.attempt(name):
                conclude(client, follow(client, entry.job, False), results.result(name), False)
                results.record(name, replace(entry, complete=True))


def _submitted(client: Client, job_id: str, name: str, request: JobSpec, options: StylizeOptions) -> str:
    """Return the id of the job that makes a result: that of an earlier run if it can still succeed, or a new one."""
    try:
        if job_id and client.job(job_id).status not in ("failed", "canceled"):
            return job_id
    except SgsstError as error:  # deleted
        if getattr(error, "status", 0) != 404:
            raise
    source, images = request.source, [image.path for image in request.styles]
    parameters = options.model_dump(mode="json", exclude_unset=True)
    with transfer_bar(error_console, name) as progress:
        return client.submit(source.scene, images, cameras=source.cameras, progress=progress, **parameters).id


def _inputs(request: JobSpec) -> str:
    """Return the digest of everything that a result is made from: the contents of its files, and its options."""
    source, scene = request.source, scene_path(request.source.scene)
    digests = [file_digest(path) for path in (scene, *(image.path for image in request.styles))]
    names = ("*.webp", "meta.json") if scene.suffix == ".json" else ()  # of an unpacked scene
    files = [path for name in names for path in sorted(scene.parent.rglob(name))]
    files += camera_files(source.cameras) if source.cameras else []
    paths: Any = {"source": {"scene", "cameras"}, "styles": True, "out": True, "resume": True}
    values = [request.model_dump(mode="json", exclude=paths), digests, [file_digest(path) for path in files]]
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _write_sheet(path: Path, jobs: dict[str, JobSpec], styles: int) -> None:
    """Write the contact sheet: a row for each scene with a result, a column for scenes and one for each style."""
    from sgsst_core.report.images import write_grid

    requests = list(jobs.items())
    header = [None, *(_style(request) for _, request in requests[:styles])]
    rows = [requests[start : start + styles] for start in range(0, len(requests), styles)]
    write_grid(path, [header, *(_renders(row) for row in rows if any(each.out.is_file() for _, each in row))])


def _style(request: JobSpec) -> tuple[str, Tensor] | None:
    """Return the style image of a result with its name; None if it cannot be read."""
    from sgsst_core.files.images import load_image

    try:
        return request.styles[0].path.stem, load_image(request.styles[0].path)
    except InvalidInputError:
        return None


def _renders(requests: Sequence[tuple[str, JobSpec]]) -> list[tuple[str, Tensor] | None]:
    """Return a render of a scene and of each of its results, with their names; None for those that are missing."""
    from sgsst_core.files.scene_file import read_scene
    from sgsst_core.report.images import small_renders
    from worker.inputs import read_capture

    source = requests[0][1].source.model_copy(update={"resolution": None})
    scene = read_scene(source.scene, drop_invalid=source.drop_invalid, spz_axes=source.spz_axes).scene
    cameras = read_capture(source, scene).cameras[:1]

    def render(name: str, shown: Scene) -> tuple[str, Tensor]:
        return name, next(small_renders(shown, cameras, _SIDE))

    files = [(name, request.out) for name, request in requests]
    return [
        render(source.scene.stem, scene),
        *(render(name, read_scene(out).scene) if out.is_file() else None for name, out in files),
    ]
