"""Tests of the command line with real files: options, plans, results, reports, messages, exit codes and the demo."""

import json
import math
import os
import pty
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import torch
import typer
from PIL import Image
from plyfile import PlyData
from torch import Tensor

from api.cli import stylize_commands
from api.cli.main import app, main
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.files.formats import RESULT_FORMATS, RESULT_SUFFIXES, by_name
from sgsst_core.files.scene_file import read_scene, write_scene, write_stylized
from sgsst_core.scene.camera import look_at
from sgsst_core.scene.gaussians import TENSORS
from tests.api.conftest import Sgsst
from tests.pngs import chunk, png
from tests.sgsst_core.files.formats.samples import files_of, streamed, unpacked
from tests.small_scenes import ball, blind_camera, cameras, wall, write_files

pytestmark = pytest.mark.usefixtures("one_thread", "tiny_installed")

ROOT = Path(__file__).resolve().parents[3]


@dataclass
class Files:
    """Inputs of a job, and the path of its output."""

    ply: Path
    cameras: Path
    style: Path
    out: Path

    def stylize(self, *options: str) -> list[str]:
        base = ["stylize", str(self.ply), "--style", str(self.style), "--out", str(self.out), "--backbone", "vgg16"]
        return [*base, "--cameras", str(self.cameras), *options]


@pytest.fixture
def files(tmp_path: Path) -> Files:
    inputs = tmp_path / "inputs with a space"
    inputs.mkdir()
    return Files(*write_files(inputs, wall(sh_degree=1)), out=tmp_path / "new" / "stylized.ply")


@pytest.mark.slow
def test_several_styles_are_mixed_by_weight(files: Files, sgsst: Sgsst) -> None:
    other = files.style.with_name("other:2.png")
    Image.new("RGB", (40, 40), (200, 40, 40)).save(other)
    options = [
        "--style",
        f"{files.style}:1",
        "--style",
        f"{other}:3",
        "--steps-sos",
        "2",
        "--training-background",
        "palette",
    ]
    shares = f"{files.style.name} 25%, other:2.png 75%"
    own = [part for part in files.stylize() if part not in ("--style", str(files.style))]
    assert f"a mixture: {shares}" in sgsst([*own, *options])
    report = json.loads(files.out.with_name("stylized.report.json").read_text())
    assert [(Path(each["path"]).name, each["weight"]) for each in report["styles"]] == [
        (files.style.name, 0.25),
        ("other:2.png", 0.75),
    ]
    assert "(75%)" in files.out.with_name("stylized.report.html").read_text()
    assert "the weight must be a finite number above 0, not 0" in sgsst([*files.stylize(), "--style", f"{other}:0"], 2)


def test_stylize_changes_only_f_dc(files: Files, sgsst: Sgsst) -> None:
    shown = sgsst(files.stylize("--steps-sos", "3"))
    for expected in (
        "616 Gaussians, SH degree 1",
        "3 of 64x48, 1 scale",
        "VGG16",
        "then 3 on all",
        "before on 3 views",
        str(files.out),
    ):
        assert expected in shown
    assert sorted(path.name for path in files.out.parent.iterdir()) == [
        "stylized.before_after.jpg",
        "stylized.loss.png",
        "stylized.plan.json",
        "stylized.ply",
        "stylized.report.html",
        "stylized.report.json",
    ]
    before, after = (PlyData.read(path)["vertex"].data for path in (files.ply, files.out))
    changed = {name for name in before.dtype.names if not np.array_equal(before[name], after[name])}
    assert changed == {"f_dc_0", "f_dc_1", "f_dc_2"}
    heads = [path.read_bytes().partition(b"end_header\n")[0] for path in (files.ply, files.out)]
    assert heads[0] == heads[1]
    report = json.loads(files.out.with_name("stylized.report.json").read_text())
    assert report["stopped"] == "finished"
    assert report["loss"]["relative"] < 1
    assert len(report["history"]) == 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "disturbances"), [((), (0, 2, 0)), (("--workers", "4"), (0, 2))], ids=["one rank", "four ranks"]
)
def test_same_command_writes_same_bytes_beside_a_busy_process(
    files: Files, options: tuple[str, ...], disturbances: tuple[int, ...]
) -> None:
    command = [sys.executable, "-m", "api.cli", *files.stylize("--steps-sos", "3", "--seed", "5", *options)]
    written, busy = set(), [sys.executable, "-c", "while True: pass"]
    for others in disturbances:
        disturbing = [subprocess.Popen(busy) for _ in range(others)]
        try:
            subprocess.run(command, check=True, capture_output=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
        finally:
            for process in disturbing:
                process.kill()
                process.wait()
        written.add(files.out.read_bytes())
    assert len(written) == 1


def test_plan_lists_skipped_work(files: Files, sgsst: Sgsst) -> None:
    write_scene(files.ply, ball())
    out = files.out.with_name("plan.json")
    command = ["plan", str(files.ply), "--cameras", str(files.cameras), "--backbone", "vgg16", "--out", str(out)]
    command += ["--steps-coarse", "2"]
    assert main([*command, "--style", str(files.ply)]) == 2
    assert not out.parent.exists()
    assert "position weights" in sgsst([*command, "--style", str(files.style)])
    plan = json.loads(out.read_text())
    items = {decision["item"] for decision in plan["decisions"]}
    assert {"position weights", "phase 1", "second forward"} <= items
    assert plan["prediction"]["seconds"] > 0


def test_plan_never_overwrites_inputs(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["plan", str(files.ply), "--cameras", str(files.cameras), "--style", str(files.style)]
    for out in (files.ply, files.cameras, files.ply.parent):
        before = files.ply.read_bytes(), files.cameras.read_bytes()
        assert main([*command, "--out", str(out)]) == 2
        assert (files.ply.read_bytes(), files.cameras.read_bytes()) == before
        assert str(out) in capsys.readouterr().err


def test_orbit_needs_no_camera_file(files: Files) -> None:
    write_scene(files.ply, ball())
    command = files.stylize("--steps-sos", "1", "--orbit", "3", "--resolution", "64")
    at = command.index("--cameras")
    assert main(command[:at] + command[at + 2 :]) == 0
    report = json.loads(files.out.with_name("stylized.report.json").read_text())
    assert report["cameras"]["source"] == "orbit"
    assert [decision["item"] for decision in report["plan"]["decisions"][:2]] == ["up", "cameras"]
    with Image.open(files.out.with_name("stylized.views.jpg")) as views:
        assert views.format == "JPEG"
    assert "Views of the orbit" in files.out.with_name("stylized.report.html").read_text()
    assert report["position_weights"]["used"] is True
    # a job with cameras of the same name does not show the views of this one
    assert main(files.stylize("--steps-sos", "1")) == 0
    assert not files.out.with_name("stylized.views.jpg").exists()
    assert "Views of the orbit" not in files.out.with_name("stylized.report.html").read_text()


def test_names_that_are_too_long_are_refused(files: Files, sgsst: Sgsst) -> None:
    long = "x" * 300
    scene, style, cameras = str(files.ply), str(files.style), str(files.cameras)
    for command in (
        ["check", long, "--cameras", cameras],
        ["convert", scene, f"{long}.spz"],
        ["blend", scene, f"{long}:0.5", "--out", "blend.ply"],
        ["study", "make", scene, f"name={long}", "--style", style, "--cameras", cameras],
        ["plan", scene, "--style", style, "--cameras", cameras, "--out", f"{long}.json"],
        ["submit", scene, "--style", style, "--cameras", long],
    ):
        assert re.search("^error: .*x{300}.*: File name too long. Check the path.$", sgsst(command, 2))
    assert json.loads(sgsst(["submit", scene, "--style", long, "--orbit", "3", "--json"], 2))["code"] == "path"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "written"),
    [
        ("error-time", {"error_time.json", "error_time.png", "standard.ply", "coarse-only.ply"}),
        (
            "quality",
            {"quality.json", "quality.png", "quality.jpg", "error_time.png"}
            | {"transfer.ply", "standard.ply", "coarse-only.ply"},
        ),
    ],
)
def test_bench_writes_plots_and_scenes(files: Files, sgsst: Sgsst, kind: str, written: set[str]) -> None:
    folder = files.out.with_name("bench")
    command = ["bench", kind, str(files.ply), "--cameras", str(files.cameras), "--style", str(files.style)]
    command += ["--backbone", "vgg16", "--out", str(folder), "--coarsest-side", "24"]
    assert "no variant faster" in sgsst([*command, "--variants", "standard,faster"], 2)
    assert not folder.exists()
    more = ["--resolution", "96", "--seed", "3"] if kind == "quality" else []
    shown = sgsst([*command, "--seconds", "2", "--variants", "standard, coarse-only", *more])
    assert {path.name for path in folder.iterdir()} == written
    values = json.loads((folder / f"{kind.replace('-', '_')}.json").read_text())
    if kind == "quality":
        names = [outcome["name"] for outcome in values["outcomes"]]
        assert (names, values["settings"]["seed"]) == (["unstylized", "transfer", "standard", "coarse-only"], 3)
    else:
        names = ["standard", "coarse-only"]
        assert len(values["variants"]["standard"]["points"]) == 6
    assert all(name in shown for name in names)
    for path in folder.glob("*.ply"):
        assert len(read_scene(path).scene) == len(wall())


def test_failed_report_preserves_scene(files: Files, sgsst: Sgsst) -> None:
    files.out.with_name("stylized.report.json").mkdir(parents=True)
    error = sgsst(files.stylize("--steps-sos", "1"), 1)
    assert "report could not be written" in error
    assert "stylized.report.json" in error
    assert len(read_scene(files.out).scene) == len(wall())


# --- stop and resume -----------------------------------------------------------------------------------------------


def interrupted(arguments: list[str], folder: Path) -> str:
    """Run a command in a folder until its schedule, press Ctrl-C, and return its errors."""
    command = [sys.executable, "-m", "api.cli", *arguments]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, cwd=folder
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("schedule"):  # from here on, Ctrl-C lets the current step finish
                break
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=600)  # includes compilation of the kernels
    assert process.returncode == 130, error
    return error


@pytest.mark.slow
def test_resume_after_ctrl_c_is_bit_identical(files: Files, capfd: pytest.CaptureFixture[str]) -> None:
    options = files.stylize("--steps-sos", "150", "--learning-rate", "0.1")  # a second: a signal arrives during it
    error = interrupted(options, files.ply.parent)
    assert "Traceback" not in error
    checkpoint = files.out.with_name("stylized.checkpoint.safetensors")
    plan = files.out.with_name("stylized.plan.json")
    assert sorted(path.name for path in files.out.parent.iterdir()) == [checkpoint.name, plan.name]
    assert f"saved in {checkpoint}" in error
    go_on = shlex.split(error.strip().splitlines()[-1])
    assert go_on == ["sgsst", *options, "--resume"]

    assert main([*options, "--seed", "1", "--resume"]) == 2
    assert "belongs to another job" in capfd.readouterr().err
    assert main(go_on[1:]) == 0
    assert "resuming" in capfd.readouterr().out
    assert not checkpoint.exists()
    resumed = files.out.read_bytes()
    assert main(options) == 0
    assert files.out.read_bytes() == resumed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hangup", "workers", "code", "name"),
    [
        ("--default-signal=HUP", (), 128 + signal.SIGHUP, "stylized.checkpoint.safetensors"),
        ("--default-signal=HUP", ("--workers", "2"), 128 + signal.SIGHUP, "stylized.checkpoint.safetensors"),
        ("--ignore-signal=HUP", (), 0, "stylized.report.json"),  # printing fails without a signal
    ],
)
def test_closed_terminal_saves_unless_ignored(
    files: Files, hangup: str, workers: tuple[str, ...], code: int, name: str
) -> None:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "TERM": "xterm", "COLUMNS": "120"}
    environment.pop("RAY_ADDRESS", None)
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "api.cli", *files.stylize("--steps-sos", "400", "--no-early-stop", *workers)]
    with subprocess.Popen(
        ["env", hangup, "setsid", "--ctty", *command], stdin=theirs, stdout=theirs, stderr=theirs, env=environment
    ) as process:
        os.close(theirs)
        _shown_until(ours, r" [1-9]\d*/400")
        os.close(ours)
        assert process.wait(timeout=120) == code
    assert files.out.with_name(name).exists()


def test_closed_terminal_never_aborts() -> None:
    """SIGHUP arrives after Ctrl-C and twice: from the shell, and from the system when the shell ends."""
    lines = [
        "import signal",
        "from api.cli.stylize_commands import StopFlag",
        "stop = StopFlag()",
        "with stop.on_signal():",
        "    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGHUP):",
        "        signal.raise_signal(number)",
        "signal.raise_signal(signal.SIGHUP)",
        "raise SystemExit(stop.exit_code)",
    ]
    command = ["env", "--default-signal=HUP", sys.executable, "-c", "\n".join(lines)]
    assert subprocess.run(command, cwd=ROOT, check=False).returncode == 128 + signal.SIGHUP


def _shown_until(terminal: int, pattern: str | None) -> str:
    """Return a program's terminal output until a pattern matches it; if `pattern` is None, until the program ends."""
    shown = ""
    while pattern is None or not re.search(pattern, shown):
        try:
            data = os.read(terminal, 4096)
        except OSError:  # the other end is closed
            break
        if not data:
            break
        shown += data.decode(errors="replace")
    return shown


@pytest.mark.slow
def test_time_budget_writes_result_and_checkpoint(files: Files, sgsst: Sgsst) -> None:
    options = files.stylize("--steps-sos", "5")
    shown = sgsst([*options, "--within", "0.000001"])
    assert "The time of --within was used up at step 1 of 5" in shown
    assert "--resume" in shown
    checkpoint = files.out.with_name("stylized.checkpoint.safetensors")
    assert checkpoint.exists()
    partial = files.out.read_bytes()
    assert json.loads(files.out.with_name("stylized.report.json").read_text())["stopped"] == "within"

    assert main([*options, "--resume"]) == 0
    assert not checkpoint.exists()
    assert files.out.read_bytes() != partial
    report = json.loads(files.out.with_name("stylized.report.json").read_text())
    assert [entry["step"] for entry in report["history"]] == [1, 2, 3, 4, 5]

    assert "this job is finished" in sgsst([*options, "--resume"], 2)


# --- bad input -----------------------------------------------------------------------------------------------------


#: Header of an ASCII PLY with one vertex, up to further elements.
_VERTEX = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"


def _with_infinite_values(files: Files) -> None:
    scene = wall()
    scene.scales[3, 1], scene.scales[4, 1] = float("inf"), float("nan")
    write_scene(files.ply, scene)


def _without_gaussians(files: Files) -> None:
    head, end, _ = files.ply.read_bytes().partition(b"end_header\n")
    files.ply.write_bytes(head.replace(b"element vertex 616", b"element vertex 0") + end)


def _with_one_photo(files: Files) -> None:
    (files.ply.parent / "photos").mkdir()
    Image.new("RGB", (64, 48)).save(files.ply.parent / "photos" / "view_1.png")


@pytest.mark.parametrize(
    ("spoil", "options", "expected"),
    [
        (lambda files: files.ply.unlink(), [], ["scene.ply", "No such file"]),
        (lambda files: files.ply.write_bytes(files.ply.read_bytes()[:-1000]), [], ["scene.ply", "truncated"]),
        (
            lambda files: files.ply.write_bytes(files.ply.read_bytes().replace(b"vertex 616", b"vertex 999999999999")),
            [],
            ["scene.ply", "999999999999"],
        ),
        (
            lambda files: files.ply.write_text(
                f"{_VERTEX}element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n3 0 0 0\n"
            ),
            [],
            ["scene.ply", "mesh", "rot_0", "opacity"],
        ),
        (
            lambda files: files.ply.write_text(f"{_VERTEX}end_header\n0 0 0\n"),
            [],
            ["scene.ply", "point cloud", "f_dc_0"],
        ),
        (
            _with_infinite_values,
            [],
            ["scene.ply", "2 of 616", "no rotation: scale_1", "--drop-invalid"],
        ),
        (_without_gaussians, [], ["scene.ply", "no Gaussians"]),
        (
            lambda files: write_files(
                files.ply.parent, wall(), [blind_camera(), replace(blind_camera(), name="blind_2")]
            ),
            [],
            ["None of the 2 cameras sees a Gaussian"],
        ),
        (lambda files: files.cameras.write_text('{"poses": []}'), [], ["cameras.json", "transforms.json"]),
        (lambda files: files.cameras.unlink(), [], ["cameras.json", "cannot be read"]),
        (
            _with_one_photo,
            ["--images", "{0.ply.parent}/photos"],
            ["no photo for 2 of 3 views: view_0, view_2"],
        ),
        (lambda files: files.style.write_text("not an image"), [], ["style.png", "not an image"]),
        (lambda files: files.style.unlink(), [], ["style.png", "No such file"]),
        (
            lambda files: files.style.write_bytes(png(90000, 90000, chunk(b"IDAT", b""))),
            [],
            ["style.png", "megapixels"],
        ),
        (
            lambda files: Image.new("RGB", (5000, 1)).save(files.style),
            ["--style-scale", "4"],
            ["--style-scale 4", "16,384", "smaller scale"],
        ),
        (None, ["--out", "{0.ply.parent}"], ["is a folder"]),
        (None, ["--out", "{0.cameras}/stylized.ply"], ["cameras.json"]),
        (None, ["--out", "{0.ply.parent}/../{0.ply.parent.name}/{0.ply.name}"], ["is the scene itself"]),
        (
            lambda files: shutil.copy(files.cameras, files.cameras.with_name("stylized.report.json")),
            ["--cameras", "{0.ply.parent}/stylized.report.json", "--out", "{0.ply.parent}/stylized.ply"],
            ["report.json (written beside stylized.ply): is the camera file"],
        ),
        (
            lambda files: shutil.copy(files.style, files.style.with_name("stylized.before_after.jpg")),
            [
                *("--out", "{0.ply.parent}/stylized.ply", "--region", "near:sphere=0,0,4,1"),
                *("--region-style", "near={0.ply.parent}/stylized.before_after.jpg"),
            ],
            ["before_after.jpg (written beside stylized.ply): is the style image"],
        ),
        (None, ["--out", "{0.style}"], ["does not end in .ply"]),
        (None, ["--out", "{0.ply.parent}/scene.splat"], [f"does not end in {RESULT_SUFFIXES}"]),
        (None, ["--out", "{0.ply.parent}/scene.spz"], ["(written beside scene.spz): is the scene itself"]),
        (None, ["--steps-sos", "0", "--steps-coarse", "0"], ["steps are 0"]),
        (None, ["--orbit", "3"], ["--cameras", "--orbit"]),
        (None, ["--resume"], ["no checkpoint to resume from"]),
        (
            lambda files: files.ply.with_name("stylized.checkpoint.safetensors").write_bytes(b"damaged"),
            ["--out", "{0.ply.parent}/stylized.ply", "--resume"],
            ["not a readable checkpoint"],
        ),
    ],
)
def test_bad_input_prints_one_message_and_leaves_no_files(
    files: Files,
    tmp_path: Path,
    spoil: Callable[[Files], object] | None,
    options: list[str],
    expected: list[str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    if spoil is not None:
        spoil(files)
    before = _everything(tmp_path)
    assert main(files.stylize(*(option.format(files) for option in options))) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("error: ") == 1
    assert len(shown.err.strip().splitlines()) == 1
    for words in expected:
        assert words in shown.err
    assert _everything(tmp_path) == before


def _everything(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}


def test_default_cameras_are_those_beside_the_scene_or_else_an_orbit(
    files: Files, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "views"
    command = ["render", str(files.ply), "--out", str(out), "--views", "2", "--resolution", "32"]
    for options in ([], ["--elevation", "20"]):
        assert main([*command, *options]) == 0
        assert (f"those of {files.cameras};" in capsys.readouterr().err) == (not options)
        assert len(list(out.iterdir())) == 2
        shutil.rmtree(out)
    files.cameras.unlink()
    assert main(command) == 0
    assert "There are no cameras beside" in capsys.readouterr().err
    assert len(list(out.iterdir())) == 2


def test_missing_weights_error_names_fetch_command(
    files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sgsst: Sgsst
) -> None:
    monkeypatch.setenv("SGSST_CACHE", str(tmp_path / "empty"))
    for backbone in ("auto", "vgg16", "vgg19"):
        assert "sgsst weights fetch vgg1" in sgsst(files.stylize("--backbone", backbone), 2)
    assert not files.out.parent.exists()


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--preset", "fast"], "preset"),
        (["--precision", "float8"], "precision"),
        (["--background", "0,0,256"], "background"),
        (["--background", "blue"], "background"),
        (["--memory-limit", "lots"], "memory-limit"),
        (["--memory-limit", "0GB"], "memory-limit"),
        (["--within", "0s"], "within"),
        (["--unheard-of"], "unheard-of"),
        (["--orbit", "many"], "unable to parse string as an integer, or 'auto'.\n"),
        (["--scales", "0,0"], "no scale has a weight"),
        (["--scales", "1,-1"], "greater than or equal to 0"),
        (["--scales", "nan"], "finite"),
        (["--scales", "fine"], "is not a list of weights"),
        (["--scales", "0,1"], "the views have one scale, 0"),
        (["--sh-attenuation", "1.5"], "less than or equal to 1"),
        (["--preserve-colors", "hue"], "hue"),
    ],
    ids=str,
)
def test_invalid_options_are_refused_before_work_starts(
    files: Files, sgsst: Sgsst, options: list[str], problem: str
) -> None:
    for name, out in (("stylize", files.out), ("plan", files.out.with_suffix(".json"))):
        error = sgsst([name, *files.stylize("--out", str(out), *options)[1:]], 2)
        assert problem in error.replace("memory_limit", "memory-limit")
        assert not files.out.parent.exists()


# --- render, weights, program --------------------------------------------------------------------------------------


def test_render_writes_one_image_per_view_in_camera_order(files: Files, tmp_path: Path, sgsst: Sgsst) -> None:
    names = ["b/left.png", "a/left.png", "a/left.png"]
    views = [replace(camera, name=name) for camera, name in zip(cameras(3), names, strict=True)]
    write_files(files.ply.parent, ball(), views)
    out = tmp_path / "renders"
    command = ["render", str(files.ply), "--cameras", str(files.cameras), "--out", str(out)]
    assert "3 views" in sgsst(command)
    images = sorted(out.iterdir())
    assert [image.name for image in images] == ["0000_b_left.png", "0001_a_left.png", "0002_a_left.png"]
    arrays = [np.asarray(Image.open(image)) for image in images]
    assert arrays[0].shape == (48, 64, 3)
    assert (arrays[0][0, 0] == 0).all()
    means = [np.nonzero(array.any(axis=(0, 2)))[0].mean() for array in arrays]
    assert means == sorted(means, reverse=True) or means == sorted(means)

    assert main([*command, "--background", "10,20,30", "--resolution", "100", "--views", "1"]) == 0
    image = np.asarray(Image.open(out / "0000_a_left.png"))
    assert image.shape == (75, 100, 3)
    assert image[0, 0].tolist() == [10, 20, 30]


@pytest.mark.parametrize("path", ["cameras", "orbit"])
def test_render_writes_a_video_or_its_frames(
    files: Files, tmp_path: Path, capsys: pytest.CaptureFixture[str], path: str
) -> None:
    video, images = tmp_path / "video.mp4", tmp_path / "frames" / "%03d.png"
    command = ["render", str(files.ply), "--cameras", str(files.cameras), "--path", path, "--resolution", "65"]
    command += ["--fps", "10", "--seconds", "0.8", "--background", "10,20,30"]
    assert main([*command, "--video", str(images)]) == 0
    assert main([*command, "--video", str(video)]) == 0
    shown = capsys.readouterr()
    assert re.search(r"8 frames of (64x|54x64)", shown.out)
    assert "0.8 s at 10 per second" in shown.out
    with av.open(str(video)) as container:
        assert len(list(container.decode(video=0))) == len(list(images.parent.iterdir())) == 8


@pytest.mark.parametrize("transition", ["wipe", "fade"])
def test_comparison_starts_with_the_unstylized_scene(files: Files, tmp_path: Path, transition: str) -> None:
    scene = read_scene(files.ply).scene
    red = tmp_path / "red.ply"
    write_scene(
        red, replace(scene, sh_dc=torch.zeros_like(scene.sh_dc) + torch.tensor([1.5, -1.5, -1.5])), by_name("ply")
    )
    shown = {}
    for name, extra in {
        "before": [],
        "after": [],
        "video": ["--compare", str(files.ply), "--transition", transition],
    }.items():
        command = ["render", str(files.ply if name == "before" else red), "--cameras", str(files.cameras), *extra]
        assert main([*command, "--video", str(tmp_path / name), "--fps", "9", "--seconds", "1"]) == 0
        shown[name] = [np.asarray(Image.open(path)).astype(float) for path in sorted((tmp_path / name).iterdir())]
    assert np.array_equal(shown["video"][0], shown["before"][0])
    assert np.array_equal(shown["video"][-1], shown["after"][-1])
    middle, before, after = (shown[name][4] for name in ("video", "before", "after"))
    if transition == "wipe":
        assert np.array_equal(middle[:, :32], after[:, :32])
        assert np.array_equal(middle[:, 32:], before[:, 32:])
    else:
        assert np.abs(middle - (before + after) / 2).max() <= 1


def test_render_writes_a_panorama_from_the_position_of_a_camera(
    files: Files, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The ball lies straight ahead of the second camera, and to the right of the first one, whose heading is level."""
    wide = tmp_path / "wide.png"
    tilted = look_at(
        "a/left.png", torch.tensor([-3.0, 0.0, 3.0]), torch.tensor([-3.0, 1.0, 5.0]), torch.tensor([0.0, -1.0, 0.0]),
        width=64, height=48, focal=64.0,
    )  # fmt: skip
    write_files(files.ply.parent, ball(), [tilted, *cameras(1)])
    command = ["render", str(files.ply), "--cameras", str(files.cameras), "--panorama", str(wide), "--up=-y"]
    for options, middle in ((["--from", "view_0"], 0.5), ([], 0.75)):
        assert main([*command, *options, "--resolution", "256", "--background", "1,2,3"]) == 0
        image = np.asarray(Image.open(wide)).astype(int)
        assert image.shape == (128, 256, 3)
        rows, columns = np.nonzero(np.abs(image - [1, 2, 3]).max(axis=2))
        assert rows.mean() / 128 == pytest.approx(0.5, abs=0.01)
        assert columns.mean() / 256 == pytest.approx(middle, abs=0.01)
        radius = math.asin(0.9 / 3) / (2 * math.pi)  # of the ball with a margin for the size of its Gaussians
        assert np.ptp(columns) / 256 == pytest.approx(2 * radius, abs=0.02)
    assert f"panorama: {wide}, from the position of a/left.png" in re.sub(" +", " ", capsys.readouterr().out)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--out", "views", "--video", "video.mp4"], "Give one of --out FOLDER"),
        (["--video", "video.mp4", "--panorama", "wide.png"], "Give one of --out FOLDER"),
        ([], "--out FOLDER"),
        (["--panorama", "wide.jpg"], "wide.jpg: not the name of a PNG image"),
        (["--panorama", "wide.png", "--from", "nobody"], "No view is called nobody. There are 3: view_0, view_1"),
        (["--panorama", "wide.png", "--fps", "10"], "--fps requires --video"),
        (["--out", "views", "--from", "view_0"], "--from requires --panorama"),
        (["--video", "video.avi"], "is no video"),
        (["--video", "video.mp4", "--transparent"], "no alpha channel"),
        (["--out", "views", "--fps", "10"], "--fps requires --video"),
        (["--out", "views", "--compare", "scene.ply"], "--compare requires --video"),
        (["--video", "video.mp4", "--orbit", "4"], "a view per frame"),
        (["--video", "video.mp4", "--seconds", "0"], "--seconds"),
        (["--video", "video.mp4", "--compare", "missing.ply"], "missing.ply"),
        (["--video", "video.mp4", "--resolution", "16000"], "at most 8192"),
    ],
)
def test_video_options_that_contradict_each_other_are_refused(
    files: Files, sgsst: Sgsst, monkeypatch: pytest.MonkeyPatch, options: list[str], message: str
) -> None:
    monkeypatch.chdir(files.ply.parent)
    before = sorted(Path().iterdir())
    assert message in sgsst(["render", "scene.ply", *options], 2)
    assert sorted(Path().iterdir()) == before


@pytest.mark.parametrize("name", [format.name for format in RESULT_FORMATS])
def test_convert_writes_what_it_reads(files: Files, sgsst: Sgsst, name: str) -> None:
    written, back = files.out.with_name(f"scene.{name}"), files.out.with_name("back.ply")
    match = re.search(
        rf"compared: +{name}, .* (renders identical to|([0-9.]+) dB PSNR against) scene.ply",
        sgsst(["convert", str(files.ply), str(written), "--compare", "--cameras", str(files.cameras)]),
    )
    assert match
    assert match[2] is None or float(match[2]) > 28
    assert main(["convert", str(written), str(back)]) == 0
    one, other = (read_scene(path) for path in (written, back))
    assert (one.format, other.format) == (name, "ply")
    for field in TENSORS:
        assert torch.equal(getattr(one.scene, field), getattr(other.scene, field)), field


def test_convert_says_what_it_changes(files: Files, sgsst: Sgsst) -> None:
    ply = PlyData.read(files.ply, mmap=False)
    ply["vertex"]["opacity"][:3] = np.inf
    ply["vertex"]["x"][3] = np.nan
    ply.write(files.ply)
    said = " ".join(sgsst(["convert", str(files.ply), str(files.out), "--drop-invalid"]).split())
    assert "1 invalid ones dropped, 3 infinite opacities read as almost 0 or 1" in said


def test_streamed_sog_is_stylized_at_all_levels(files: Files, sgsst: Sgsst) -> None:
    scene = wall(sh_degree=1)
    files.ply = unpacked(files.ply.parent / "levels", streamed([[scene], [scene.subset(torch.arange(0, 616, 5))]]))
    files.out = files.out.with_name("stylized.zip")
    assert "Omit --refine" in sgsst(files.stylize("--refine", "2"), 2)
    assert re.search(
        "compressed: +zip, .* dB PSNR against the PLY", " ".join(sgsst(files.stylize("--steps-sos", "2")).split())
    )
    written, ply = files_of(files.out), files.out.with_suffix(".ply")
    assert len(read_scene(ply).scene) == len(read_scene(files.out).scene) == 616
    assert written["1_0/sh0.webp"] != (files.ply / "1_0" / "sh0.webp").read_bytes()
    again = files.out.with_name("again.zip")
    assert main(["convert", str(ply), str(again), "--levels-of", str(files.ply / "lod-meta.json")]) == 0
    assert files_of(again) == written
    for arguments, message in (
        ([str(ply), str(again)], "needs the levels of a streamed SOG"),
        ([str(ply), str(ply.with_suffix(".sog")), "--levels-of", str(files.ply)], "has no levels of detail"),
        ([str(ply), str(again), "--levels-of", str(ply)], "is no streamed SOG"),
        ([str(files.ply), str(files.ply / "lod-meta.json")], "which would be overwritten"),
    ):
        assert message in sgsst(["convert", *arguments], 2)


def test_padded_plys_have_248_bytes_a_row(files: Files, sgsst: Sgsst) -> None:
    converted = files.out.with_name("converted.ply")
    assert main(["convert", str(files.ply), str(converted), "--pad-sh"]) == 0
    assert main(files.stylize("--steps-sos", "2", "--pad-sh")) == 0
    for path in (converted, files.out):
        head, _, rows = path.read_bytes().partition(b"end_header\n")
        assert len(rows) == 616 * 248
        assert [line.split()[2] for line in head.splitlines() if b" f_rest" in line] == [
            f"f_rest_{i}".encode() for i in range(45)
        ]
        rest, before = read_scene(path).scene.sh_rest, read_scene(files.ply).scene.sh_rest
        assert isinstance(rest, Tensor)
        assert isinstance(before, Tensor)
        assert torch.equal(rest[:, :3], before)
        assert not rest[:, 3:].any()
    assert "only a PLY can be padded" in sgsst(
        ["convert", str(files.ply), str(converted.with_suffix(".spz")), "--pad-sh"], 2
    )


def test_convert_compares_in_an_orbit(files: Files, sgsst: Sgsst) -> None:
    assert "renders identical to scene.ply" in sgsst(["convert", str(files.ply), str(files.out), "--compare"])


def test_convert_refuses_what_it_cannot_write(files: Files, sgsst: Sgsst) -> None:
    before = files.ply.read_bytes()
    for out, message in (
        (files.ply, "is the scene itself"),
        (files.ply.parent, "is a folder. Name a file in it"),
        (files.out.with_name("scene.splat"), f"does not end in {RESULT_SUFFIXES}"),
        (files.ply / "scene.spz", "there is a file of that name"),
    ):
        assert message in sgsst(["convert", str(files.ply), str(out)], 2)
    blind = files.cameras.with_name("blind.json")
    blind.write_text("[]")
    assert main(["convert", str(files.ply), str(files.out), "--cameras", str(blind)]) == 2
    assert files.ply.read_bytes() == before
    assert not files.out.parent.exists()


def test_blend_mixes_a_scene_and_its_result(files: Files, sgsst: Sgsst) -> None:
    scene, result = read_scene(files.ply), files.ply.with_name("result.ply")
    write_stylized(scene, result, -scene.scene.sh_dc)
    said = " ".join(sgsst(["blend", f"{files.ply}:-0.5", f"{result}:1.5", "--out", str(files.out)]).split())
    assert f"weight: -0.5 of {files.ply}" in said
    assert torch.allclose(read_scene(files.out).scene.sh_dc, -2 * scene.scene.sh_dc)
    assert main(["blend", str(files.ply), str(result), "--out", str(files.out.with_suffix(".spz"))]) == 0
    assert read_scene(files.out.with_suffix(".spz")).scene.sh_dc.abs().max() < 0.02


def test_weights_list_and_fetch(
    tiny_weights: BackboneWeights, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sgsst: Sgsst
) -> None:
    state = {
        f"features.{index}.{kind}": tensor
        for index, pair in zip(
            (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28), tiny_weights.convolutions.values(), strict=True
        )
        for kind, tensor in zip(("weight", "bias"), pair, strict=True)
    }
    torch.save(state, tmp_path / "vgg16.pth")
    monkeypatch.setenv("SGSST_CACHE", str(tmp_path / "cache"))
    assert sgsst(["weights", "path"]).strip() == str(tmp_path / "cache")
    assert str(tmp_path / "cache" / "vgg16.safetensors") in sgsst(
        ["weights", "fetch", "vgg16", "--from", str(tmp_path / "vgg16.pth")]
    )
    lines = sgsst(["weights", "list"]).splitlines()
    assert next(line for line in lines if line.startswith("vgg16")).split()[3] == "installed"
    assert "to download from" in next(line for line in lines if line.startswith("vgg19"))
    assert "missing.pth" in sgsst(["weights", "fetch", "vgg16", "--from", str(tmp_path / "missing.pth")], 2)


@pytest.mark.parametrize(
    ("arguments", "unneeded"),
    [
        (["--version"], "torch numpy scipy ray numba matplotlib pydantic typer"),
        (["--help"], "torch numpy scipy ray numba matplotlib pydantic"),
        (["stylize", "--help"], "torch scipy ray numba matplotlib httpx2"),
    ],
)
def test_short_calls_import_little(arguments: list[str], unneeded: str) -> None:
    check = (
        "import sys; from api.cli.__main__ import run; code = run(); "
        f"sys.exit(code or ' '.join(set({unneeded.split()}) & sys.modules.keys()) or 0)"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ended = subprocess.run([sys.executable, "-c", check, *arguments], env=environment, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (0, "")


@pytest.mark.parametrize(
    "arguments",
    [
        ["check", "{url}", "--orbit", "2"],
        ["render", "{url}", "--orbit", "2", "--out", "renders"],
        ["render", "scene.ply", "--cameras", "{url}", "--out", "renders"],
        ["render", "scene.ply", "--orbit", "2", "--video", "o.mp4", "--compare", "{url}"],
        ["convert", "{url}", "scene.spz"],
        ["convert", "scene.ply", "scene.spz", "--cameras", "{url}"],
        ["check", "scene.ply", "--orbit", "2", "--style", "{url}"],
        ["bench", "quality", "scene.ply", "--orbit", "2", "--style", "{url}"],
        ["blend", "{url}:0.3", "scene.ply:0.7", "--out", "blend.ply"],
        ["study", "make", "a.ply", "b.ply", "--orbit", "2", "--style", "{url}"],
        ["study", "make", "a={url}", "b.ply", "--orbit", "2", "--style", "style.jpg", "--out", "study.html"],
    ],
    ids=lambda arguments: arguments[0],
)
def test_commands_for_files_name_a_url_unchanged(arguments: list[str], sgsst: Sgsst) -> None:
    url = "https://files.example.com/scene.ply"
    assert f"{url}: only `sgsst submit` takes URLs" in sgsst([each.format(url=url) for each in arguments], 2)


def test_sheet_of_a_plan_replaces_no_photo(tmp_path: Path, sgsst: Sgsst) -> None:
    (tmp_path / "photos").mkdir()
    inputs = ["no.ply", "--style", "no.png", "--cameras", "no.json", "--images", str(tmp_path / "photos")]
    sheet = tmp_path / "photos" / "a.jpg"
    assert f"{sheet}: is among the photos or masks." in sgsst(["plan", *inputs, "--sheet", str(sheet)], 2)


# --- check ---------------------------------------------------------------------------------------------------------


#: Commands that write, up to the file or folder, all with inputs that do not exist.
_WRITING = [
    ["stylize", "no.ply", "--style", "no.png", "--orbit", "3", "--out", "s.ply"],
    ["batch", "no.ply", "--style", "no.png", "--orbit", "3", "--out", "results"],
    ["plan", "no.ply", "--style", "no.png", "--orbit", "3", "--out", "plan.json"],
    ["plan", "no.ply", "--style", "no.png", "--orbit", "3", "--sheet", "views.jpg"],
    ["render", "no.ply", "--orbit", "3", "--out", "views"],
    ["render", "no.ply", "--video", "frame_%04d.png"],
    ["convert", "no.ply", "OUT", "s.sog"],
    ["convert", "no.ply", "OUT", "meta.json"],
    ["blend", "no.ply", "nor.ply", "--out", "s.ply"],
    ["view", "no.ply", "--out", "s.html"],
    ["paint", "no.ply", "--orbit", "3", "--export", "front", "--out", "front.png"],
    ["demo", "--out", "demo"],
    ["submit", "no.ply", "--style", "no.png", "--url", "http://127.0.0.1:1", "--out", "s.ply"],
    ["download", "no-job", "--url", "http://127.0.0.1:1", "--out", "s.ply"],
    ["download", "no-job", "all", "--url", "http://127.0.0.1:1", "--out", "all"],
    ["study make", "no.ply", "nor.ply", "--style", "no.png", "--orbit", "3", "--out", "study.html"],
    ["bench error-time", "no.ply", "--style", "no.png", "--orbit", "3", "--out", "results"],
    ["bench quality", "no.ply", "--style", "no.png", "--orbit", "3", "--out", "results"],
]


@pytest.mark.parametrize("command", _WRITING, ids=lambda command: f"{command[0]} {command[-2]}")
def test_outputs_are_checked_before_inputs_are_read(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    name, *arguments, flag, out = command
    targets = [(f"file/below/{out}", "file: cannot be used as output folder: there is a file of that name")]
    if Path("/proc/self").is_dir():  # not even root can write there
        targets.append((f"/proc/absent/{out}", "/proc: is not writable. Name another folder."))
    if Path(out).suffix and "%" not in out:
        (tmp_path / out).mkdir()
        targets.append((out, "is a folder"))
    before = _everything(tmp_path)
    for path, message in targets:
        assert main([*name.split(), *arguments, *([] if flag == "OUT" else [flag]), path]) == 2
        shown = capsys.readouterr()
        *notes, error = shown.err.splitlines()
        assert message in error
        assert all(note.startswith("There are no cameras beside") for note in notes)
    assert _everything(tmp_path) == before


def test_every_command_that_writes_is_tested() -> None:
    def writing(group: Any, prefix: str = "") -> set[str]:
        names = set()
        for name, command in group.commands.items():
            if hasattr(command, "commands"):
                names |= writing(command, f"{name} ")
            elif any(each.name == "out" for each in command.params):
                names.add(prefix + name)
        return names

    assert writing(typer.main.get_command(app)) == {command[0] for command in _WRITING}


CONTROLS = [
    "--preserve-colors",
    "luminance",
    "--sh-attenuation",
    "0.25",
    "--scales",
    "1,0,0.5",
    "--coarsest-side",
    "16",
]


def test_controls_take_effect_and_are_reported(files: Files, sgsst: Sgsst) -> None:
    files.out = files.out.with_suffix(".spz")
    shown = sgsst(files.stylize("--steps-coarse", "1", "--steps-sos", "3", *CONTROLS))
    for line in (
        "only luminance is compared and optimized",
        "multiplied by 0.75",
        "scale 0 1, scale 2 0.5; others are not computed",
        "2 scales",
        "compressed:           spz, ",
        "dB PSNR against the PLY",
    ):
        assert line in shown
    before, after = (read_scene(path).scene for path in (files.ply, files.out.with_suffix(".ply")))
    assert torch.equal(after.sh_rest, 0.75 * before.sh_rest)
    change = after.sh_dc - before.sh_dc
    assert float(change.abs().max()) > 0.1
    torch.testing.assert_close(change, change.mean(1, keepdim=True).expand(-1, 3), atol=1e-6, rtol=0)
    report = json.loads(files.out.with_name("stylized.report.json").read_text())
    wanted = {"preserve_colors": "luminance", "scales": [1, 0, 0.5], "sh_attenuation": 0.25}
    assert report["settings"].items() >= wanted.items()
    assert report["scene"]["sh_degree"] == 1
    size = files.out.stat().st_size
    assert (report["compressed"]["name"], report["compressed"]["bytes"]) == (files.out.name, size)
    loss = report["loss"]["after"]
    assert sorted(loss["scales"]) == ["0", "2"]
    assert loss["total"] == pytest.approx((loss["scales"]["0"]["total"] + 0.5 * loss["scales"]["2"]["total"]) / 1.5)
    packed = read_scene(files.out).scene
    assert float(packed.sh_rest.abs().max()) < 0.8 * float(before.sh_rest.abs().max())


@pytest.mark.slow
def test_demo_stylizes_its_scene_and_prints_result_paths(
    vgg16_weights: BackboneWeights,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    sgsst: Sgsst,
) -> None:
    monkeypatch.setattr(stylize_commands, "DEMO_STEPS", 1)
    monkeypatch.setattr(stylize_commands, "DEMO_RESOLUTION", 180)
    out = tmp_path / "demo"
    shown = sgsst(["demo", "--out", str(out)])
    names = {"stylized.ply", "stylized.report.json", "stylized.before_after.jpg", "stylized.loss.png"}
    names |= {"stylized.report.html"}
    inputs = {"motorcycle.ply", "cameras.json", "starry_night.jpg"}
    assert {path.name for path in out.iterdir()} == names | inputs | {"stylized.plan.json"}
    for name in names:
        assert str(out / name) in shown
    before, after = read_scene(out / "motorcycle.ply").scene, read_scene(out / "stylized.ply").scene
    assert torch.equal(before.means, after.means)
    assert float((before.sh_dc != after.sh_dc).float().mean()) > 0.5
    report = json.loads((out / "stylized.report.json").read_text())
    assert report["loss"]["relative"] < 0.9
    assert report["cameras"]["count"] == 10

    # The printed command is the one that ran.
    command = next(line for line in shown.splitlines() if line.startswith("command:")).removeprefix("command:")
    arguments = shlex.split(command)
    assert arguments[:3] == ["sgsst", "stylize", str(out / "motorcycle.ply")]
    assert "this job is finished" in sgsst([*arguments[1:], "--resume"], 2)
