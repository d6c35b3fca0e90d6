"""All benchmarks that need no GPU, one after the other: `make benchmarks DATA=FOLDER`.

python -m benchmarks DATA [--loaded]

DATA has scenes/ and styles/. Results that were measured on the same code are not measured again, so that a run goes on
where it was stopped. The exit status is 1 if a command fails.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.common import RESULTS, is_of_this_code, parse

#: Scenes with cameras, as NAME=SCENE:CAMERAS.
PLUSH = "plush=scenes/snowmiku_plush/point_cloud.ply:scenes/snowmiku_plush/cameras.json"
PLAYBOT = "playbot=scenes/playbot_synthetic_sh2/point_cloud.ply:orbit:24"
MASSA = "massa=scenes/statues/massa.sog:orbit:24"
MILLION = "million=scenes/snowmiku_plush/point_cloud.ply*1000000:scenes/snowmiku_plush/cameras.json"
OTHERS = ("narcissus=scenes/statues/narcissus.sog:orbit:24", "brooch=scenes/broche/broche.splat:orbit:24")
STARRY = "styles/starry_night.jpg"
PLUSH_INPUTS = (*PLUSH.partition("=")[2].split(":"), STARRY)
#: Name of a result and of a pair in it (empty for all, None if the command itself continues where it was stopped), and
#: the command that measures it, the most cited ones first.
COMMANDS: tuple[tuple[str, str | None, tuple[str, ...]], ...] = (
    *(
        ("left_out", text.partition("=")[0], ("left_out", text, "--style", STARRY, "--rounds", "2"))
        for text in (PLUSH, PLAYBOT, MASSA, MILLION, *OTHERS)
    ),
    ("job_parts", "", ("job_parts", *PLUSH_INPUTS, "--", "--resolution", "480")),
    ("sos_gradient", "", ("sos_gradient",)),
    ("large_views", "", ("large_views", *PLUSH_INPUTS)),
    ("large_scene", "", ("large_scene",)),
    ("ranks", "", ("ranks", *PLUSH_INPUTS, "--memory", "20")),
    ("painting", "", ("painting", PLUSH, PLAYBOT, MASSA)),
    *(
        ("first_picture", name, ("first_picture", f"scenes/statues/{name}.sog", "styles/klimt_the_kiss.jpg"))
        for name in ("massa", "narcissus")
    ),
    ("methods", "", ("methods", "run", ".")),
    ("stability", "", ("stability",)),
    ("service_load", "sqlite", ("service_load",)),
    ("service_load", "postgresql", ("service_load", "--postgresql")),
    ("service_kills", "", ("service_kills",)),
    ("hostile_memory", "", ("hostile_memory",)),
    ("hostile_key", "", ("hostile_key",)),
    ("error_time", None, ("error_time", "run", ".")),  # last, because it takes hours
)


def main() -> int:
    """Run what has not been measured on this code, and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    arguments = parse(parser)
    if not (arguments.data / "scenes").is_dir() or not (arguments.data / "styles").is_dir():
        parser.error(f"{arguments.data} has no folders scenes and styles: name the folder that has both")
    failed = []
    for name, pair, command in COMMANDS:
        if pair is not None and _is_current(name, pair):
            continue
        module, *options = (_in(arguments.data, word) for word in command)
        whole = [sys.executable, "-m", f"benchmarks.{module}", *["--loaded"] * arguments.loaded, *options]
        started = time.monotonic()
        status = subprocess.run(whole).returncode
        title = f"{name} {pair or ''}".strip()
        print(f"{title}: {time.monotonic() - started:.0f} s, status {status}", flush=True)
        failed += [title] * (status != 0)
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return int(bool(failed))


def _in(data: Path, word: str) -> str:
    """Return a word of a command with the folder of the data before the files in it."""
    if word == ".":
        return str(data)
    return word.replace("scenes/", f"{data}/scenes/").replace("styles/", f"{data}/styles/")


def _is_current(name: str, pair: str) -> bool:
    """Return whether a result was measured on the code of this commit."""
    path = RESULTS / f"{name}.json"
    content = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    pairs = content.get("pairs", {"": content})
    measured = [pairs.get(pair, {})] if pair else [*pairs.values()]
    return all(is_of_this_code(each.get("commit") or "") for each in measured)


if __name__ == "__main__":
    sys.exit(main())
