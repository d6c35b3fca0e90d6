"""Client commands: `submit`, `status`, `watch`, `download` and others. They do not import PyTorch."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from rich.table import Table

from api.cli.options import with_options
from api.cli.progress_bars import clock
from api.cli.region_options import RegionKeepOption, RegionOption, RegionStyleOption, RegionWeightOption
from api.client.inputs import different_names
from service.parameters import JobParameters
from sgsst_core.files.formats import (
    EXTRA_FORMATS,
    RESULT_SUFFIXES,
    SUFFIXES,
    ExtraName,
    by_name,
    format_of_name,
    result_name,
)
from worker.region_requests import RegionOptions, region_options, region_requests
from worker.styles import parse_styles

if TYPE_CHECKING:
    from stamina.instrumentation import RetryDetails

    from api.client import Client
    from api.client.answers import Job

out_console = Console(highlight=False, markup=False, soft_wrap=True)
error_console = Console(stderr=True, highlight=False, markup=False, soft_wrap=True)

#: Exit code of a command whose job has failed or was canceled.
_JOB_FAILED = 1

UrlOption = Annotated[
    str | None, typer.Option("--url", help="URL of the service. [default: SGSST_URL, else http://127.0.0.1:8000]")
]
KeyOption = Annotated[str | None, typer.Option("--key", help="API key. [default: SGSST_KEY]")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]
JobArgument = Annotated[str, typer.Argument(metavar="JOB", help="ID of a job.", show_default=False)]


def add_to(app: typer.Typer) -> None:
    """Add all commands of this module to the app."""
    for command in (submit, status, watch, download, cancel, retry, delete, jobs):
        app.command()(command)


@with_options(JobParameters)
def submit(
    scene: Annotated[
        Path,
        typer.Argument(metavar="SCENE", help=f"3DGS scene: {SUFFIXES}.", show_default=False),
    ],
    style: Annotated[
        list[str],
        typer.Option(
            metavar="FILE[:WEIGHT]",
            help="Style image; may be repeated. Several are mixed in proportion to their weights.",
            show_default=False,
        ),
    ],
    cameras: Annotated[
        Path | None,
        typer.Option(
            help="cameras.json (INRIA), folder of a COLMAP sparse model, or transforms.json (nerfstudio, Blender)."
        ),
    ] = None,
    images: Annotated[
        Path | None, typer.Option(help="Folder of photos for the content term. [default: unstylized renders]")
    ] = None,
    region: RegionOption = None,
    region_style: RegionStyleOption = None,
    region_weight: RegionWeightOption = None,
    region_freeze: RegionKeepOption = None,
    *,
    options: JobParameters,
    parameters: Annotated[str, typer.Option(metavar="JSON", help="Additional parameters, as in the REST API.")] = "{}",
    webhook: Annotated[str | None, typer.Option(help="URL to notify when the job ends.")] = None,
    out: Annotated[
        Path | None,
        typer.Option(help=f"Wait for the job, and write the scene to this file: {RESULT_SUFFIXES}."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check the inputs and plan the job without queueing it.")
    ] = False,
    as_json: JsonOption = False,
    url: UrlOption = None,
    key: KeyOption = None,
) -> None:
    """Submit a job to a service, with the options of stylize. With --out, wait for the result."""
    told = options.model_dump(mode="json", exclude_unset=True)
    styles = parse_styles(style)
    if len(styles) > 1:
        told["style_weights"] = [file.weight for file in styles]
    regions = region_options(region or (), region_style or (), region_weight or (), region_freeze or ())
    theirs = [file for each in region_requests(regions) for file in each.styles]
    pictures = [file.path for file in (*styles, *theirs)]
    if regions:
        told["regions"] = _regions_to_send(regions, different_names(pictures)[len(styles) :])
    chosen = told | _parse_parameters(parameters)
    with _client(url, key) as client:
        if dry_run:
            with _sending_and_planning() as (progress, planning):
                plan = client.plan(
                    scene, pictures, cameras=cameras, photos=images, progress=progress, planning=planning, **chosen
                )
            out_console.print(json.dumps(plan) if as_json else _plan_text(plan))
            return
        with _transfer("sending") as progress:
            job = client.submit(
                scene, pictures, cameras=cameras, photos=images, webhook=webhook, progress=progress, **chosen
            )
        if out is None:
            out_console.print(json.dumps(job.data) if as_json else job.id)
            if not as_json:
                error_console.print(f"Progress: sgsst watch {job.id}    Result: sgsst download {job.id}")
            return
        if not as_json:
            error_console.print(job.id)
        _conclude(client, _follow(client, job.id, as_json), out, as_json)


def _regions_to_send(regions: Sequence[RegionOptions], names: Sequence[str]) -> list[dict[str, Any]]:
    """Return regions as JSON objects for the API.

    Args:
        names: Names under which the style images of the regions are sent, in the order of `region_requests`.
    """
    told = {each.name: each.model_dump(mode="json", exclude_defaults=True) for each in regions}
    left = iter(names)
    for request in region_requests(regions):
        if request.styles:
            told[request.name]["style"] = [f"{next(left)}:{file.weight!r}" for file in request.styles]
    return list(told.values())


def status(job: JobArgument, as_json: JsonOption = False, url: UrlOption = None, key: KeyOption = None) -> None:
    """Show the status of a job."""
    with _client(url, key) as client:
        found = client.job(job)
    out_console.print(json.dumps(found.data) if as_json else _job_text(found))


def watch(job: JobArgument, as_json: JsonOption = False, url: UrlOption = None, key: KeyOption = None) -> None:
    """Show the progress of a job until it ends; exit with 1 if it does not succeed."""
    with _client(url, key) as client:
        found = _follow(client, job, as_json)
    if not as_json:
        out_console.print(_job_text(found))
    if found.status != "succeeded":
        raise typer.Exit(_JOB_FAILED)


def download(
    job: JobArgument,
    name: Annotated[str, typer.Argument(metavar="[NAME]", help="File to download; 'all' downloads every file.")] = (
        "stylized.ply"
    ),
    out: Annotated[Path | None, typer.Option(help="File to write, or folder for 'all'. [default: NAME]")] = None,
    form: Annotated[
        ExtraName | None,
        typer.Option("--format", help="Compressed format of stylized.ply. [default: from the ending of --out]"),
    ] = None,
    as_json: JsonOption = False,
    url: UrlOption = None,
    key: KeyOption = None,
) -> None:
    """Download a job's result or other files; an interrupted download resumes."""
    with _client(url, key) as client:
        names = [entry["name"] for entry in client.artifacts(job)] if name == "all" else [name]
        written = []
        for each in names:
            target = (out or Path(job)) / each if name == "all" else out or Path(Path(each).name)
            target.parent.mkdir(parents=True, exist_ok=True)
            with _transfer(each) as progress:
                chosen = (form or _packed_form(target)) if each == "stylized.ply" else None
                if form and out is None and each == "stylized.ply":
                    target = Path(result_name(each, by_name(form)))
                written.append(str(client.download(job, target, each, progress, chosen)))
            if not as_json:
                _tell_loss(client, job, chosen)
    out_console.print(json.dumps(written) if as_json else "\n".join(written))


def cancel(job: JobArgument, as_json: JsonOption = False, url: UrlOption = None, key: KeyOption = None) -> None:
    """Cancel a job."""
    with _client(url, key) as client:
        found = client.cancel(job)
    out_console.print(json.dumps(found.data) if as_json else _job_text(found))


def retry(job: JobArgument, as_json: JsonOption = False, url: UrlOption = None, key: KeyOption = None) -> None:
    """Queue a failed or canceled job again."""
    with _client(url, key) as client:
        found = client.retry(job)
    out_console.print(json.dumps(found.data) if as_json else _job_text(found))


def delete(job: JobArgument, url: UrlOption = None, key: KeyOption = None) -> None:
    """Delete a finished job and its results."""
    with _client(url, key) as client:
        client.delete(job)


def jobs(
    status: Annotated[list[str] | None, typer.Option(help="Show only jobs with this status; may be repeated.")] = None,
    limit: Annotated[int, typer.Option(min=1, help="Maximum number of jobs.")] = 20,
    as_json: JsonOption = False,
    url: UrlOption = None,
    key: KeyOption = None,
) -> None:
    """List jobs, newest first."""
    with _client(url, key) as client:
        found = list(client.jobs(status=status or (), limit=limit))
    if as_json:
        out_console.print(json.dumps([job.data for job in found]))
        return
    table = Table("id", "name", "status", "progress", "created")
    for job in found:
        created = datetime.fromisoformat(job.data["created_at"]).astimezone()
        table.add_row(job.id, job.data["name"], job.status, _progress_text(job), f"{created:%Y-%m-%d %H:%M}")
    Console(width=None if out_console.is_terminal else 140, highlight=False, markup=False).print(table)


# --- shared --------------------------------------------------------------------------------------------------------


def _client(url: str | None, key: str | None) -> Client:
    import stamina.instrumentation

    from api.client import Client

    stamina.instrumentation.set_on_retry_hooks([_tell_of_retry])
    return Client(url, key)


def _tell_of_retry(details: RetryDetails) -> None:
    what = str(details.caused_by) or type(details.caused_by).__name__
    error_console.print(f"{what}: retrying in {details.wait_for:.0f} s")


def _parse_parameters(text: str) -> dict[str, Any]:
    try:
        values = json.loads(text)
    except ValueError as error:
        raise typer.BadParameter(
            f'--parameters is not valid JSON: {error}. Give an object such as {{"steps_sos": 100}}.'
        ) from error
    if not isinstance(values, dict):
        raise typer.BadParameter('--parameters is not a JSON object. Give one such as {"steps_sos": 100}.')
    return values


@contextmanager
def _transfer(what: str) -> Iterator[Any]:
    """Show a progress bar of transferred bytes on a terminal, and nothing elsewhere."""
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with Bar(*columns, console=error_console, transient=True, disable=not error_console.is_terminal) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total or None)


@contextmanager
def _sending_and_planning() -> Iterator[tuple[Any, Any]]:
    """Show a progress bar of the sent bytes, then of the surveyed views; only on a terminal."""
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[text]}"))
    with Bar(*columns, console=error_console, transient=True, disable=not error_console.is_terminal) as bar:
        task = bar.add_task("checking", total=None, text="")

        def sent(done: int, total: int) -> None:
            bar.update(task, description="sending", completed=done, total=total or None, text=f"{done / 1e6:.0f} MB")
            if done == total:
                bar.update(task, description="checking", total=None, text="")

        def planned(done: int, total: int) -> None:
            bar.update(task, description="planning", completed=done, total=total, text=f"view {done} of {total}")

        yield sent, planned


def _follow(client: Client, job_id: str, as_json: bool) -> Job:
    """Show events until the job has ended: as a live bar on a terminal, as lines elsewhere, or as JSON lines."""
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[text]}"))
    live = error_console.is_terminal and not as_json
    with Bar(*columns, console=error_console, transient=True, disable=not live) as bar:
        task = bar.add_task("waiting", total=1.0, text="")
        for event in client.watch(job_id):
            if as_json:
                out_console.print(json.dumps({"id": event.id, "event": event.kind, **event.data}))
            elif event.kind == "status":
                bar.update(task, description=event.data["status"])
                if not live:
                    error_console.print(f"{event.data['status']} (attempt {event.data['attempt']})")
            elif event.kind == "progress":
                text = _step_text(event.data)
                bar.update(task, completed=event.data["fraction"], text=text)
                if not live:
                    error_console.print(text)
    return client.job(job_id)


def _conclude(client: Client, job: Job, out: Path, as_json: bool) -> None:
    if job.status != "succeeded":
        error_console.print(_job_text(job))
        raise typer.Exit(_JOB_FAILED)
    with _transfer(out.name) as progress:
        client.download(job.id, out, progress=progress, form=_packed_form(out))
    if not as_json:
        _tell_loss(client, job.id, _packed_form(out))
    out_console.print(json.dumps({"job": job.id, "result": str(out)}) if as_json else str(out))


def _tell_loss(client: Client, job_id: str, form: ExtraName | None) -> None:
    """Print the quality loss of a compressed result."""
    if form is None:
        return
    with tempfile.TemporaryDirectory() as folder:
        name = f"{result_name('stylized.ply', by_name(form))}.json"
        found = json.loads(client.download(job_id, Path(folder, "loss.json"), name).read_text())
    psnr = "renders identical to" if found["psnr_db"] is None else f"{found['psnr_db']:.1f} dB PSNR against"
    error_console.print(f"{form}, {found['bytes'] / 1e6:.1f} MB, {psnr} the PLY")


def _packed_form(out: Path) -> ExtraName | None:
    """Return the compressed format that the ending of a file name stands for; None for any other name."""
    format = format_of_name(out.name)
    return format.name if format in EXTRA_FORMATS else None


def _step_text(progress: Any) -> str:
    if not progress.get("total"):
        return str(progress["stage"])
    unit = "view" if progress["stage"] == "planning" else "step"
    text = f"{progress['stage']}: {unit} {progress['step']} of {progress['total']}"
    if progress.get("loss") is not None:
        text += f", loss {progress['loss']:.3g}"
    if progress.get("eta_s") is not None:
        text += f", {clock(progress['eta_s'])} left"
    return text


def _progress_text(job: Job) -> str:
    if job.status == "queued" and job.data.get("queue_position"):
        return f"position {job.data['queue_position']} in the queue"
    return _step_text(job.progress) if job.progress and not job.finished else ""


def _job_text(job: Job) -> str:
    lines = [f"{'job:':<12}{job.id}", f"{'name:':<12}{job.data['name']}", f"{'status:':<12}{job.status}"]
    if _progress_text(job):
        lines.append(f"{'progress:':<12}{_progress_text(job)}")
    result = job.data.get("result")
    if result:
        before, after = result["loss_before"], result["loss_after"]
        lines.append(f"{'loss:':<12}{before:.4g} before, {after:.4g} after ({after / before:.1%})")
    if job.error:
        lines.append(f"{'error:':<12}{job.error['message']}")
    return "\n".join(lines)


def _plan_text(plan: Any) -> str:
    lines = [f"{plan['gaussians']:,} Gaussians, {plan['views']} views, {plan['pixels']:,} pixels"]
    lines += [f"{item['item']}: {item['decision']}: {item['reason']}" for item in plan["plan"]["decisions"]]
    if plan["estimated_seconds"]:
        lines.append(f"predicted: {clock(plan['estimated_seconds'])} for all steps")
    return "\n".join(lines)
