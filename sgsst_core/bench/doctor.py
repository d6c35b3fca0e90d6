"""Examination of a machine: what works, what is slow, and what does not work, in plain words.

    python -m sgsst_core.bench.doctor

prints one finding per line as JSON, as soon as it is known.
"""

import json
import queue
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Literal

State = Literal["works", "warning", "problem"]
#: Seconds after which a check is cut off.
LIMIT = 27.0


@dataclass(frozen=True)
class Diagnosis:
    """Finding about one topic.

    Attributes:
        state: "works"; "warning" if jobs run, but slower than they could; "problem" if they fail or are wrong.
        text: Description, and for other states than "works", what to do.
    """

    topic: str
    state: State
    text: str


def examine(limit: float = LIMIT) -> Iterator[Diagnosis]:
    """Yield findings about this machine, as a separate process makes them.

    The process is killed if it has neither a finding nor a newly compiled kernel within `limit` seconds. A GPU that
    hangs or a driver that crashes therefore becomes a finding.
    """
    command = [sys.executable, "-P", "-m", "sgsst_core.bench.doctor"]
    lines: queue.Queue[str | None] = queue.Queue()
    with (
        tempfile.TemporaryFile("w+") as errors,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True) as process,
    ):

        def read() -> None:
            for line in process.stdout or ():
                lines.put(line)
            lines.put(None)

        threading.Thread(target=read, daemon=True).start()
        try:
            while (line := lines.get(timeout=limit)) is not None:
                if line.strip():
                    yield Diagnosis(**json.loads(line))
            if status := process.wait():
                errors.seek(0)
                last = (errors.read().strip().splitlines() or ["no message"])[-1]
                yield Diagnosis("program", "problem", f"the examination ended with status {status}: {last}")
        except queue.Empty:
            text = f"a check took more than {limit:.0f} seconds. Run the command again: what was compiled is cached."
            yield Diagnosis("time", "warning", text)
        finally:
            process.kill()


def main() -> None:
    """Print all findings as lines of JSON, and an empty line for each kernel that is compiled meanwhile."""
    from sgsst_core.bench.device_checks import (
        findings,  # imports PyTorch, which the process that examines does not need
    )
    from sgsst_core.compiled import compilations_reported

    with compilations_reported(lambda: print(flush=True)):
        for finding in findings():
            print(json.dumps(asdict(finding)), flush=True)


if __name__ == "__main__":
    main()
