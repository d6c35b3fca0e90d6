"""Command `doctor`: what works on this machine."""

from __future__ import annotations

import json
from dataclasses import asdict

import typer

from api.cli.arguments import JsonOption
from api.cli.console import FAILURE, out_console

#: Exit code if jobs run, but slower than they could.
WARNING = 3
_MARKS = {"works": "ok", "warning": "WARNING", "problem": "PROBLEM"}


def doctor(as_json: JsonOption = False) -> None:
    """Examine this machine within 30 seconds: GPU, driver, precision, memory, weights, caches, and correct results.

    Exit code: 0 if everything works, 3 if jobs run but slower than they could, 1 if they fail or are wrong.
    """
    from sgsst_core.bench.doctor import examine

    findings = []
    for finding in examine():
        findings.append(finding)
        if not as_json:
            out_console.print(f"{_MARKS[finding.state]:<9}{finding.topic:<12}{finding.text}")
    if as_json:
        out_console.print(json.dumps([asdict(finding) for finding in findings], indent=2))
    states = {finding.state for finding in findings}
    if "problem" in states:
        raise typer.Exit(FAILURE)
    if "warning" in states:
        raise typer.Exit(WARNING)
