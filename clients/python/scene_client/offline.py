"""The client of programs that have a model store and no service."""

from __future__ import annotations

from pathlib import Path

from scene_client.sync import Client


class OfflineClient(Client):
    """Answers in this process, from a model store; the same answers and problems as a service's.

    It needs the service's packages (`pip install '.[service]'` in the repository) and loads them,
    and every model of the store, when it is made.

    Args:
        store: directory of published models.
        timeout: seconds for a whole call.
        model: asked where a request names none; left out, the store's default.

    Raises:
        ImportError: the service's packages are not installed.
        InvalidRequestError: the store is not a directory.
    """

    def __init__(
        self, store: str | Path = "model_store", *, timeout: float = 10.0, model: str | None = None
    ) -> None:
        # Not before somebody asks for it: a robot that asks a service has no such packages.
        try:
            from app.in_process import InProcess
        except ImportError as error:
            raise ImportError(
                f"answers without a service need its packages ({error}): "
                "pip install '.[service]' in the repository"
            ) from error

        transport = InProcess(Path(store))
        super().__init__(
            "http://in-process",
            timeout=timeout,
            admin_key=transport.admin_key,
            model=model,
            transport=transport,
        )
