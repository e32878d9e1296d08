"""A real PostgreSQL server of its own for each test module, which can be stopped, killed and started again."""

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from pathlib import Path

import psycopg
import pytest


def _binaries() -> Path | None:
    found = shutil.which("initdb")
    versions = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), key=lambda path: int(path.parts[-3]))
    path = Path(found) if found else versions[-1] if versions else None
    return path.resolve().parent if path else None


needs_postgres = pytest.mark.skipif(_binaries() is None, reason="no PostgreSQL server is installed")


class PostgresServer:
    """A server on a free port of this machine; as it refuses to run as root, it then runs as another user."""

    password = "top secret {1}"

    def __init__(self) -> None:
        binaries = _binaries()
        assert binaries is not None
        self._binaries = binaries
        self._folder = Path(tempfile.mkdtemp(prefix="postgres"))
        self._user = {}
        if os.geteuid() == 0:
            name = "postgres" if "postgres" in (entry.pw_name for entry in pwd.getpwall()) else "nobody"
            entry = pwd.getpwnam(name)
            os.chown(self._folder, entry.pw_uid, entry.pw_gid)
            self._user = {"user": entry.pw_uid, "group": entry.pw_gid, "extra_groups": []}
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        password_file = self._folder / "password"
        password_file.write_text(self.password)
        password_file.chmod(0o644)
        self._run("initdb", "-D", "data", "-U", "tester", "--auth=scram-sha-256", f"--pwfile={password_file}", "--no-sync")

    def _run(self, program: str, *arguments: str, check: bool = True) -> None:
        subprocess.run(
            [self._binaries / program, *arguments],
            cwd=self._folder,
            check=check,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            **self._user,
        )

    def url(self, database: str = "postgres", password: str | None = None) -> str:
        """
        :param database: name of the database
        :param password: another than the right one
        :return: where Optuna finds it
        """
        quoted = (password or self.password).replace(" ", "%20").replace("{", "%7B").replace("}", "%7D")
        return f"postgresql://tester:{quoted}@127.0.0.1:{self.port}/{database}"

    def create_database(self, name: str) -> str:
        """
        :param name: name of a new database
        :return: its URL
        """
        with psycopg.connect(self.url(), autocommit=True) as connection:
            connection.execute(f'CREATE DATABASE "{name}"')
        return self.url(name)

    def start(self) -> None:
        """Start the server and wait for it."""
        options = f"-c listen_addresses=127.0.0.1 -c port={self.port} -c unix_socket_directories={self._folder} -c fsync=off"
        self._run("pg_ctl", "-D", "data", "-w", "-l", "log", "-o", options, "start")

    def stop(self) -> None:
        """End it at once, with all connections; it recovers at the next start."""
        self._run("pg_ctl", "-D", "data", "-w", "-m", "immediate", "stop", check=False)

    def remove(self) -> None:
        """Stop it and delete its files."""
        self.stop()
        shutil.rmtree(self._folder, ignore_errors=True)


@pytest.fixture(scope="module")
def postgres():
    """A running server."""
    server = PostgresServer()
    try:
        server.start()
        yield server
    finally:
        server.remove()
