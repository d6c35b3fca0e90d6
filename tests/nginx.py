"""nginx in front of a service, configured as Debian does (`gzip on`) and as `docs/operations.md` recommends."""

from __future__ import annotations

import shutil
import socket
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.api.service import wait_for
from tests.ports import free_port

_CONFIGURATION = """
daemon off;
master_process off;
pid {folder}/nginx.pid;
error_log {folder}/error.log;
events {{}}
http {{
    gzip on;
    access_log off;
    client_body_temp_path {folder}/body;
    proxy_temp_path {folder}/proxy;
    fastcgi_temp_path {folder}/fastcgi;
    scgi_temp_path {folder}/scgi;
    uwsgi_temp_path {folder}/uwsgi;
    server {{
        listen 127.0.0.1:{port};
        location {subpath}/ {{
            proxy_pass http://127.0.0.1:{upstream}{upstream_path};
            proxy_set_header Host $http_host;
            proxy_request_buffering off;
            proxy_read_timeout 30m;
            client_max_body_size 0;
            {directives}
        }}
    }}
}}
"""


class Nginx:
    """nginx on a free port of this machine; a context manager. Where it is not installed, the test is skipped.

    Args:
        folder: New folder for its configuration, log and temporary files.
        upstream: Port on this machine to forward requests to.
        subpath: Path at which the service is offered, such as "/sgsst"; empty for the root.
        strip: Whether requests are forwarded without the subpath.
        directives: Further directives of the location, such as "gzip off;".
    """

    def __init__(
        self, folder: Path, upstream: int, subpath: str = "", *, strip: bool = True, directives: Sequence[str] = ()
    ) -> None:
        program = shutil.which("nginx", path="/usr/sbin:/usr/bin:/usr/local/sbin:/usr/local/bin")
        if program is None:
            pytest.skip("nginx is not installed (apt-get install nginx-light)")
        folder.mkdir()
        self._port = free_port()
        self.url = f"http://127.0.0.1:{self._port}{subpath}"
        configuration = _CONFIGURATION.format(
            folder=folder,
            port=self._port,
            subpath=subpath,
            upstream=upstream,
            upstream_path="/" if strip else "",
            directives="\n".join(directives),
        )
        (folder / "nginx.conf").write_text(configuration)
        self._command = [program, "-p", str(folder), "-c", "nginx.conf", "-e", str(folder / "error.log")]

    def __enter__(self) -> Nginx:
        self._process = subprocess.Popen(self._command)
        wait_for(self._listens, "nginx to listen")
        return self

    def __exit__(self, *ignored: object) -> None:
        self._process.terminate()
        self._process.wait()

    def _listens(self) -> bool:
        assert self._process.poll() is None, "nginx has ended"
        with socket.socket() as client:
            return client.connect_ex(("127.0.0.1", self._port)) == 0
