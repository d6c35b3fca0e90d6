"""Client commands: `submit`, `status`, `watch`, `download` and others. They do not import PyTorch."""

import json
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path, PureWindowsPath
from typing import Annotated, Any, get_args

import typer
from rich.progress import BarColumn, TextColumn
from rich.table import Column, Table
from stamina.instrumentation import RetryDetails, set_on_retry_hooks

from api.cli import INTERRUPTED, console
from api.cli.options import (
    JsonOption,
    KeyOption,
    SubmittedArguments,
    cameras_of,
    file_to_write,
    with_arguments,
    with_options,
)
from api.client.client import Client, different_names
from api.client.transport import Job
from service.inputs import JobParameters
from service.states import ACTIONS, STEPPING, Transition, WebhookEvent
from sgsst_core.errors import OutputError, SettingsError
from sgsst_core.files.atomic import file_digest
from sgsst_core.files.formats import DOWNLOAD_SUFFIXES, download_of_name, listed, result_name
from sgsst_core.progress import Progress, duration, live_bar
from worker.job import check_file, check_folder, check_is_not_input
from worker.options import ESSENTIALS, RegionOptions, parse_styles, path_or_url, region_requests, split_weight

UrlOption = Annotated[
    str | None, typer.Option("--url", help="URL of the service. [default: SGSST_URL, else http://127.0.0.1:8000]")
]
JobArgument = Annotated[str, typer.Argument(metavar="JOB", help="ID of a job.", show_default=False)]


def _webhook_event(text: str) -> str:
    if text not in get_args(WebhookEvent):
        raise SettingsError(f"--webhook-events {text}: is not {listed(get_args(WebhookEvent))}. Give one of them.")
    return text


@with_options(JobParameters)
@with_arguments(SubmittedArguments)
def submit(
    inputs: SubmittedArguments,
    *,
    options: JobParameters,
    webhook: Annotated[str | None, typer.Option(help="URL to notify when the job ends.")] = None,
    webhook_events: Annotated[
        list[str] | None,
        typer.Option(
            parser=_webhook_event,
            metavar="EVENT",
            help=f"Event to notify it of: {listed(get_args(WebhookEvent))}; may be repeated. [default: completed]",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help=f"Wait for the job, and write the scene to this file: {DOWNLOAD_SUFFIXES}.",
            callback=file_to_write,
            rich_help_panel=ESSENTIALS,
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check the inputs and plan the job without queueing it.")
    ] = False,
    as_json: JsonOption = False,
    url: UrlOption = None,
    key: KeyOption = None,
) -> None:
    """Submit a job to a service, with the options of stylize. With --out, wait for the result.

    With --view in place of --style, the scene follows painted views. SCENE, --style and --cameras may be URLs, if the
    service allows their hosts, or files of earlier jobs, such as /v1/jobs/JOB/artifacts/stylized.ply.
    """
    if out is not None:
        download_of_name(out.name)
        check_is_not_input(out, Path(inputs.scene))
    if webhook_events and not webhook:
        raise SettingsError("--webhook-events requires --webhook. Add it, or omit the events.")
    styles, masks, settings = _styles_masks_and_parameters(inputs, options)
    cameras = cameras_of(inputs.scene, inputs.cameras, JobParameters.model_construct(**settings))
    files: dict[str, Any] = {"cameras": cameras, "photos": inputs.images, "masks": masks}
    files["painted"] = {file.path: file.options.model_dump(exclude_none=True) for file in inputs.painted}
    with open_client(url, key) as client:
        if dry_run:
            with console.counting_bar("checking", in_bytes=False) as planning:
                plan = client.plan(inputs.scene, styles, **files, planning=planning, **settings)
            console.out_console.print(json.dumps(plan) if as_json else _plan_text(plan))
            return
        with console.counting_bar("sending") as progress:
            settings |= {"webhook": webhook, "webhook_events": webhook_events or ()}
            job = client.submit(inputs.scene, styles, **files, progress=progress, **settings)
        if out is None:
            console.out_console.print(json.dumps(job.data) if as_json else job.id)
            if not as_json:
                console.error_console.print(f"Progress: sgsst watch {job.id}    Result: sgsst download {job.id}")
            return
        if not as_json:
            console.error_console.print(job.id)
        conclude(client, follow(client, job.id, as_json), out, as_json)


def _styles_masks_and_parameters(
    inputs: SubmittedArguments, options: JobParameters
) -> tuple[list[Path | str], dict[str, Path], dict[str, Any]]:
    """Return the style images to send or their URLs, those of regions last, the masks, and the job's parameters."""
    values = options.model_dump(mode="json", exclude_unset=True)
    styles = () if inputs.painted else parse_styles(inputs.style)
    if len(styles) > 1:
        values["style_weights"] = [file.weight for file in styles]
    images = [path_or_url(split_weight(text)[0]) for text in inputs.style]
    regions = inputs.regions
    of_regions = [file.path for region in region_requests(regions) for file in region.styles]
    masks: dict[str, Path] = {}
    if regions:
        local = [image for image in images if isinstance(image, Path)]
        names = different_names([*local, *of_regions])[len(local) :]
        values["regions"], masks = _regions_to_send(regions, names)
    return [*images, *of_regions], masks, values


def _regions_to_send(
    regions: Sequence[RegionOptions], names: Sequence[str]
) -> tuple[list[dict[str, Any]], dict[str, Path]]:
    """Return regions as JSON objects for the API, and their mask files or folders by the names of these there.

    Args:
        names: Names under which the style images of the regions are sent, in the order of `region_requests`.
    """
    objects = {region.name: region.model_dump(mode="json", exclude_defaults=True) for region in regions}
    unused_names, masks = iter(names), {}
    for number, request in enumerate(region_requests(regions)):
        if request.selection and request.selection.path:
            name = f"region_{number}{request.selection.path.suffix}"  # the suffix determines the format
            objects[request.name]["select"] = f"{request.selection.kind}={name}"
            masks[name] = request.selection.path
        if request.styles:
            objects[request.name]["style"] = [f"{next(unused_names)}:{file.weight!r}" for file in request.styles]
    return list(objects.values()), masks


def status(job: JobArgument, as_json: JsonOption = False, url: UrlOption = None, key: KeyOption = None) -> None:
    """Show the status of a job."""
    with open_client(url, key) as client:
        _print_job(client.job(job), as_json)


def watch(job: JobArgument, as_json: JsonOption = False, url: UrlOption = None, key: KeyOption = None) -> None:
    """Show the progress of a job until it ends; exit with 5 if it does not succeed."""
    with open_client(url, key) as client:
        ended = follow(client, job, as_json)
    if not as_json:
        console.out_console.print(_job_text(ended))
    if ended.status != "succeeded":
        raise typer.Exit(console.JOB_FAILED)


def download(
    job: JobArgument,
    name: Annotated[str, typer.Argument(metavar="[NAME]", help="File to download; 'all' downloads every file.")] = (
        "stylized.ply"
    ),
    out: Annotated[
        Path | None,
        typer.Option(
            help="File to write, whose ending is the format of stylized.ply, or folder for 'all'. [default: NAME]",
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace existing files, which may belong to another job.")
    ] = False,
    as_json: JsonOption = False,
    url: UrlOption = None,
    key: KeyOption = None,
) -> None:
    """Download a job's result or other files; an interrupted download resumes."""
    if name == "all":
        check_folder(out or Path(job))
    elif out is not None:
        check_file(out)
        if name == "stylized.ply":
            download_of_name(out.name)
    with open_client(url, key) as client:
        digests = {entry["name"]: entry["sha256"] for entry in client.artifacts(job)}
        names = list(digests) if name == "all" else [name]
        if name == "all":
            _check_names(names)
        written = []
        for each in names:
            target = (out or Path(job)) / each if name == "all" else out or Path(Path(each).name)
            stored = result_name(each, download_of_name(target.name)) if each == "stylized.ply" else each
            other = target.is_file() and digests.get(stored) != file_digest(target)
            if other and not overwrite and not (name == "all" and out is None):  # that folder is named after the job
                raise OutputError(
                    f"{target}: exists, and is not this job's file. Write to another file with --out, or pass "
                    "--overwrite."
                )
            with console.counting_bar(each) as progress:
                written.append(str(client.download(job, target, each, progress)))
    console.out_console.print(json.dumps(written) if as_json else "\n".join(written))


def _check_names(names: Sequence[str]) -> None:
    """Raise an OutputError if a name from the service leads out of the folder that it is appended to."""
    for name in names:
        path = PureWindowsPath(name)  # accepts the separators of all systems
        if path.anchor or ".." in path.parts:
            raise OutputError(
                f"The service names a file {name!r}, which is outside of the download's folder. Check --url, "
                "or download single files by name."
            )


def _command_of(action: Transition) -> Callable[..., None]:
    """Return the command that requests an action on a job."""

    def command(job: JobArgument, as_json: JsonOption = False, url: UrlOption = None, key: KeyOption = None) -> None:
        with open_client(url, key) as client:
            _print_job(client.act(job, action), as_json)

    command.__name__, command.__doc__ = action.value, ACTIONS[action].help
    return command


def share(
    job: JobArgument,
    days: Annotated[float, typer.Option(help="Lifetime of the link, from a minute (1 / 1440) to 90 days.")] = 7,
    poster: Annotated[
        bool, typer.Option("--poster", help="Let sites where the link is posted show an image of the result.")
    ] = False,
    as_json: JsonOption = False,
    url: UrlOption = None,
    key: KeyOption = None,
) -> None:
    """Create a read-only link to a result, for people without a key."""
    with open_client(url, key) as client:
        link = client.share(job, days, poster=poster)
    console.out_console.print(json.dumps(link) if as_json else link["url"])


def delete(job: JobArgument, url: UrlOption = None, key: KeyOption = None) -> None:
    """Delete a finished job and its results."""
    with open_client(url, key) as client:
        client.delete(job)


def jobs(
    status: Annotated[list[str] | None, typer.Option(help="Show only jobs with this status; may be repeated.")] = None,
    limit: Annotated[int, typer.Option(min=1, help="Maximum number of jobs.")] = 20,
    as_json: JsonOption = False,
    url: UrlOption = None,
    key: KeyOption = None,
) -> None:
    """List jobs, newest first."""
    with open_client(url, key) as client:
        page = list(client.jobs(status=status or (), limit=limit))
    if as_json:
        console.out_console.print(json.dumps([job.data for job in page]))
        return
    fixed = (Column(heading, no_wrap=True) for heading in ("id", "status", "created"))
    table = Table(*fixed, "name", box=None, pad_edge=False)
    for job in page:
        created = datetime.fromisoformat(job.data["created_at"]).astimezone()
        table.add_row(job.id, _short_status(job), f"{created:%m-%d %H:%M}", job.data["name"])
    console.PlainConsole().print(table)


def usage(
    since: Annotated[
        datetime | None,
        typer.Option(metavar="YYYY-MM-DD", help="First day (UTC). [default: 30 days]", formats=["%Y-%m-%d"]),
    ] = None,
    until: Annotated[
        datetime | None, typer.Option(metavar="YYYY-MM-DD", help="Last day. [default: today]", formats=["%Y-%m-%d"])
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(help="Read the database of this data folder, without asking the service of --url and --key."),
    ] = None,
    as_json: JsonOption = False,
    url: UrlOption = None,
    key: KeyOption = None,
) -> None:
    """Show jobs, seconds and bytes by day and key.

    A key shows its own usage, an operator's key or --data that of all keys.
    """
    first, last = (None if day is None else day.date() for day in (since, until))
    if data is None:
        with open_client(url, key) as client:
            rows = client.usage(str(first) if first else None, str(last) if last else None)
    else:
        from api.cli.machine_commands import usage_of_all

        rows = usage_of_all(data, first, last)
    if as_json:
        console.out_console.print(json.dumps(rows))
        return
    numeric = (Column(name, justify="right") for name in ("jobs", "GPU s", "CPU s", "MB"))
    table = Table("day", Column("key", min_width=35), "name", *numeric, box=None, pad_edge=False)
    for row in rows:
        numbers = row["jobs"], row["gpu_seconds"], row["cpu_seconds"], row["bytes"] / 1e6
        table.add_row(row["day"], row["key"], row["name"], *(f"{number:,.0f}" for number in numbers))
    console.PlainConsole().print(table)


def mcp(
    root: Annotated[Path, typer.Option(help="Folder that the tools read files from and write files to.")] = Path(),
    url: UrlOption = None,
    key: KeyOption = None,
) -> None:
    """Serve the tools of a language model on standard input and output, by the Model Context Protocol."""
    import anyio

    from api.cli.mcp_server import serve

    anyio.run(serve, root, url, key)


#: Commands that request an action on a job, by name.
ACTION_COMMANDS = {action.value: _command_of(action) for action in ACTIONS}

# --- shared --------------------------------------------------------------------------------------------------------


def open_client(url: str | None, key: str | None) -> Client:
    """Return a client that prints its retries."""
    set_on_retry_hooks([_print_retry])
    return Client(url, key)


def _print_retry(details: RetryDetails) -> None:
    what = str(details.caused_by) or type(details.caused_by).__name__
    console.error_console.print(f"{what}: retrying in {details.wait_for:.0f} s")


def follow(client: Client, job_id: str, as_json: bool) -> Job:
    """Show events until the job has ended; Ctrl-C ends the command, not the job."""
    try:
        return _show_events(client, job_id, as_json)
    except KeyboardInterrupt:
        console.error_console.print(
            f"The job continues on the service.\nProgress: sgsst watch {job_id}    Cancel: sgsst cancel {job_id}"
        )
        raise typer.Exit(INTERRUPTED) from None


def _show_events(client: Client, job_id: str, as_json: bool) -> Job:
    """Show events until the job has ended: as a live bar on a terminal, as lines elsewhere, or as JSON lines."""
    live = console.error_console.is_terminal and not as_json
    title, text = TextColumn("{task.description}", markup=False), TextColumn("{task.fields[text]}", markup=False)
    with live_bar(console.error_console, title, BarColumn(), text, enabled=not as_json) as bar:
        task = bar.add_task("waiting", total=1.0, text="")
        for event in client.watch(job_id):
            if as_json:
                console.out_console.print(json.dumps({"id": event.id, "event": event.kind, **event.data}))
            elif event.kind == "status":
                bar.update(task, description=event.data["status"])
                if not live:
                    console.error_console.print(f"{event.data['status']} (attempt {event.data['attempt']})")
            elif event.kind == "progress":
                line = Progress.model_validate(event.data).text()
                bar.update(task, completed=event.data["fraction"], text=line)
                if not live:
                    console.error_console.print(line)
    return client.job(job_id)


def conclude(client: Client, job: Job, out: Path, as_json: bool) -> None:
    """Download the result of a job that has ended; exit with 5 if it did not succeed."""
    if job.status != "succeeded":
        console.error_console.print(_job_text(job))
        raise typer.Exit(console.JOB_FAILED)
    result = job.data["result"]
    if result["steps"] < result.get("total", 0):
        console.error_console.print(
            f"Steps: {_step_count_text(result)}; loss {console.loss_text(result['loss_before'], result['loss_after'])}"
        )
    with console.counting_bar(out.name) as progress:
        client.download(job.id, out, progress=progress)
    console.out_console.print(json.dumps({"job": job.id, "result": str(out)}) if as_json else str(out))


def _print_job(job: Job, as_json: bool) -> None:
    console.out_console.print(json.dumps(job.data) if as_json else _job_text(job))


def _short_status(job: Job) -> str:
    """Return the status of a job with its position in the queue or its progress."""
    if job.status == "queued" and job.data.get("queue_position"):
        return f"queued, #{job.data['queue_position']}"
    if job.progress and job.status in STEPPING and job.progress["total"]:
        return f"{job.status} {job.progress['fraction']:.0%}"
    return job.status


def _job_text(job: Job) -> str:
    lines = [f"{'job:':<12}{job.id}", f"{'name:':<12}{job.data['name']}", f"{'status:':<12}{_short_status(job)}"]
    if job.progress and not job.finished:
        lines.append(f"{'progress:':<12}{Progress.model_validate(job.progress).text()}")
    result = job.data.get("result")
    if result:
        lines.append(f"{'steps:':<12}{_step_count_text(result)}")
        if result.get("psnr_after") is not None:
            painted = f"{result['psnr_before']:.1f} dB before, {result['psnr_after']:.1f} dB after"
            lines.append(f"{'painted:':<12}{painted}")
        else:
            lines.append(f"{'loss:':<12}{console.loss_text(result['loss_before'], result['loss_after'])}")
    if job.error:
        lines.append(f"{'error:':<12}{job.error['message']}")
    return "\n".join(lines)


def _step_count_text(result: Any) -> str:
    """Return the number of steps of a finished job, and why it made no more."""
    steps, total = result["steps"], result.get("total")  # results of earlier versions have no total
    if total is None or steps >= total:
        return str(steps)
    return f"{steps} of {total}: {console.EARLY_ENDS.get(result['stopped'], result['stopped'])}"


def _plan_text(plan: Any) -> str:
    lines = [f"{plan['gaussians']:,} Gaussians, {plan['views']} views, {plan['pixels']:,} pixels"]
    lines += [f"warning: {text}" for text in plan["warnings"]]
    lines += [f"{item['item']}: {item['decision']}: {item['reason']}" for item in plan["plan"]["decisions"]]
    if plan["total_seconds"]:
        whole, steps = duration(plan["total_seconds"], " "), duration(plan["estimated_seconds"], " ")
        lines.append(f"predicted: {whole} for the whole job, {steps} of them for its steps")
    return "\n".join(lines)
