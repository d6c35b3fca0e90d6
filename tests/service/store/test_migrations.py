"""Tests that processes of this version still work and start on the tables of the next one, which adds to them."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import text

from service.store.database import MIGRATIONS, SCHEMA, Database
from tests.api.service import ROOT, Service, wait_for
from tests.api.service import submit as submit_job
from tests.small_scenes import input_files

VERSIONS = sorted(path.name[:4] for path in (MIGRATIONS / "versions").glob("[0-9]*.py"))


def test_migrations_are_numbered_in_order() -> None:
    assert VERSIONS[-1] == SCHEMA
    assert [f"{int(VERSIONS[0]) + number:04d}" for number in range(len(VERSIONS))] == VERSIONS


def next_version(folder: Path) -> Path:
    """Create a copy of the project whose next version adds a table, a column and an index."""
    for name in ("sgsst_core", "worker", "service"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    new = f"{int(SCHEMA) + 1:04d}"
    source = folder / "service" / "store" / "database.py"
    source.write_text(source.read_text().replace(f'SCHEMA = "{SCHEMA}"', f'SCHEMA = "{new}"'))
    (folder / "service" / "store" / "migrations" / "versions" / f"{new}_next.py").write_text(
        "import sqlalchemy as sa\nfrom alembic import op\n"
        f'revision, down_revision = "{new}", "{SCHEMA}"\n\n\n'
        "def upgrade():\n"
        '    op.create_table("next", sa.Column("id", sa.Integer(), primary_key=True))\n'
        '    op.add_column("jobs", sa.Column("next", sa.Integer(), nullable=False, server_default="7"))\n'
        '    op.create_index("ix_jobs_next", "jobs", ["next"])\n'
    )
    return folder


@pytest.mark.slow
def test_this_version_runs_on_tables_of_the_next_one(tmp_path: Path, tiny_installed: Path) -> None:
    code = next_version(tmp_path / "next")
    files = input_files(tmp_path)

    def submit(client: Any) -> str:
        return submit_job(client, files, steps_sos=300, steps_coarse=0, backbone="vgg16")

    with Service(tmp_path / "data") as service, service.client() as client:
        job = submit(client)
        where = f"/v1/jobs/{job}"
        wait_for(lambda: client.get(where).json()["status"] == "running", "the job's start", service.said)
        environment = {**os.environ, "PYTHONPATH": str(code), "SGSST_DATA": str(service.data)}
        subprocess.run([sys.executable, "-m", "service.prepare"], env=environment, cwd=tmp_path, check=True)
        database = Database(f"sqlite:///{service.data / 'sgsst.db'}")
        with database.reading() as session:
            assert session.execute(text("SELECT version_num FROM alembic_version")).scalar_one() > SCHEMA
            assert session.execute(text("SELECT next FROM jobs")).scalar() == 7
        assert service.succeeded(job)["attempt"] == 1
    with Service(tmp_path / "data") as service, service.client() as client:
        second = submit(client)
        service.succeeded(second)
        first, other = (client.get(f"/v1/jobs/{each}/artifacts/stylized.ply").content for each in (job, second))
        assert first == other
    database.close()
