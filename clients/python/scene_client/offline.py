"""A client that answers from a model store, without a running service."""

from __future__ import annotations

from pathlib import Path

from scene_client.sync import Client


class OfflineClient(Client):
    """Answer in this process from a model store, with the same answers and problems as a service.

    It needs the service's packages (`pip install '.[service]'` in the repository). The constructor
    loads the packages and every model of the store.

    Args:
        store: directory of published models.
        timeout: seconds for a whole call.
        model: model of requests that name none; default: the store's default model.

    Raises:
        ImportError: the service's packages are not installed.
        InvalidRequestError: the store is not a directory.
    """

    def __init__(
        self, store: str | Path = "model_store", *, timeout: float = 10.0, model: str | None = None
    ) -> None:
        # Imported here, because clients of a running service do not have these packages.
        try:
            from app.in_process import InProcess
        except ImportError as error:
            raise ImportError(
                f"offline answers need the service's packages ({error}): "
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
