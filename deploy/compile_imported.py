"""Import all modules of the programs, so that the image contains their bytecode: it is read-only at run time."""

import importlib

PROGRAMS = (
    "api.cli.main",
    "api.http.server",
    "ray",
    "service.inspection.process",
    "service.prepare",
    "service.scheduling.attempt_process",
    "service.scheduling.dispatcher",
    "torch.distributed",
    "worker.execute",
    "worker.ranks.driver",
)

for name in PROGRAMS:
    importlib.import_module(name)
