"""A client that answers from a model store, without a running service."""

from __future__ import annotations

from pathlib import Path

from scene_client.recorder import Recorder
from scene_client.sync import Client


class OfflineClient(Client):
    """A client that runs the service in its own process, with a local model store.

    Answers and problems are the same as from a separate service. The client needs the packages of
    the service: run `pip install '.[service]'` in the repository. The constructor loads these
    packages and every model of the store.

    Args:
        store: directory of published models.
        timeout: maximum time of a call in seconds.
        model: model for requests without the field ``model``. By default, this is the model at
            which the alias `default` of the store points.
        record: file for the scenes of answered questions, or a `Recorder`; see `Client`.

    Raises:
        ImportError: the packages of the service are not installed.
        InvalidRequestError: the store is not a directory.
    """

    def __init__(
        self,
        store: str | Path = "model_store",
        *,
        timeout: float = 10.0,
        model: str | None = None,
        record: str | Path | Recorder | None = None,
    ) -> None:
        # The import is in this method, because other clients do not need the packages.
        try:
            from app.in_process import InProcess
        except ImportError as error:
            raise ImportError(
                f"offline answers need the packages of the service ({error}); install them with "
                "pip install '.[service]' in the repository"
            ) from error

        super().__init__(
            "http://in-process",
            timeout=timeout,
            model=model,
            transport=InProcess(Path(store)),
            record=record,
        )
